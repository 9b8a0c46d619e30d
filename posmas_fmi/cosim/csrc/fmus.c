/* Calls into FMUs: every status and every value that is read is checked. */
#include "fmus.h"

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

int fmus_step(const Fmus *f, int64_t instance, double t, double h, const double *inputs,
              double *scratch, Report *report)
{
    const Binding *b = &f->bindings[f->binding[instance]];
    void *component = f->component[instance];
    const double *rates = inputs + b->inputs.n_ports;
    if (b->inputs.places || b->inputs.scale) {
        if (!convert(f, b, instance, inputs, scratch, report))
            return 0;
        inputs = scratch;
    }
    int64_t before = said(f);
    begin(f, CALL_SET, instance);
    int status = set(b, component, &b->inputs, inputs);
    if (status != OK && !odd(status, CALL_SET, instance, before, report))
        return 0;
    if (b->n_rates && b->set_rates) {
        before = said(f);
        begin(f, CALL_SET_RATES, instance);
        status = ((SetRates2 *)b->set_rates)(component, b->rate_references, (size_t)b->n_rates,
                                             b->rate_orders, rates);
        if (status != OK && !odd(status, CALL_SET_RATES, instance, before, report))
            return 0;
    }
    before = said(f);
    begin(f, CALL_STEP, instance);
    if (b->fmi == 2) {
        status = ((Step2 *)b->do_step)(component, t, h, 0);
        double reached = t;
        if (status == DISCARD && asks_to_end(b, component, &reached))
            return fail(report, (Incident){.call = CALL_STEP_TERMINATED,
                                           .instance = instance,
                                           .value = reached});
        return status == OK || odd(status, CALL_STEP, instance, before, report);
    }
    double begin_at = t, length = h;
    for (int64_t returns = 0;; returns++) {
        bool event = false, terminate = false, early = false;
        double reached = begin_at;
        status = ((Step3 *)b->do_step)(component, begin_at, length, false, &event, &terminate,
                                       &early, &reached);
        if (status != OK && !odd(status, CALL_STEP, instance, before, report))
            return 0;
        const int inside = reached >= begin_at && reached <= t + h + SAME * h; /* not of NaN */
        if (terminate || (early && (!inside || returns == MOST_RETURNS))) {
            const Call call = terminate ? CALL_STEP_TERMINATED : CALL_STEP_EARLY;
            const double value = terminate && !inside ? begin_at : reached;
            return fail(report, (Incident){.call = call, .instance = instance, .value = value});
        }
        if (!early || reached >= t + h - SAME * h)
            return 1;
        begin_at = reached; /* go on to the end of the step */
        length = t + h - reached;
    }
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
