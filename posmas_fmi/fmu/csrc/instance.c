/* One instance of the model: creation, modes, values, state. No global state: instances are
 * independent of each other and may run in different threads. */
#include "instance.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "advance.h"

/* Times of the importer and of the instance may differ by rounding, and by no part of a step that
 * would matter. */
static double time_slack(double t, double step)
{
    return 1e-12 * fmax(1, fabs(t)) + 1e-6 * step;
}

/* ---- messages ---------------------------------------------------------------------------- */

void instance_log(const Instance *c, Status status, const char *format, ...)
{
    static const char *const category[] = {"logAll", "logStatusWarning", "logStatusDiscard",
                                           "logStatusError", "logStatusFatal"};
    char message[400];
    va_list args;
    if (!c->callback)
        return;
    va_start(args, format);
    vsnprintf(message, sizeof message, format, args);
    va_end(args);
    for (char *at = message; *at; at++)
        if (*at == '%')
            *at = '_'; /* FMI 2 importers take the message as a format */
    c->log(c, status, category[status], message);
}

static const char *mode_name(unsigned mode)
{
    switch (mode) {
    case MODE_INSTANTIATED: return "Instantiated";
    case MODE_INITIALISING: return "Initialization Mode";
    case MODE_EVENT: return "Event Mode";
    case MODE_CONTINUOUS: return "Continuous-Time Mode";
    case MODE_STEP: return "Step Mode";
    case MODE_TERMINATED: return "Terminated";
    default: return "a failed state (restore a state, reset or free the instance)";
    }
}

Status instance_expect(const Instance *c, const char *call, unsigned modes)
{
    if (c->state.mode & modes)
        return STATUS_OK;
    instance_log(c, STATUS_ERROR, "%s is not allowed in %s", call, mode_name(c->state.mode));
    return STATUS_ERROR;
}

/* ---- life -------------------------------------------------------------------------------- */

void instance_reset(Instance *c)
{
    memset(&c->state, 0, sizeof c->state);
    memcpy(c->state.v, model_start, sizeof c->state.v);
    c->state.tolerance = TOLERANCE_DEFAULT;
    c->state.stop_time = HUGE_VAL;
    c->state.mode = MODE_INSTANTIATED;
}

Instance *instance_new(const Instance *first, const char *token, Kind kind, int arrays)
{
    if (!token || strcmp(token, MODEL_TOKEN) != 0) {
        instance_log(first, STATUS_ERROR,
                     "the %s in the model description (%s) is not that of this binary (%s)",
                     arrays ? "instantiationToken" : "GUID", token ? token : "NULL", MODEL_TOKEN);
        return NULL;
    }
    if (!first->name || !*first->name) {
        instance_log(first, STATUS_ERROR, "the instance name is missing");
        return NULL;
    }
    if (MODEL_SAMPLED && kind == MODEL_EXCHANGE) {
        instance_log(first, STATUS_ERROR, "this FMU has no Model Exchange");
        return NULL;
    }
    size_t length = strlen(first->name) + 1;
    Instance *c = calloc(1, sizeof *c + length);
    if (!c) {
        instance_log(first, STATUS_ERROR, "out of memory");
        return NULL;
    }
    *c = *first;
    c->name = (char *)(c + 1);
    memcpy(c->name, first->name, length);
    c->kind = kind;
    c->arrays = arrays;
    instance_reset(c);
    return c;
}

void instance_free(Instance *c)
{
    free(c);
}

Status instance_setup(Instance *c, double start, double tolerance, double stop_time)
{
    State *s = &c->state;
    if (!isfinite(start) || !(stop_time >= start) || !isfinite(tolerance)) {
        instance_log(c, STATUS_ERROR,
                     "expected finite times start <= stop and a tolerance (got %g, %g, %g)", start,
                     stop_time, tolerance);
        return STATUS_ERROR;
    }
    s->v[AT_TIME] = start;
    s->stop_time = stop_time;
    if (tolerance > 0)
        s->tolerance = fmin(TOLERANCE_MAX, fmax(TOLERANCE_MIN, tolerance));
    s->dx_known = s->y_known = 0;
    return STATUS_OK;
}

Status instance_initialise(Instance *c)
{
    if (instance_expect(c, "EnterInitializationMode", MODE_INSTANTIATED) != STATUS_OK)
        return STATUS_ERROR;
    c->state.mode = MODE_INITIALISING;
    return STATUS_OK;
}

Status instance_initialised(Instance *c)
{
    if (instance_expect(c, "ExitInitializationMode", MODE_INITIALISING) != STATUS_OK)
        return STATUS_ERROR;
#if MODEL_SAMPLED
    double *v = c->state.v;
    const char *why = model_begin(v + AT_P, v + AT_U, v + AT_X);
    if (why) {
        instance_log(c, STATUS_ERROR, "it cannot start: %s", why);
        return STATUS_ERROR;
    }
    c->state.y_known = 0;
#endif
    c->state.mode = c->kind == CO_SIMULATION ? MODE_STEP : MODE_EVENT;
    return STATUS_OK;
}

Status instance_terminate(Instance *c)
{
    if (instance_expect(c, "Terminate", MODE_RUNNING) != STATUS_OK)
        return STATUS_ERROR;
    c->state.mode = MODE_TERMINATED;
    return STATUS_OK;
}

/* ---- values ------------------------------------------------------------------------------ */

static Status expect_finite(const Instance *c, unsigned at, unsigned n, Status status)
{
    for (unsigned i = at; i < at + n; i++)
        if (!isfinite(c->state.v[i])) {
            instance_log(c, status, "%s is not finite (%g) at time %.17g", model_name[i],
                         c->state.v[i], c->state.v[AT_TIME]);
            return status;
        }
    return STATUS_OK;
}

static void know_derivatives(Instance *c)
{
#if MODEL_SAMPLED
    (void)c; /* it has none */
#else
    double *v = c->state.v;
    if (c->state.dx_known)
        return;
    model_derivatives(v[AT_TIME], v + AT_P, v + AT_U, v + AT_X, v + AT_DX);
    c->state.dx_known = 1;
#endif
}

static void know_outputs(Instance *c)
{
    double *v = c->state.v;
    if (c->state.y_known)
        return;
#if MODEL_SAMPLED
    if (c->state.mode == MODE_INITIALISING)
        model_begin(v + AT_P, v + AT_U, v + AT_X); /* with what is set by now */
#endif
    model_outputs(v[AT_TIME], v + AT_P, v + AT_U, v + AT_X, v + AT_Y);
    c->state.y_known = 1;
}

/* Number of elements that a value reference stands for; 0: there is no such variable. */
static size_t width(const Instance *c, uint32_t vr)
{
    if (vr >= MODEL_NV)
        return 0;
    return c->arrays ? model_size[vr] : 1;
}

static Status unknown_reference(const Instance *c, uint32_t vr)
{
    instance_log(c, STATUS_ERROR, "there is no variable with value reference %lu",
                 (unsigned long)vr);
    return STATUS_ERROR;
}

static Status wrong_count(const Instance *c, size_t got)
{
    instance_log(c, STATUS_ERROR, "the number of values (%lu) is not that of the variables",
                 (unsigned long)got);
    return STATUS_ERROR;
}

Status instance_get(Instance *c, const uint32_t vr[], size_t n, double value[], size_t n_values)
{
    size_t done = 0;
    Status status = STATUS_OK;
    for (size_t i = 0; i < n; i++) {
        size_t size = width(c, vr[i]);
        if (size == 0)
            return unknown_reference(c, vr[i]);
        if (size > n_values - done)
            return wrong_count(c, n_values);
        if (vr[i] >= AT_Y)
            know_outputs(c);
        else if (vr[i] >= AT_DX)
            know_derivatives(c);
        int finite = 1; /* few values: a loop is quicker than memcpy */
        for (size_t j = 0; j < size; j++) {
            value[done + j] = c->state.v[vr[i] + j];
            finite &= isfinite(value[done + j]) != 0;
        }
        if (!finite)
            status = expect_finite(c, vr[i], (unsigned)size, STATUS_ERROR);
        done += size;
    }
    return done == n_values ? status : wrong_count(c, n_values);
}

/* Whether the importer may set this variable in the present mode. */
static int settable(const Instance *c, uint32_t vr)
{
    switch (c->state.mode) {
    case MODE_INSTANTIATED:
    case MODE_INITIALISING: return vr >= AT_P && vr < AT_DX - MODEL_NM;
    case MODE_EVENT:
    case MODE_STEP: return vr >= AT_P && vr < AT_X;
    case MODE_CONTINUOUS: return vr >= AT_U && vr < AT_X;
    default: return 0;
    }
}

Status instance_set(Instance *c, const uint32_t vr[], size_t n, const double value[],
                    size_t n_values)
{
    size_t done = 0;
    for (size_t i = 0; i < n; i++) {
        size_t size = width(c, vr[i]);
        if (size == 0)
            return unknown_reference(c, vr[i]);
        if (size > n_values - done)
            return wrong_count(c, n_values);
        if (!settable(c, vr[i])) {
            instance_log(c, STATUS_ERROR, "%s cannot be set in %s", model_name[vr[i]],
                         mode_name(c->state.mode));
            return STATUS_ERROR;
        }
        for (size_t j = 0; j < size; j++)
            if (!isfinite(value[done + j])) {
                instance_log(c, STATUS_ERROR, "%s must be finite (got %g)", model_name[vr[i] + j],
                             value[done + j]);
                return STATUS_ERROR;
            }
        /* Setting a value again leaves what is known of the derivatives as it is. */
        for (size_t j = 0; j < size; j++) {
            double *to = &c->state.v[vr[i] + j];
            if (memcmp(to, &value[done + j], sizeof *to) == 0)
                continue;
            *to = value[done + j];
            c->state.dx_known = c->state.y_known = 0;
        }
        done += size;
    }
    return done == n_values ? STATUS_OK : wrong_count(c, n_values);
}

#if MODEL_SAMPLED

Status instance_directional(Instance *c, const uint32_t unknown[], size_t n_unknown,
                            const uint32_t known[], size_t n_known, const double seed[],
                            size_t n_seed, double result[], size_t n_result)
{
    (void)unknown, (void)n_unknown, (void)known, (void)n_known, (void)seed, (void)n_seed;
    (void)result, (void)n_result;
    instance_log(c, STATUS_ERROR, "this FMU has no directional derivatives");
    return STATUS_ERROR;
}

#else

Status instance_directional(Instance *c, const uint32_t unknown[], size_t n_unknown,
                            const uint32_t known[], size_t n_known, const double seed[],
                            size_t n_seed, double result[], size_t n_result)
{
    const double *v = c->state.v;
    double su[MODEL_NU_ROOM] = {0}, sx[MODEL_NX_ROOM] = {0};
    double sdx[MODEL_NX_ROOM], sy[MODEL_NY_ROOM];
    size_t done = 0;
    for (size_t i = 0; i < n_known; i++) {
        size_t size = width(c, known[i]);
        if (size == 0)
            return unknown_reference(c, known[i]);
        if (known[i] < AT_U || known[i] >= AT_DX) {
            instance_log(c, STATUS_ERROR, "no derivative with respect to %s is provided",
                         model_name[known[i]]);
            return STATUS_ERROR;
        }
        if (size > n_seed - done)
            return wrong_count(c, n_seed);
        double *to = known[i] < AT_X ? su + (known[i] - AT_U) : sx + (known[i] - AT_X);
        memcpy(to, seed + done, size * sizeof *seed);
        done += size;
    }
    if (done != n_seed)
        return wrong_count(c, n_seed);
    model_directional(v[AT_TIME], v + AT_P, v + AT_U, v + AT_X, su, sx, sdx, sy);
    done = 0;
    for (size_t i = 0; i < n_unknown; i++) {
        size_t size = width(c, unknown[i]);
        if (size == 0)
            return unknown_reference(c, unknown[i]);
        if (unknown[i] < AT_DX) {
            instance_log(c, STATUS_ERROR, "no derivative of %s is provided",
                         model_name[unknown[i]]);
            return STATUS_ERROR;
        }
        if (size > n_result - done)
            return wrong_count(c, n_result);
        const double *from = unknown[i] < AT_Y ? sdx + (unknown[i] - AT_DX)
                                               : sy + (unknown[i] - AT_Y);
        for (size_t j = 0; j < size; j++)
            if (!isfinite(from[j])) {
                instance_log(c, STATUS_ERROR, "%s has no finite derivative at time %.17g",
                             model_name[unknown[i] + j], v[AT_TIME]);
                return STATUS_ERROR;
            }
        memcpy(result + done, from, size * sizeof *result);
        done += size;
    }
    return done == n_result ? STATUS_OK : wrong_count(c, n_result);
}

#endif

/* ---- Co-Simulation ----------------------------------------------------------------------- */

Status instance_step(Instance *c, double time, double step)
{
    State *s = &c->state;
    if (instance_expect(c, "DoStep", MODE_STEP) != STATUS_OK)
        return STATUS_ERROR;
    if (!isfinite(time) || !isfinite(step) || step <= 0 || !(time + step > time)) {
        instance_log(c, STATUS_ERROR,
                     "expected a communication point and a step > 0 (got %.17g, %.17g)", time,
                     step);
        return STATUS_ERROR;
    }
    if (fabs(time - s->v[AT_TIME]) > time_slack(time, step)) {
        instance_log(c, STATUS_ERROR, "DoStep from %.17g, but the instance is at %.17g", time,
                     s->v[AT_TIME]);
        return STATUS_ERROR;
    }
    if (time + step > s->stop_time + time_slack(time, step)) {
        instance_log(c, STATUS_ERROR, "DoStep to %.17g, beyond the stop time %.17g", time + step,
                     s->stop_time);
        return STATUS_ERROR;
    }
    if (time < s->v[AT_TIME] || time > s->v[AT_TIME]) {
        s->v[AT_TIME] = time;
        s->dx_known = 0;
    }
    const char *why = instance_advance(c, time + step);
    s->y_known = 0;
    if (why) {
        instance_log(c, STATUS_ERROR, "the step from %.17g to %.17g failed: %s", time, time + step,
                     why);
        s->mode = MODE_FAILED;
        return STATUS_ERROR;
    }
    return STATUS_OK;
}

/* ---- Model Exchange ---------------------------------------------------------------------- */

static Status right_count(const Instance *c, size_t n)
{
    return n == MODEL_NX ? STATUS_OK : wrong_count(c, n);
}

Status instance_set_time(Instance *c, double time)
{
    if (instance_expect(c, "SetTime", MODE_EVENT | MODE_CONTINUOUS) != STATUS_OK)
        return STATUS_ERROR;
    if (!isfinite(time)) {
        instance_log(c, STATUS_ERROR, "expected a finite time (got %g)", time);
        return STATUS_ERROR;
    }
    c->state.v[AT_TIME] = time;
    c->state.dx_known = c->state.y_known = 0;
    return STATUS_OK;
}

Status instance_set_states(Instance *c, const double x[], size_t n)
{
    if (instance_expect(c, "SetContinuousStates", MODE_CONTINUOUS) != STATUS_OK ||
        right_count(c, n) != STATUS_OK)
        return STATUS_ERROR;
    for (size_t i = 0; i < n; i++)
        if (!isfinite(x[i])) {
            instance_log(c, STATUS_DISCARD, "%s must be finite (got %g)", model_name[AT_X + i],
                         x[i]);
            return STATUS_DISCARD;
        }
    memcpy(c->state.v + AT_X, x, n * sizeof *x);
    c->state.dx_known = c->state.y_known = 0;
    return STATUS_OK;
}

Status instance_get_states(Instance *c, double x[], size_t n)
{
    if (right_count(c, n) != STATUS_OK)
        return STATUS_ERROR;
    memcpy(x, c->state.v + AT_X, n * sizeof *x);
    return STATUS_OK;
}

Status instance_get_derivatives(Instance *c, double dx[], size_t n)
{
    if (right_count(c, n) != STATUS_OK)
        return STATUS_ERROR;
    know_derivatives(c);
    memcpy(dx, c->state.v + AT_DX, n * sizeof *dx);
    /* Discard: the importer may try a shorter step. */
    return expect_finite(c, AT_DX, MODEL_NX, STATUS_DISCARD);
}

Status instance_get_nominals(Instance *c, double nominal[], size_t n)
{
    if (right_count(c, n) != STATUS_OK)
        return STATUS_ERROR;
    memcpy(nominal, model_nominal, n * sizeof *nominal);
    return STATUS_OK;
}

/* ---- the whole state --------------------------------------------------------------------- */

/* Serialised: the token (so that the bytes cannot be given to another model), then the state. */
#define TOKEN_SIZE (sizeof MODEL_TOKEN)

Status instance_save(const Instance *c, State **slot)
{
    if (!*slot)
        *slot = malloc(sizeof **slot);
    if (!*slot) {
        instance_log(c, STATUS_ERROR, "out of memory");
        return STATUS_ERROR;
    }
    **slot = c->state;
    return STATUS_OK;
}

Status instance_restore(Instance *c, const State *saved)
{
    if (!saved) {
        instance_log(c, STATUS_ERROR, "there is no saved state");
        return STATUS_ERROR;
    }
    c->state = *saved;
    return STATUS_OK;
}

size_t instance_serialised_size(void)
{
    return TOKEN_SIZE + sizeof(State);
}

Status instance_serialise(const Instance *c, const State *saved, char bytes[], size_t size)
{
    if (!saved || size < instance_serialised_size()) {
        instance_log(c, STATUS_ERROR, "expected a saved state and room for %lu bytes (got %lu)",
                     (unsigned long)instance_serialised_size(), (unsigned long)size);
        return STATUS_ERROR;
    }
    memcpy(bytes, MODEL_TOKEN, TOKEN_SIZE);
    memcpy(bytes + TOKEN_SIZE, saved, sizeof *saved);
    return STATUS_OK;
}

Status instance_deserialise(const Instance *c, const char bytes[], size_t size, State **slot)
{
    if (size != instance_serialised_size() || memcmp(bytes, MODEL_TOKEN, TOKEN_SIZE) != 0) {
        instance_log(c, STATUS_ERROR, "these bytes are not a serialised state of this model");
        return STATUS_ERROR;
    }
    Status status = instance_save(c, slot);
    if (status == STATUS_OK)
        memcpy(*slot, bytes + TOKEN_SIZE, sizeof **slot);
    return status;
}
