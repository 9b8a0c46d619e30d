/* Calls into FMUs: every status and every value that is read is checked. */
#include "fmus.h"

#include <float.h>
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <string.h>

#include "export.h"

typedef int Get2(void *, const uint32_t[], size_t, double[]);
typedef int Set2(void *, const uint32_t[], size_t, const double[]);
typedef int Step2(void *, double, double, int);
typedef int BooleanStatus2(void *, int, int *);
typedef int RealStatus2(void *, int, double *);
typedef int SetRates2(void *, const uint32_t[], size_t, const int32_t[], const double[]);
typedef int Get3(void *, const uint32_t[], size_t, double[], size_t);
typedef int Set3(void *, const uint32_t[], size_t, const double[], size_t);
typedef int Step3(void *, double, double, bool, bool *, bool *, bool *, double *);

enum { OK, WARNING, DISCARD };
enum { LAST_SUCCESSFUL_TIME = 2, TERMINATED }; /* fmi2StatusKind */
enum { MOST_RETURNS = 100000 }; /* before the end of one step */
#define SAME 1e-9               /* of a step: times that are the same */

static int64_t said(const Fmus *f)
{
    return f->messages ? __atomic_load_n(&f->messages->written, __ATOMIC_ACQUIRE) : 0;
}

static void begin(const Fmus *f, Call call, int64_t instance)
{
    Calling *c = f->calling;
    if (!c)
        return;
    c->call = call;
    c->instance = instance;
    __atomic_store_n(&c->begun, c->begun + 1, __ATOMIC_RELEASE);
}

static int fail(Report *report, Incident incident)
{
    if (!report->failure.call || incident_before(&incident, &report->failure))
        report->failure = incident;
    return 0;
}

/* A status other than OK: note it; whether the run goes on. */
static int odd(int status, Call call, int64_t instance, int64_t before, Report *report)
{
    Incident incident = {.call = call, .instance = instance, .status = status, .said = before};
    if (status != WARNING)
        return fail(report, incident);
    if (!report->warnings++)
        report->warning = incident;
    return 1;
}

static int get(const Binding *b, void *component, const Ports *p, double *values)
{
    size_t n = (size_t)p->n_references;
    if (!n)
        return OK;
    if (b->fmi == 2)
        return ((Get2 *)b->get)(component, p->references, n, values);
    return ((Get3 *)b->get)(component, p->references, n, values, (size_t)p->n_values);
}

static int set(const Binding *b, void *component, const Ports *p, const double *values)
{
    size_t n = (size_t)p->n_references;
    if (!n)
        return OK;
    if (b->fmi == 2)
        return ((Set2 *)b->set)(component, p->references, n, values);
    return ((Set3 *)b->set)(component, p->references, n, values, (size_t)p->n_values);
}

/* The values of an exchange from the inputs; false: those beside them could not be read. */
static int convert(const Fmus *f, const Binding *b, int64_t instance, const double *inputs,
                   double *values, Report *report)
{
    const Ports *p = &b->inputs;
    if (p->partial) {
        const int64_t before = said(f);
        begin(f, CALL_GET_BEFORE_SET, instance);
        const int status = get(b, f->component[instance], p, values);
        if (status != OK && !odd(status, CALL_GET_BEFORE_SET, instance, before, report))
            return 0;
    }
    for (int64_t k = 0; k < p->n_ports; k++)
        values[p->places ? p->places[k] : k] =
            p->scale ? inputs[k] * p->scale[k] + p->offset[k] : inputs[k];
    return 1;
}

/* Whether an FMU of FMI 2 that returned Discard asks to end the simulation, and where it is. */
static int asks_to_end(const Binding *b, void *component, double *reached)
{
    int terminated = 0;
    if (!b->boolean_status ||
        ((BooleanStatus2 *)b->boolean_status)(component, TERMINATED, &terminated) != OK)
        return 0;
    if (terminated && b->real_status)
        ((RealStatus2 *)b->real_status)(component, LAST_SUCCESSFUL_TIME, reached);
    return terminated != 0;
}

/* How fast the inputs change, for an FMU of FMI 2. */
static int set_rates(const Fmus *f, const Binding *b, int64_t instance, const double *rates,
                     Report *report)
{
    const int64_t before = said(f);
    begin(f, CALL_SET_RATES, instance);
    const int status = ((SetRates2 *)b->set_rates)(f->component[instance], b->rate_references,
                                                   (size_t)b->n_rates, b->rate_orders, rates);
    return status == OK || odd(status, CALL_SET_RATES, instance, before, report);
}

static int step_2(const Fmus *f, const Binding *b, int64_t instance, double t, double h,
                  Report *report)
{
    void *component = f->component[instance];
    const int64_t before = said(f);
    begin(f, CALL_STEP, instance);
    const int status = ((Step2 *)b->do_step)(component, t, h, 0);
    if (status == OK)
        return 1;
    double reached = t;
    if (status == DISCARD && asks_to_end(b, component, &reached))
        return fail(report, (Incident){.call = CALL_STEP_TERMINATED,
                                       .instance = instance,
                                       .value = reached});
    return odd(status, CALL_STEP, instance, before, report);
}

/* What an FMU of FMI 3 says after a step. */
typedef struct {
    int status;
    bool event, terminate, early;
    double reached;
} After;

static inline After do_step_3(const Binding *b, void *component, double t, double h)
{
    After after = {.reached = t};
    after.status = ((Step3 *)b->do_step)(component, t, h, false, &after.event, &after.terminate,
                                         &after.early, &after.reached);
    return after;
}

/* The rest of a step over h from t that was not simply done. */
static __attribute__((noinline, cold)) int go_on_3(const Fmus *f, const Binding *b,
                                                   int64_t instance, double t, double h,
                                                   int64_t before, After after, Report *report)
{
    double begin_at = t;
    for (int64_t returns = 0;; returns++) {
        if (after.status != OK && !odd(after.status, CALL_STEP, instance, before, report))
            return 0;
        if (!after.terminate && !after.early)
            return 1;
        const double reached = after.reached;
        const int inside = reached >= begin_at && reached <= t + h + SAME * h; /* not of NaN */
        if (after.terminate || !inside || returns == MOST_RETURNS) {
            const Call call = after.terminate ? CALL_STEP_TERMINATED : CALL_STEP_EARLY;
            const double value = after.terminate && !inside ? begin_at : reached;
            return fail(report, (Incident){.call = call, .instance = instance, .value = value});
        }
        if (reached >= t + h - SAME * h)
            return 1;
        begin_at = reached; /* go on to the end of the step */
        after = do_step_3(b, f->component[instance], begin_at, t + h - reached);
    }
}

static int step_3(const Fmus *f, const Binding *b, int64_t instance, double t, double h,
                  Report *report)
{
    const int64_t before = said(f);
    begin(f, CALL_STEP, instance);
    const After after = do_step_3(b, f->component[instance], t, h);
    if (after.status == OK && !after.terminate && !after.early)
        return 1;
    return go_on_3(f, b, instance, t, h, before, after, report);
}

int fmus_step(const Fmus *f, int64_t instance, double t, double h, const double *inputs,
              double *scratch, Report *report)
{
    const Binding *b = &f->bindings[f->binding[instance]];
    const double *values = inputs;
    if (b->inputs.places || b->inputs.scale) {
        if (!convert(f, b, instance, inputs, scratch, report))
            return 0;
        values = scratch;
    }
    const int64_t before = said(f);
    begin(f, CALL_SET, instance);
    const int status = set(b, f->component[instance], &b->inputs, values);
    if (status != OK && !odd(status, CALL_SET, instance, before, report))
        return 0;
    if (b->n_rates && b->set_rates &&
        !set_rates(f, b, instance, inputs + b->inputs.n_ports, report))
        return 0;
    return b->fmi == 2 ? step_2(f, b, instance, t, h, report)
                       : step_3(f, b, instance, t, h, report);
}

static int all_finite(const double *values, int64_t n)
{
    int finite = 1; /* a bit to each: no branch */
    for (int64_t k = 0; k < n; k++)
        finite &= fabs(values[k]) <= DBL_MAX;
    return finite;
}

int fmus_read(const Fmus *f, int64_t instance, double *values, double *scratch, Report *report)
{
    if (fmus_is_remote(f, instance))
        return f->remote->read(f->remote->context, instance, values, report);
    const Binding *b = &f->bindings[f->binding[instance]];
    const Ports *p = &b->readings;
    const int direct = !p->places && !p->scale;
    const int64_t before = said(f);
    begin(f, CALL_GET, instance);
    const int status = get(b, f->component[instance], p, direct ? values : scratch);
    if (status != OK && !odd(status, CALL_GET, instance, before, report))
        return 0;
    if (direct && all_finite(values, p->n_ports))
        return 1;
    for (int64_t k = 0; k < p->n_ports; k++) {
        const double value = direct ? values[k] : scratch[p->places ? p->places[k] : k];
        if (!isfinite(value))
            return fail(report, (Incident){.call = CALL_NOT_FINITE,
                                           .instance = instance,
                                           .port = k,
                                           .value = value});
        if (!direct)
            values[k] = p->scale ? (value - p->offset[k]) / p->scale[k] : value;
    }
    return 1;
}

int incident_before(const Incident *a, const Incident *b)
{
    const int a_read = a->call == CALL_GET || a->call == CALL_NOT_FINITE;
    const int b_read = b->call == CALL_GET || b->call == CALL_NOT_FINITE;
    return a_read != b_read ? b_read : a->instance < b->instance;
}

/* ---- many instances in one call, for a loop that is not in C --------------------------------- */

/* Whether to go on with other instances after one that failed: where `incidents`, one of each
 * instance, are wanted. NULL: the first failure ends it, and so does an FMU that asks for the end. */
static int goes_on(Incident *incidents, int64_t instance, Report *report)
{
    if (!incidents || report->failure.call == CALL_STEP_TERMINATED)
        return 0;
    incidents[instance] = report->failure;
    report->failure.call = CALL_NONE;
    return 1;
}

/* Step the instances numbered `which`, each from its own time over its own step, and read each
 * where it then is. When one cannot be stepped, those after it are not; reading goes on. */
EXPORT void fmus_step_all(const Fmus *f, const int64_t *which, int64_t n, const double *t,
                          const double *h, const double *inputs, double *readings,
                          double *scratch, Report *report, Incident *incidents)
{
    int64_t posted = 0;
    for (int64_t k = 0; k < n; k++) {
        const int64_t i = which[k];
        if (fmus_is_remote(f, i)) {
            f->remote->post(f->remote->context, i, t[k], h[k], inputs + f->input_at[i]);
            posted++;
            continue;
        }
        fmus_expect(f, i + 1);
        if (!fmus_step(f, i, t[k], h[k], inputs + f->input_at[i], scratch, report)) {
            if (!goes_on(incidents, i, report))
                break;
        } else if (!fmus_read(f, i, readings + f->reading_at[i], scratch, report)) {
            goes_on(incidents, i, report);
        }
    }
    if (!posted)
        return;
    f->remote->send(f->remote->context);
    for (int64_t k = 0; k < n; k++)
        if (fmus_is_remote(f, which[k]) &&
            !f->remote->wait(f->remote->context, which[k], readings + f->reading_at[which[k]],
                             report))
            goes_on(incidents, which[k], report);
}

EXPORT void fmus_read_all(const Fmus *f, const int64_t *which, int64_t n, double *readings,
                          double *scratch, Report *report, Incident *incidents)
{
    for (int64_t k = 0; k < n; k++)
        if (!fmus_read(f, which[k], readings + f->reading_at[which[k]], scratch, report) &&
            !goes_on(incidents, which[k], report))
            return;
}
