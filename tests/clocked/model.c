/* An FMI 3 Co-Simulation FMU with Event Mode: a sampler with a periodic clock, a countdown clock,
 * a time event, a discrete input; x' = y - x is integrated exactly. */
#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

enum { OK, ERROR = 3 };
enum { TIME, U, GAIN, Y, X, JUMPS, LEVEL, ALARMS, VALUES, CLOCK = 20, ALARM };
typedef struct {
    double v[VALUES];
    bool events, early, ticked, alarmed, alarm_set, in_event;
    double event_at;
} Sampler;

EXPORT void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *path,
                                         bool visible, bool logging, bool events, bool early,
                                         const uint32_t *required, size_t n, void *environment,
                                         void *log, void *update)
{
    (void)name, (void)token, (void)path, (void)visible, (void)logging, (void)required, (void)n;
    (void)environment, (void)log, (void)update;
    Sampler *s = calloc(1, sizeof *s);
    s->v[GAIN] = 1;
    s->events = events;
    s->early = early;
    s->event_at = 0.55;
    return s;
}

EXPORT void fmi3FreeInstance(void *c) { free(c); }

EXPORT int fmi3EnterInitializationMode(Sampler *s, bool tolerance_defined, double tolerance,
                                       double start, bool stop_defined, double stop)
{
    (void)tolerance_defined, (void)tolerance, (void)stop_defined, (void)stop;
    s->v[TIME] = start;
    return OK;
}

EXPORT int fmi3ExitInitializationMode(Sampler *s)
{
    s->in_event = s->events;
    return OK;
}

EXPORT int fmi3EnterEventMode(Sampler *s)
{
    if (s->in_event || !s->events)
        return ERROR;
    s->in_event = true;
    return OK;
}

EXPORT int fmi3EnterStepMode(Sampler *s)
{
    if (!s->in_event)
        return ERROR;
    s->in_event = false;
    return OK;
}

EXPORT int fmi3SetClock(Sampler *s, const uint32_t *references, size_t n, const bool *values)
{
    for (size_t k = 0; k < n; k++) {
        if (!s->in_event)
            return ERROR;
        if (references[k] == CLOCK)
            s->ticked = values[k];
        else
            s->alarmed = values[k];
    }
    return OK;
}

EXPORT int fmi3GetIntervalDecimal(Sampler *s, const uint32_t *references, size_t n,
                                  double *intervals, int *qualifiers)
{
    for (size_t k = 0; k < n; k++) {
        if (references[k] != ALARM)
            return ERROR;
        intervals[k] = 0.15;
        qualifiers[k] = s->alarm_set ? 2 : 1;
        s->alarm_set = false;
    }
    return OK;
}

/* y sums what u is when the clock ticks; at 0.55 s it jumps by 10, which sets the alarm */
EXPORT int fmi3UpdateDiscreteStates(Sampler *s, bool *again, bool *terminate, bool *nominals,
                                    bool *states, bool *defined, double *next)
{
    if (!s->in_event)
        return ERROR;
    *again = s->ticked;
    *terminate = *nominals = *states = false;
    if (s->ticked)
        s->v[Y] += s->v[GAIN] * s->v[U];
    if (s->alarmed)
        s->v[ALARMS] += 1;
    if (s->v[TIME] >= s->event_at - 1e-9) {
        s->v[JUMPS] += 1;
        s->v[Y] += 10;
        s->event_at = 1e9;
        s->alarm_set = true;
    }
    s->ticked = s->alarmed = false;
    *defined = s->event_at < 1e8;
    *next = s->event_at;
    return OK;
}

EXPORT int fmi3DoStep(Sampler *s, double t, double h, bool no_set, bool *event, bool *terminate,
                      bool *early, double *reached)
{
    (void)no_set;
    if (s->in_event || fabs(t - s->v[TIME]) > 1e-9)
        return ERROR;
    const double end = t + h;
    *event = s->events && s->event_at <= end + 1e-9;
    *terminate = false;
    *early = *event && s->early && s->event_at < end - 1e-9;
    *reached = *early ? s->event_at : end;
    s->v[X] = s->v[Y] + (s->v[X] - s->v[Y]) * exp(-(*reached - t));
    s->v[TIME] = *reached;
    return OK;
}

EXPORT int fmi3GetFloat64(Sampler *s, const uint32_t *references, size_t n, double *values,
                          size_t size)
{
    (void)size;
    for (size_t k = 0; k < n; k++)
        values[k] = s->v[references[k]];
    return OK;
}

EXPORT int fmi3SetFloat64(Sampler *s, const uint32_t *references, size_t n, const double *values,
                          size_t size)
{
    (void)size;
    for (size_t k = 0; k < n; k++) {
        if (references[k] == U && s->events && !s->in_event && s->v[TIME] > 0)
            return ERROR; /* a clocked variable, outside Event Mode */
        s->v[references[k]] = values[k];
    }
    return OK;
}

EXPORT int fmi3GetInt32(Sampler *s, const uint32_t *references, size_t n, int32_t *values,
                        size_t size)
{
    (void)size;
    for (size_t k = 0; k < n; k++)
        values[k] = (int32_t)s->v[references[k]];
    return OK;
}

EXPORT int fmi3SetInt32(Sampler *s, const uint32_t *references, size_t n, const int32_t *values,
                        size_t size)
{
    (void)size;
    for (size_t k = 0; k < n; k++)
        s->v[references[k]] = values[k];
    return OK;
}

EXPORT int fmi3GetFMUState(Sampler *s, Sampler **state)
{
    *state = *state ? *state : malloc(sizeof **state);
    **state = *s;
    return OK;
}

EXPORT int fmi3SetFMUState(Sampler *s, const Sampler *state)
{
    *s = *state;
    return OK;
}

EXPORT int fmi3FreeFMUState(Sampler *s, Sampler **state)
{
    (void)s;
    free(*state);
    *state = NULL;
    return OK;
}

EXPORT int fmi3SerializedFMUStateSize(Sampler *s, const Sampler *state, size_t *size)
{
    (void)s, (void)state;
    *size = sizeof *state;
    return OK;
}

EXPORT int fmi3SerializeFMUState(Sampler *s, const Sampler *state, uint8_t *bytes, size_t size)
{
    (void)s;
    memcpy(bytes, state, size);
    return OK;
}

EXPORT int fmi3DeserializeFMUState(Sampler *s, const uint8_t *bytes, size_t size, Sampler **state)
{
    if (size != sizeof **state)
        return ERROR;
    *state = *state ? *state : malloc(sizeof **state);
    memcpy(*state, bytes, size);
    (void)s;
    return OK;
}
