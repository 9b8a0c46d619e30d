/* See engine.h. Agents are divided among threads; one barrier per communication step.
 *
 * Messages, memories and readings go to the place of the *next* point, so within a step no thread
 * writes what another one reads. Each agent is computed by the same instructions whatever thread it
 * belongs to: the results do not depend on the number of threads. */
#include "engine.h"

#include <math.h>
#include <stddef.h>

#include "export.h"
#include "threads.h"

enum { MAX_THREADS = 64 };

/* `plain` says that nothing but the ordinary happens in a slice (see `is_plain`). It is a constant
 * where it is given, so there are two copies of what is done for an agent: one without the tests. */
#define FOR_EACH_AGENT static inline __attribute__((always_inline))

/* What a thread tells the others at a communication point. */
typedef struct {
    int failed;
    int diverging; /* an agent is beyond the limit at the next point */
    int halt;
    char apart[116]; /* one cache line or more per thread */
} Signal;

typedef struct {
    Engine *e;
    int plain;
    Barrier barrier;
    int64_t gate;                    /* 1: go; 2: there are not enough threads */
    Signal signals[3][MAX_THREADS];  /* two in turn: a thread can be one point ahead of another;
                                        the third between two points */
} Team;

/* A thread, its agents, and where it is; all members of a team come to the same k and ended. */
typedef struct {
    Team *team;
    int64_t id, first, end; /* agents */
    int64_t first_other, end_other; /* instances that are no agents */
    double *scratch;
    Report *report;
    Thread thread;
    int64_t k;
    int64_t diverging;
    int64_t ended;
} Member;

/* ---- where things are ------------------------------------------------------------------------ */

/* A communication point, and where that is which belongs to it. */
typedef struct {
    int64_t k;
    int64_t row;             /* of this slice */
    double *readings;        /* of all instances */
    double *memory, *message; /* of the agents and the leader */
    double *measured;        /* of the agents, and what they measured before */
    const double *measured_before;
} Place;

static Place place(const Engine *e, int64_t k, int64_t row)
{
    const int64_t half = k & 1, n = e->agents;
    return (Place){k,
                   row,
                   e->readings + half * e->fmus->reading_at[e->fmus->n],
                   e->memory + half * (n + 1) * MEMORY,
                   e->message + k % e->slots * (n + 1) * MESSAGE,
                   e->measured + half * n * MEASURED,
                   e->measured + !half * n * MEASURED};
}

/* What is done between a point and the next one. */
typedef struct {
    int64_t k, row;
    double t, h;             /* time [s], and the communication step */
    const int32_t *arrivals; /* at k */
    Place here, next;
} Point;

static double *reading(const Engine *e, const Place *at, int64_t i)
{
    return at->readings + e->fmus->reading_at[i];
}

static double *memory(const Place *at, int64_t i)
{
    return at->memory + i * MEMORY;
}

static double *measured(const Place *at, int64_t i)
{
    return at->measured + i * MEASURED;
}

static double *message(const Place *at, int64_t i)
{
    return at->message + i * MESSAGE;
}

static const double *own_values(const Engine *e, int64_t i)
{
    return OWN ? e->own_values + i * OWN : NULL;
}

static const Controller *controller(const Engine *e, int64_t i)
{
    return e->controllers + e->controller[i];
}

static double time_of(const Engine *e, int64_t k)
{
    return (double)(k * e->period) / (double)e->per_second;
}

/* The step of an instance [s] from the nominal period, never from differences of times. */
static double step_of(const Engine *e, int64_t i)
{
    return (double)(e->every[i] * e->period) / (double)e->per_second;
}

static void copy(double *to, const double *from, int64_t n)
{
    for (int64_t j = 0; j < n; j++)
        to[j] = from[j];
}

static double rounded(double value, double resolution)
{
    return resolution > 0 ? resolution * rint(value / resolution) : value;
}

/* ---- the channel ----------------------------------------------------------------------------- */

/* The messages of the point that is `age` steps before. */
static const double *message_before(const Engine *e, const Point *p, int64_t age, int64_t sender)
{
    return e->message + ((p->k - age) % e->slots * (e->agents + 1) + sender) * MESSAGE;
}

/* What is held at the end of an arc, and its age in steps; a message that arrives now is taken. */
FOR_EACH_AGENT const double *hear(const Engine *e, const Point *p, int64_t arc, int64_t sender,
                                  int64_t *age, const int plain)
{
    if (plain) {
        *age = 0;
        return message(&p->here, sender);
    }
    if (!e->held) {
        *age = e->delay ? e->delay[arc] : 0;
        if (*age > p->k)
            *age = p->k; /* until the first message has come the initial one is held */
        return message_before(e, p, *age, sender);
    }
    double *held = e->held + arc * MESSAGE;
    if (p->arrivals[arc] >= 0) {
        e->sent_at[arc] = p->k - p->arrivals[arc];
        copy(held, message_before(e, p, p->arrivals[arc], sender), MESSAGE);
    }
    *age = p->k - e->sent_at[arc];
    return held;
}

/* Gather what agent i has heard: the disagreement (MESSAGE) of (6) and, for what belongs to it, of
 * the observer (22); and how long ago it was sent, by the neighbours and by the leader. */
FOR_EACH_AGENT void gather(const Engine *e, const Point *p, int64_t i, double *disagreement,
                           double *silence, const int plain)
{
    enum { FIRST = MESSAGE - INNOVATION };
    double heard[MESSAGE] = {0};
    int64_t oldest = 0, from_leader = 0, age;
    for (int64_t arc = e->first_arc[i]; arc < e->first_arc[i + 1]; arc++) {
        const double *from = hear(e, p, arc, e->sender[arc], &age, plain);
        for (int j = 0; j < FIRST; j++)
            heard[j] += e->weight[arc] * from[j];
        if (e->innovation_weight)
            for (int j = FIRST; j < MESSAGE; j++)
                heard[j] += e->innovation_weight[arc] * from[j];
        if (age > oldest)
            oldest = age;
    }
    const double *mine = message(&p->here, i);
    for (int j = 0; j < FIRST; j++)
        disagreement[j] = e->own[i] * mine[j] - heard[j];
    for (int j = FIRST; j < MESSAGE; j++)
        disagreement[j] = e->own_innovation[i] * mine[j] - heard[j];
    if (e->leader_arc[i] >= 0) {
        const double *s = hear(e, p, e->leader_arc[i], e->agents, &from_leader, plain);
        for (int j = 0; j < FIRST; j++)
            disagreement[j] -= e->leader[i] * s[j];
    }
    silence[0] = time_of(e, oldest);
    silence[1] = time_of(e, from_leader);
}

/* Take what arrives for agent i at a point at which it does not act. */
static void listen(const Engine *e, const Point *p, int64_t i)
{
    int64_t age;
    for (int64_t arc = e->first_arc[i]; arc < e->first_arc[i + 1]; arc++)
        hear(e, p, arc, e->sender[arc], &age, 0);
    if (e->leader_arc[i] >= 0)
        hear(e, p, e->leader_arc[i], e->agents, &age, 0);
}

/* ---- measuring ------------------------------------------------------------------------------- */

/* A reading at a point, or an exogenous signal there. */
static double source(const Engine *e, const Place *at, int64_t term)
{
    if (term < 0)
        return e->drive[at->row * e->drives - 1 - term];
    return at->readings[term];
}

/* What agent i measures at a point; a sensor that is stuck shows what it showed before. */
FOR_EACH_AGENT void measure(const Engine *e, const Place *at, int64_t i, const int plain)
{
    double *to = measured(at, i);
    const double *y = reading(e, at, i), *before = at->measured_before + i * MEASURED;
    for (int j = 0; j < MEASURED; j++)
        to[j] = j < Q ? y[j] : source(e, at, e->measured_from[i * (MEASURED - Q) + j - Q]);
    if (plain)
        return;
    if (e->noise)
        for (int j = 0; j < MEASURED; j++)
            to[j] += e->noise[(at->row * e->agents + i) * MEASURED + j];
    if (!e->sensor_gain)
        return;
    for (int j = 0; j < MEASURED; j++) {
        const int64_t which = i * MEASURED + j;
        to[j] = rounded(to[j] + e->sensor_offset[which], e->sensor_resolution[which]);
        if (e->sensor_gain[which] != 1 && at->k > 0)
            to[j] = before[j] + e->sensor_gain[which] * (to[j] - before[j]);
    }
}

/* Measure at a point and put down what is sent there. */
FOR_EACH_AGENT void send(const Engine *e, const Place *at, int64_t i, const int plain)
{
    double *to = message(at, i);
    measure(e, at, i, plain);
    controller_send(controller(e, i), own_values(e, i), memory(at, i), measured(at, i), to);
    if (!plain && e->resolution > 0)
        for (int j = 0; j < MESSAGE; j++)
            to[j] = rounded(to[j], e->resolution);
}

/* Whether state and estimate of agent i are finite and within the limit. */
FOR_EACH_AGENT int within(const Engine *e, const Place *at, int64_t i)
{
    const double *xhat = memory(at, i), *x = reading(e, at, i) + Q;
    int good = 1;
    for (int j = 0; j < M; j++) {
        good &= fabs(xhat[j]) <= e->limit;
        if (e->shows_states)
            good &= fabs(x[j]) <= e->limit;
    }
    return good;
}

/* ---- recording ------------------------------------------------------------------------------- */

FOR_EACH_AGENT void record(const Engine *e, const Point *p, int64_t i)
{
    const int64_t at = p->row * e->agents + i;
    const double *values = reading(e, &p->here, i);
    if (e->xhat_rows)
        copy(e->xhat_rows + at * M, memory(&p->here, i), M);
    if (e->u_rows)
        copy(e->u_rows + at * P, e->u + i * P, P);
    if (e->applied_rows)
        copy(e->applied_rows + at * P, e->applied + i * P, P);
    if (e->y_rows)
        copy(e->y_rows + at * Q, values, Q);
    if (e->x_rows && e->shows_states)
        copy(e->x_rows + at * M, values + Q, M);
    if (e->measured_rows)
        copy(e->measured_rows + at * MEASURED, measured(&p->here, i), MEASURED);
}

FOR_EACH_AGENT void note_lowest(const Engine *e, const Point *p, int64_t i, double t)
{
    const double *x = e->shows_states ? reading(e, &p->here, i) + Q : memory(&p->here, i);
    double lowest = x[0];
    for (int j = 1; j < M; j++)
        if (!(lowest <= x[j]))
            lowest = lowest != lowest ? lowest : x[j]; /* NaN stays */
    if (lowest < e->min_state[i]) {
        e->min_state[i] = lowest;
        e->min_time[i] = t;
    }
}

/* ---- one instance ---------------------------------------------------------------------------- */

/* k % every == 0; a division takes as long as all else here, and most periods are one step */
static int is_multiple(int64_t k, int64_t every)
{
    return every == 1 || k % every == 0;
}

/* Whether a step of instance i begins at point k, and whether one ends at k + 1. */
FOR_EACH_AGENT int begins(const Engine *e, int64_t k, int64_t i, const int plain)
{
    return plain || (!e->frozen[i] && is_multiple(k, e->every[i]));
}

FOR_EACH_AGENT int ends(const Engine *e, int64_t k, int64_t i, const int plain)
{
    return plain || (!e->frozen[i] && is_multiple(k + 1, e->every[i]));
}

/* What agent i remembers at the next point goes here: at once, or when its period is over. */
FOR_EACH_AGENT double *remembers(const Engine *e, const Point *p, int64_t i, const int plain)
{
    return plain || e->every[i] == 1 ? memory(&p->next, i) : e->pending + i * MEMORY;
}

/* What the actuator of agent i makes of its input. */
FOR_EACH_AGENT void actuate(const Engine *e, const Point *p, int64_t i, const int plain)
{
    const double *u = e->u + i * P;
    double *actuated = e->actuated + i * P;
    for (int j = 0; j < P; j++) {
        const double gain = !plain && e->actuator_gain && p->k > 0 ? e->actuator_gain[i * P + j] : 1;
        actuated[j] = gain == 1 ? u[j] : actuated[j] + gain * (u[j] - actuated[j]);
    }
}

#if defined CONTROLLER_BLOCK

/* Column `at` of a matrix with CONTROLLER_BLOCK columns, from and to the values of one agent. */
FOR_EACH_AGENT void put_column(double *to, int at, const double *from, int n)
{
    for (int j = 0; j < n; j++)
        to[j * CONTROLLER_BLOCK + at] = from[j];
}

FOR_EACH_AGENT void take_column(double *to, const double *from, int at, int n)
{
    for (int j = 0; j < n; j++)
        to[j] = from[j * CONTROLLER_BLOCK + at];
}

/* The inputs of some agents with one controller, and what they remember next; where a column is
 * left, the leader's memory too. Returns whether it was. */
FOR_EACH_AGENT int control(const Engine *e, const Point *p, const int64_t *agents, int n,
                           const int with_leader, const int plain)
{
    enum { B = CONTROLLER_BLOCK };
    double all[MESSAGE * B], before[MEMORY * B], after[MEMORY * B], u[P * B], applied[P * B];
    double driven[B], disagreement[MESSAGE], silence[2];
    const int leads = with_leader && n < B;
    for (int l = 0; l < B; l++)
        driven[l] = l < n;
    for (int l = 0; l < n; l++) {
        gather(e, p, agents[l], disagreement, silence, plain);
        put_column(all, l, disagreement, MESSAGE);
        put_column(before, l, memory(&p->here, agents[l]), MEMORY);
    }
    for (int l = n; l < B; l++) {
        put_column(all, l, disagreement, MESSAGE);
        put_column(before, l, memory(&p->here, leads ? e->agents : agents[n - 1]), MEMORY);
    }
    controller_block(controller(e, agents[0]), n + leads, p->t, driven, all, before, after, u,
                     applied);
    for (int l = 0; l < n; l++) {
        const int64_t i = agents[l];
        take_column(remembers(e, p, i, plain), after, l, MEMORY);
        take_column(e->u + i * P, u, l, P);
        take_column(e->applied + i * P, applied, l, P);
    }
    if (leads)
        take_column(memory(&p->next, e->agents), after, n, MEMORY);
    return leads;
}

#else

enum { CONTROLLER_BLOCK = 1 };

FOR_EACH_AGENT int control(const Engine *e, const Point *p, const int64_t *agents, int n,
                           const int with_leader, const int plain)
{
    (void)with_leader;
    double disagreement[MESSAGE], silence[2];
    for (int l = 0; l < n; l++) {
        const int64_t i = agents[l];
        gather(e, p, i, disagreement, silence, plain);
        controller_step(controller(e, i), own_values(e, i), p->t, measured(&p->here, i), disagreement,
                        silence, memory(&p->here, i), remembers(e, p, i, plain), e->u + i * P,
                        e->applied + i * P);
    }
    return 0;
}

#endif

/* Let those of the agents first … end - 1 act whose step begins; the others only listen. Returns
 * whether the leader's memory was computed besides. */
FOR_EACH_AGENT int control_those(const Engine *e, const Point *p, int64_t first, int64_t end,
                                 const int with_leader, const int plain)
{
    int64_t acting[CONTROLLER_BLOCK];
    int n = 0, led = 0;
    for (int64_t i = first; i < end; i++) {
        if (!begins(e, p->k, i, plain)) {
            if (e->held)
                listen(e, p, i);
            continue;
        }
        if (!plain && n && e->controller[i] != e->controller[acting[0]]) {
            control(e, p, acting, n, 0, plain);
            n = 0;
        }
        acting[n++] = i;
    }
    if (n)
        led = control(e, p, acting, n, plain && with_leader, plain);
    for (int64_t i = first; i < end; i++)
        if (begins(e, p->k, i, plain))
            actuate(e, p, i, plain);
    return led;
}

/* Put the inputs of an instance together: u of an agent, then what it is wired to. */
FOR_EACH_AGENT void set_inputs(const Engine *e, const Point *p, int64_t i, const int plain)
{
    double *to = e->inputs + e->fmus->input_at[i];
    if (i < e->agents) {
        copy(to, e->actuated + i * P, P);
        to += P;
    }
    if (plain)
        return;
    for (int64_t extra = e->first_extra[i]; extra < e->first_extra[i + 1]; extra++) {
        double value = e->extra_bias[extra];
        for (int64_t term = e->first_term[extra]; term < e->first_term[extra + 1]; term++)
            value += e->term_weight[term] * source(e, &p->here, e->term[term]);
        *to++ = value;
    }
}

/* Everything that belongs to an instance stays as it is. */
static void carry(const Engine *e, const Point *p, int64_t i)
{
    const Fmus *f = e->fmus;
    copy(reading(e, &p->next, i), reading(e, &p->here, i), f->reading_at[i + 1] - f->reading_at[i]);
    if (i >= e->agents)
        return;
    copy(measured(&p->next, i), measured(&p->here, i), MEASURED);
    copy(memory(&p->next, i), memory(&p->here, i), MEMORY);
    copy(message(&p->next, i), message(&p->here, i), MESSAGE);
}

/* An instance did not do what it was told: the run ends, or goes on without it. */
static void failed(const Engine *e, const Point *p, int64_t i, Report *report, Signal *signal)
{
    if (!e->freezes || report->failure.call == CALL_STEP_TERMINATED) {
        signal->failed = 1;
        return;
    }
    e->incident[i] = report->failure;
    e->frozen[i] = 1;
    report->failure.call = CALL_NONE;
    signal->halt = 1;
    carry(e, p, i);
}

/* What follows when the readings of instance i at k + 1 are there. */
FOR_EACH_AGENT void arrived(const Engine *e, const Point *p, int64_t i, Signal *signal,
                            const int plain)
{
    if (i >= e->agents)
        return;
    if (!plain && e->every[i] != 1)
        copy(memory(&p->next, i), e->pending + i * MEMORY, MEMORY);
    if (plain || !e->measures_others)
        send(e, &p->next, i, plain);
    if (!within(e, &p->next, i))
        signal->diverging = 1;
}

/* Take instance i from k to k + 1; `posted` counts those that another process takes there. Returns
 * whether the instances after it are to be stepped. */
FOR_EACH_AGENT int step(const Engine *e, const Member *me, const Point *p, int64_t i,
                        int64_t *posted, Signal *signal, const int plain)
{
    const Fmus *f = e->fmus;
    if (begins(e, p->k, i, plain))
        set_inputs(e, p, i, plain);
    if (!ends(e, p->k, i, plain)) {
        carry(e, p, i);
        return 1;
    }
    const int64_t every = plain ? 1 : e->every[i];
    const double t = every == 1 ? p->t : time_of(e, p->k + 1 - every);
    const double h = every == 1 ? p->h : step_of(e, i);
    const double *inputs = e->inputs + f->input_at[i];
    if (!plain && fmus_is_remote(f, i)) {
        f->remote->post(f->remote->context, i, t, h, inputs);
        ++*posted;
        return 1;
    }
    fmus_expect(f, i + 1);
    if (!fmus_step(f, i, t, h, inputs, me->scratch, me->report)) {
        failed(e, p, i, me->report, signal);
        return !signal->failed; /* the rest of this point is recorded */
    }
    if (fmus_read(f, i, reading(e, &p->next, i), me->scratch, me->report))
        arrived(e, p, i, signal, plain);
    else
        failed(e, p, i, me->report, signal);
    return 1;
}

/* ---- all instances of one thread ------------------------------------------------------------- */

/* Read all FMUs at the point where the run begins, and send what is known there. */
static void read_first(const Engine *e, const Member *me, const Point *p, Signal *signal)
{
    *signal = (Signal){0};
    for (int64_t i = me->first; i < me->end; i++)
        if (!fmus_read(e->fmus, i, reading(e, &p->here, i), me->scratch, me->report))
            signal->failed = 1;
    for (int64_t i = me->first_other; i < me->end_other; i++)
        if (!fmus_read(e->fmus, i, reading(e, &p->here, i), me->scratch, me->report))
            signal->failed = 1;
}

static void send_first(const Engine *e, const Member *me, const Point *p, Signal *signal)
{
    *signal = (Signal){0};
    for (int64_t i = me->first; i < me->end; i++) {
        if (begins(e, p->k, i, 0))
            send(e, &p->here, i, 0);
        if (!within(e, &p->here, i))
            signal->diverging = 1;
    }
    if (me->id == 0)
        controller_leader_send(e->controllers, memory(&p->here, e->agents),
                               message(&p->here, e->agents));
}

/* Measure and send at k + 1, when the readings of all instances are there. */
static void send_late(const Engine *e, const Member *me, const Point *p, Signal *signal)
{
    *signal = (Signal){0};
    for (int64_t i = me->first; i < me->end; i++)
        if (ends(e, p->k, i, 0))
            send(e, &p->next, i, 0);
}

/* Wait for what was posted by this thread. */
static void wait_for_posted(const Engine *e, const Member *me, const Point *p, int64_t from,
                            int64_t to, Signal *signal)
{
    const Remote *remote = e->fmus->remote;
    for (int64_t i = from; i < to; i++) {
        if (!e->fmus->is_remote[i] || !ends(e, p->k, i, 0))
            continue;
        if (remote->wait(remote->context, i, reading(e, &p->next, i), me->report))
            arrived(e, p, i, signal, 0);
        else
            failed(e, p, i, me->report, signal);
    }
}

/* Whether all agents are stepped at every point in this process, and nothing is between them and
 * their FMUs and neighbours: no delay, no noise, no fault, no other wiring. */
static int is_plain(const Engine *e)
{
    if (e->held || e->delay || e->noise || e->sensor_gain || e->actuator_gain ||
        e->measures_others || e->resolution > 0 || e->fmus->remote)
        return 0;
    for (int64_t i = 0; i < e->agents; i++)
        if (e->frozen[i] || e->every[i] != 1 || e->first_extra[i + 1] > e->first_extra[i])
            return 0;
    return 1;
}

/* The agents of one thread at a point; returns whether the instances after them are to be stepped. */
FOR_EACH_AGENT int advance_agents(const Engine *e, const Member *me, const Point *p, int steps,
                                  int *led, int64_t *posted, Signal *signal, const int plain)
{
    for (int64_t first = me->first; first < me->end; first += CONTROLLER_BLOCK) {
        const int64_t end = first + CONTROLLER_BLOCK < me->end ? first + CONTROLLER_BLOCK : me->end;
        *led = control_those(e, p, first, end, me->id == 0 && end == me->end, plain);
        for (int64_t i = first; i < end; i++) {
            record(e, p, i);
            note_lowest(e, p, i, p->t);
            if (steps)
                steps = step(e, me, p, i, posted, signal, plain);
        }
    }
    return steps;
}

static int advance_plain_agents(const Engine *e, const Member *me, const Point *p, int steps,
                                int *led, Signal *signal)
{
    int64_t none = 0;
    return advance_agents(e, me, p, steps, led, &none, signal, 1);
}

static int advance_any_agents(const Engine *e, const Member *me, const Point *p, int steps,
                              int *led, int64_t *posted, Signal *signal)
{
    return advance_agents(e, me, p, steps, led, posted, signal, 0);
}

/* Control and record at a point; if `go`, step to the next one and read there. */
static void advance(const Engine *e, const Member *me, const Point *p, int go, Signal *signal)
{
    int64_t posted = 0;
    int led = 0;
    *signal = (Signal){0};
    int steps = me->team->plain ? advance_plain_agents(e, me, p, go, &led, signal)
                                : advance_any_agents(e, me, p, go, &led, &posted, signal);
    for (int64_t i = me->first_other; i < me->end_other && steps; i++)
        steps = step(e, me, p, i, &posted, signal, 0);
    if (posted) {
        e->fmus->remote->send(e->fmus->remote->context);
        wait_for_posted(e, me, p, me->first, me->end, signal);
        wait_for_posted(e, me, p, me->first_other, me->end_other, signal);
    }
    if (me->id != 0)
        return;
    const double *leader = memory(&p->here, e->agents);
    if (e->s_rows)
        copy(e->s_rows + p->row * M, leader, M);
    if (e->time)
        e->time[p->row] = p->t;
    if (e->extra_rows)
        for (int64_t j = 0; j < e->extra_columns; j++)
            e->extra_rows[p->row * e->extra_columns + j] =
                source(e, &p->here, e->recorded[j]);
    if (go) {
        if (!led)
            controller_leader(e->controllers, p->t, leader, memory(&p->next, e->agents));
        controller_leader_send(e->controllers, memory(&p->next, e->agents),
                               message(&p->next, e->agents));
    }
    signal->halt |= __atomic_load_n(&e->halt, __ATOMIC_ACQUIRE) != 0;
}

/* Wait for the others; what any of them says. */
static Signal meet(Team *team, int64_t slot)
{
    barrier_wait(&team->barrier, team->e->threads);
    Signal all = {0};
    for (int64_t id = 0; id < team->e->threads; id++) {
        const Signal *one = &team->signals[slot][id];
        all.failed |= one->failed;
        all.diverging |= one->diverging;
        all.halt |= one->halt;
    }
    return all;
}

static void run(Member *me)
{
    Team *team = me->team;
    const Engine *e = team->e;
    Point p = {.k = e->k,
               .t = time_of(e, e->k),
               .h = time_of(e, 1),
               .arrivals = e->arrivals,
               .here = place(e, e->k, 0),
               .next = place(e, e->k + 1, 1)};
    Signal all = {0};
    if (e->ready == 0) {
        read_first(e, me, &p, &team->signals[p.k & 1][me->id]);
        all = meet(team, p.k & 1);
    }
    if (e->ready != 1 && !all.failed) {
        send_first(e, me, &p, &team->signals[(p.k + 1) & 1][me->id]);
        all = meet(team, (p.k + 1) & 1);
        me->diverging = all.diverging;
    }
    while (!all.failed && !all.halt && p.k < e->until) {
        const int go = !me->diverging && p.k < e->steps;
        advance(e, me, &p, go, &team->signals[p.k & 1][me->id]);
        all = meet(team, p.k & 1);
        if (e->measures_others && go && !all.failed) {
            send_late(e, me, &p, &team->signals[2][me->id]);
            meet(team, 2);
        }
        me->k = p.k + 1;
        if (!go) {
            me->ended = me->diverging ? DIVERGED : COMPLETE;
            return;
        }
        me->diverging = all.diverging;
        p.t = time_of(e, ++p.k);
        p.here = p.next;
        p.next = place(e, p.k + 1, ++p.row + 1);
        if (p.arrivals)
            p.arrivals += e->all_arcs;
    }
    me->ended = all.failed ? FAILED : GOES_ON;
}

static void join_team(void *member)
{
    Member *me = member;
    if (gate_wait(&me->team->gate) == 1)
        run(me);
}

/* ---- the slice ------------------------------------------------------------------------------- */

/* The failure that comes first, in the first report. */
static void merge(Report *reports, int64_t threads)
{
    for (int64_t id = 1; id < threads; id++) {
        const Report *one = &reports[id];
        if (one->failure.call &&
            (!reports->failure.call || incident_before(&one->failure, &reports->failure)))
            reports->failure = one->failure;
        if (one->warnings && !reports->warnings)
            reports->warning = one->warning;
        reports->warnings += one->warnings;
    }
}

/* Run from k up to the point `until` (not included); rows, ended and reports[0] say how it went. */
EXPORT void engine_run(Engine *e)
{
    Team team = {.e = e, .plain = is_plain(e)};
    Member members[MAX_THREADS];
    const int64_t n = e->agents, others = e->fmus->n - n;
    int64_t started = 1;
    e->rows = 0;
    for (int64_t id = 0; id < e->threads; id++) {
        e->reports[id] = (Report){0};
        members[id] = (Member){.team = &team,
                               .id = id,
                               .first = n * id / e->threads,
                               .end = n * (id + 1) / e->threads,
                               .first_other = n + others * id / e->threads,
                               .end_other = n + others * (id + 1) / e->threads,
                               .scratch = e->scratch + id * e->fmus->room,
                               .report = &e->reports[id],
                               .k = e->k,
                               .diverging = e->diverging};
    }
    while (started < e->threads &&
           thread_start(&members[started].thread, join_team, &members[started]))
        started++;
    gate_open(&team.gate, started == e->threads ? 1 : 2);
    if (started == e->threads)
        run(&members[0]);
    else
        members[0].ended = NO_THREAD;
    for (int64_t id = 1; id < started; id++)
        thread_join(&members[id].thread);
    const Member *me = &members[0];
    merge(e->reports, e->threads);
    e->ended = me->ended;
    e->rows = me->k - e->k;
    e->diverging = me->diverging;
    if (me->ended == NO_THREAD)
        return;
    e->ready = 1;
    const int64_t call = e->reports->failure.call;
    const int reading = call == CALL_GET || call == CALL_NOT_FINITE;
    const int stepped = me->ended == GOES_ON || (me->ended == FAILED && reading);
    e->k = stepped ? me->k : me->k - (me->k > e->k);
}

EXPORT int64_t engine_threads(void)
{
    return MAX_THREADS;
}

/* Sizes that the caller lays out memory by. */
EXPORT int64_t engine_size(void)
{
    return (int64_t)sizeof(Engine);
}

EXPORT int64_t engine_controller_size(void)
{
    return (int64_t)sizeof(Controller);
}
