/* See engine.h. Agents are divided among threads; one barrier per communication step.
 *
 * Estimates and innovations go to the slot of the *next* point, so within a step no thread writes
 * what another one reads. Each agent is computed by the same instructions whatever thread it
 * belongs to: the results do not depend on the number of threads. */
#include "engine.h"

#include <math.h>
#include <stddef.h>

#include "export.h"
#include "threads.h"

enum { MAX_THREADS = 64 };

/* What a thread tells the others at a communication point. */
typedef struct {
    int failed;
    int diverging; /* an agent is beyond the limit at the next point */
    int halt;
    char apart[116]; /* one cache line or more per thread */
} Signal;

typedef struct {
    Engine *e;
    Barrier barrier;
    int64_t gate;                    /* 1: go; 2: there are not enough threads */
    Signal signals[2][MAX_THREADS];  /* two: a thread can be one point ahead of another */
} Team;

/* A thread, its agents, and where it is; all members of a team come to the same k and ended. */
typedef struct {
    Team *team;
    int64_t id, first, end;
    double *scratch;
    Report *report;
    Thread thread;
    int64_t k;
    int64_t diverging;
    int64_t ended;
} Member;

/* ---- where things are ------------------------------------------------------------------------ */

static int64_t width(const Engine *e)
{
    return Q + (e->shows_states ? M : 0);
}

static double *reading(const Engine *e, int64_t k, int64_t i)
{
    return e->readings + ((k & 1) * e->fmus->n + i) * width(e);
}

static double *estimate(const Engine *e, int64_t slot, int64_t i)
{
    return e->xhat + (slot * (e->fmus->n + 1) + i) * M;
}

static double *innovation(const Engine *e, int64_t slot, int64_t i)
{
    return e->innovation + (slot * (e->fmus->n + 1) + i) * Q;
}

static double time_of(const Engine *e, int64_t k)
{
    return (double)(k * e->period) / 1e9;
}

/* ---- the channel ----------------------------------------------------------------------------- */

typedef struct {
    const double *estimate;
    const double *innovation;
} Heard;

typedef struct {
    int64_t k;
    int64_t slot;            /* of k */
    const int32_t *arrivals; /* at k */
} Point;

static int64_t slot_before(const Engine *e, const Point *p, int64_t age)
{
    if (age > p->k)
        age = p->k; /* until the first message has come the initial one is held */
    return p->slot >= age ? p->slot - age : p->slot - age + e->slots;
}

/* What is held at the end of an arc; a message that arrives now is taken. */
static Heard hear(const Engine *e, const Point *p, int64_t arc, int64_t sender)
{
    if (!e->held) {
        int64_t slot = e->delay ? slot_before(e, p, e->delay[arc]) : p->slot;
        return (Heard){estimate(e, slot, sender), innovation(e, slot, sender)};
    }
    double *held = e->held + arc * (M + Q);
    if (p->arrivals[arc] >= 0) {
        int64_t slot = slot_before(e, p, p->arrivals[arc]);
        const double *x = estimate(e, slot, sender), *z = innovation(e, slot, sender);
        for (int j = 0; j < M; j++)
            held[j] = x[j];
        for (int j = 0; j < Q; j++)
            held[M + j] = z[j];
    }
    return (Heard){held, held + M};
}

/* ---- one agent ------------------------------------------------------------------------------- */

/* Gather what agent i has heard: the disagreement (M) of (6), the innovation (Q) of (5) or (22). */
static void gather(const Engine *e, const Point *p, int64_t i, double *disagreement,
                   double *correction)
{
    double heard_x[M] = {0}, heard_z[Q] = {0};
    for (int64_t arc = e->first_arc[i]; arc < e->first_arc[i + 1]; arc++) {
        Heard from = hear(e, p, arc, e->sender[arc]);
        for (int j = 0; j < M; j++)
            heard_x[j] += e->weight[arc] * from.estimate[j];
        if (e->innovation_weight)
            for (int j = 0; j < Q; j++)
                heard_z[j] += e->innovation_weight[arc] * from.innovation[j];
    }
    const double *xhat = estimate(e, p->slot, i), *z = innovation(e, p->slot, i);
    for (int j = 0; j < M; j++)
        disagreement[j] = e->own[i] * xhat[j] - heard_x[j];
    for (int j = 0; j < Q; j++)
        correction[j] = e->own_innovation[i] * z[j] - heard_z[j];
    if (e->leader_arc[i] >= 0) {
        const double *s = hear(e, p, e->leader_arc[i], e->fmus->n).estimate;
        for (int j = 0; j < M; j++)
            disagreement[j] -= e->leader[i] * s[j];
    }
}

static void copy(double *to, const double *from, int n)
{
    for (int j = 0; j < n; j++)
        to[j] = from[j];
}

static void record(const Engine *e, int64_t row, const Point *p, int64_t i, const double *u,
                   const double *sec_u)
{
    const int64_t at = row * e->fmus->n + i;
    const double *values = reading(e, p->k, i);
    if (e->xhat_rows)
        copy(e->xhat_rows + at * M, estimate(e, p->slot, i), M);
    if (e->u)
        copy(e->u + at * P, u, P);
    if (e->sec_u)
        copy(e->sec_u + at * P, sec_u, P);
    if (e->y)
        copy(e->y + at * Q, values, Q);
    if (e->x && e->shows_states)
        copy(e->x + at * M, values + Q, M);
}

static void note_lowest(const Engine *e, const Point *p, int64_t i, double t)
{
    const double *x = e->shows_states ? reading(e, p->k, i) + Q : estimate(e, p->slot, i);
    double lowest = x[0];
    for (int j = 1; j < M; j++)
        if (!(lowest <= x[j]))
            lowest = lowest != lowest ? lowest : x[j]; /* NaN stays */
    if (lowest < e->min_state[i]) {
        e->min_state[i] = lowest;
        e->min_time[i] = t;
    }
}

/* Whether state and estimate of agent i are finite and within the limit. */
static int within(const Engine *e, int64_t k, int64_t slot, int64_t i)
{
    const double *xhat = estimate(e, slot, i), *x = reading(e, k, i) + Q;
    int good = 1;
    for (int j = 0; j < M; j++) {
        good &= fabs(xhat[j]) <= e->limit;
        if (e->shows_states)
            good &= fabs(x[j]) <= e->limit;
    }
    return good;
}

/* Read the FMU at point k and compare with the estimate, which is there already. */
static int read(const Engine *e, int64_t k, int64_t slot, int64_t i, double *scratch,
                Report *report)
{
    if (!fmus_read(e->fmus, i, reading(e, k, i), scratch, report))
        return 0;
    controller_innovation(e->controller, reading(e, k, i), estimate(e, slot, i),
                          innovation(e, slot, i));
    return 1;
}

/* ---- all agents of one thread ---------------------------------------------------------------- */

/* ---- all agents of one thread ---------------------------------------------------------------- */

/* Read all FMUs at the point where the run begins. */
static void read_first(const Engine *e, const Member *me, const Point *p, Signal *signal)
{
    *signal = (Signal){0};
    for (int64_t i = me->first; i < me->end; i++)
        if (!read(e, p->k, p->slot, i, me->scratch, me->report))
            signal->failed = 1;
        else if (!within(e, p->k, p->slot, i))
            signal->diverging = 1;
}

/* Control and record at a point; if `go`, step to the next one and read there. */
static void advance(const Engine *e, const Member *me, const Point *p, int64_t row, int go,
                    Signal *signal)
{
    const double t = time_of(e, p->k);
    const int64_t next = p->slot + 1 < e->slots ? p->slot + 1 : 0;
    int steps = go;
    *signal = (Signal){0};
    for (int64_t i = me->first; i < me->end; i++) {
        double disagreement[M], correction[Q], u[P], sec_u[P];
        gather(e, p, i, disagreement, correction);
        controller_input(e->controller, disagreement, u, sec_u);
        record(e, row, p, i, u, sec_u);
        note_lowest(e, p, i, t);
        if (!steps)
            continue;
        if (!fmus_step(e->fmus, i, t, e->controller->h, u, me->scratch, me->report)) {
            signal->failed = 1;
            steps = 0; /* the rest of this point is recorded */
            continue;
        }
        controller_observe(e->controller, t, sec_u, correction, estimate(e, p->slot, i),
                           estimate(e, next, i));
        if (!read(e, p->k + 1, next, i, me->scratch, me->report))
            signal->failed = 1;
        else if (!within(e, p->k + 1, next, i))
            signal->diverging = 1;
    }
    if (me->id != 0)
        return;
    const double *s = estimate(e, p->slot, e->fmus->n);
    if (e->s)
        copy(e->s + row * M, s, M);
    if (e->time)
        e->time[row] = t;
    if (go)
        controller_leader(e->controller, t, s, estimate(e, next, e->fmus->n));
    signal->halt = __atomic_load_n(&e->halt, __ATOMIC_ACQUIRE) != 0;
}

/* Wait for the others; what any of them says. */
static Signal meet(Team *team, int64_t k)
{
    barrier_wait(&team->barrier, team->e->threads);
    Signal all = {0};
    for (int64_t id = 0; id < team->e->threads; id++) {
        const Signal *one = &team->signals[k & 1][id];
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
    Point p = {e->k, e->k % e->slots, e->arrivals};
    Signal all = {0};
    if (!e->ready) {
        read_first(e, me, &p, &team->signals[(p.k + 1) & 1][me->id]);
        all = meet(team, p.k + 1);
        me->diverging = all.diverging;
    }
    while (!all.failed && !all.halt && p.k < e->until) {
        const int go = !me->diverging && p.k < e->steps;
        advance(e, me, &p, p.k - e->k, go, &team->signals[p.k & 1][me->id]);
        all = meet(team, p.k);
        me->k = p.k + 1;
        if (!go) {
            me->ended = me->diverging ? DIVERGED : COMPLETE;
            return;
        }
        me->diverging = all.diverging;
        p.k++;
        p.slot = p.slot + 1 < e->slots ? p.slot + 1 : 0;
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
    Team team = {.e = e};
    Member members[MAX_THREADS];
    const int64_t n = e->fmus->n;
    int64_t started = 1;
    e->rows = 0;
    for (int64_t id = 0; id < e->threads; id++) {
        e->reports[id] = (Report){0};
        members[id] = (Member){.team = &team,
                               .id = id,
                               .first = n * id / e->threads,
                               .end = n * (id + 1) / e->threads,
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
    const int stepped = me->ended == GOES_ON || (me->ended == FAILED && call >= CALL_GET);
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
