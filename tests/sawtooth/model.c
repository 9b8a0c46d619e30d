/* An FMI 3 Model Exchange FMU with events: x' = 1 + u; when x reaches 1 it falls back to 0 and
 * `falls` grows (a state event); `clock` grows every 0.5 s (time events). */
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>

#if defined _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

enum { OK, ERROR = 3 };
enum { TIME, U, X, FALLS, CLOCK, VALUES };
typedef struct {
    double v[VALUES];
} Saw;

EXPORT void *fmi3InstantiateModelExchange(const char *name, const char *token, const char *path,
                                          bool visible, bool logging, void *environment, void *log)
{
    (void)name, (void)token, (void)path, (void)visible, (void)logging, (void)environment, (void)log;
    return calloc(1, sizeof(Saw));
}

EXPORT void fmi3FreeInstance(void *c) { free(c); }

EXPORT int fmi3EnterInitializationMode(Saw *s, bool tolerance_defined, double tolerance,
                                       double start, bool stop_defined, double stop)
{
    (void)tolerance_defined, (void)tolerance, (void)stop_defined, (void)stop;
    s->v[TIME] = start;
    return OK;
}

EXPORT int fmi3ExitInitializationMode(Saw *s) { return s ? OK : ERROR; }
EXPORT int fmi3EnterEventMode(Saw *s) { return s ? OK : ERROR; }
EXPORT int fmi3EnterContinuousTimeMode(Saw *s) { return s ? OK : ERROR; }

EXPORT int fmi3UpdateDiscreteStates(Saw *s, bool *again, bool *terminate, bool *nominals,
                                    bool *states, bool *defined, double *next)
{
    *again = *terminate = *nominals = *states = false;
    if (s->v[X] >= 1.0) {
        s->v[X] -= 1.0;
        s->v[FALLS] += 1;
        *states = true;
    }
    if (s->v[TIME] >= 0.5 * (s->v[CLOCK] + 1))
        s->v[CLOCK] += 1;
    *defined = true;
    *next = 0.5 * (s->v[CLOCK] + 1);
    return OK;
}

EXPORT int fmi3SetTime(Saw *s, double time)
{
    s->v[TIME] = time;
    return OK;
}

EXPORT int fmi3SetContinuousStates(Saw *s, const double *x, size_t n)
{
    s->v[X] = x[0];
    return n == 1 ? OK : ERROR;
}

EXPORT int fmi3GetContinuousStates(Saw *s, double *x, size_t n)
{
    x[0] = s->v[X];
    return n == 1 ? OK : ERROR;
}

EXPORT int fmi3GetContinuousStateDerivatives(Saw *s, double *dx, size_t n)
{
    dx[0] = 1.0 + s->v[U];
    return n == 1 ? OK : ERROR;
}

EXPORT int fmi3GetNominalsOfContinuousStates(Saw *s, double *nominals, size_t n)
{
    (void)s;
    nominals[0] = 1.0;
    return n == 1 ? OK : ERROR;
}

EXPORT int fmi3GetEventIndicators(Saw *s, double *z, size_t n)
{
    z[0] = s->v[X] - 1.0;
    return n == 1 ? OK : ERROR;
}

EXPORT int fmi3GetFloat64(Saw *s, const uint32_t *references, size_t n, double *values, size_t size)
{
    (void)size;
    for (size_t k = 0; k < n; k++)
        values[k] = s->v[references[k]];
    return OK;
}

EXPORT int fmi3SetFloat64(Saw *s, const uint32_t *references, size_t n, const double *values,
                          size_t size)
{
    (void)size;
    for (size_t k = 0; k < n; k++)
        s->v[references[k]] = values[k];
    return OK;
}
