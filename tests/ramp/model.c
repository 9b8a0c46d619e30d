/* An FMI 2 Co-Simulation FMU that interpolates its inputs: x' = -x + u + v, exactly, where u and v
 * go on linearly during a step with the derivatives that were set for it. */
#include <math.h>
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
enum { U, V, X, STAGE, VALUES };
typedef struct {
    double v[VALUES], rate[2];
} Ramp;

EXPORT void *fmi2Instantiate(const char *name, int kind, const char *guid, const char *path,
                             const void *callbacks, int visible, int logging)
{
    (void)name, (void)kind, (void)guid, (void)path, (void)callbacks, (void)visible, (void)logging;
    return calloc(1, sizeof(Ramp));
}

EXPORT void fmi2FreeInstance(void *c) { free(c); }

EXPORT int fmi2SetupExperiment(void *c, int a, double b, double start, int d, double stop)
{
    (void)c, (void)a, (void)b, (void)start, (void)d, (void)stop;
    return OK;
}

EXPORT int fmi2EnterInitializationMode(void *c) { return c ? OK : ERROR; }
EXPORT int fmi2ExitInitializationMode(void *c) { return c ? OK : ERROR; }
EXPORT int fmi2Terminate(void *c) { return c ? OK : ERROR; }

EXPORT int fmi2GetReal(Ramp *r, const uint32_t *references, size_t n, double *values)
{
    for (size_t k = 0; k < n; k++)
        values[k] = r->v[references[k]];
    return OK;
}

EXPORT int fmi2SetReal(Ramp *r, const uint32_t *references, size_t n, const double *values)
{
    for (size_t k = 0; k < n; k++)
        r->v[references[k]] = values[k];
    return OK;
}

EXPORT int fmi2SetInteger(Ramp *r, const uint32_t *references, size_t n, const int *values)
{
    for (size_t k = 0; k < n; k++)
        r->v[references[k]] = values[k];
    return OK;
}

EXPORT int fmi2GetInteger(Ramp *r, const uint32_t *references, size_t n, int *values)
{
    for (size_t k = 0; k < n; k++)
        values[k] = (int)r->v[references[k]];
    return OK;
}

EXPORT int fmi2SetRealInputDerivatives(Ramp *r, const uint32_t *references, size_t n,
                                       const int *orders, const double *values)
{
    for (size_t k = 0; k < n; k++) {
        if (references[k] > V || orders[k] != 1)
            return ERROR;
        r->rate[references[k]] = values[k];
    }
    return OK;
}

EXPORT int fmi2DoStep(Ramp *r, double t, double h, int no_set)
{
    (void)t, (void)no_set;
    const double value = r->v[U] + r->v[V], rate = r->rate[U] + r->rate[V], decay = exp(-h);
    r->v[X] = decay * r->v[X] + (1 - decay) * value + (h - 1 + decay) * rate;
    r->rate[U] = r->rate[V] = 0;
    return OK;
}

EXPORT int fmi2GetFMUstate(Ramp *r, Ramp **state)
{
    *state = *state ? *state : malloc(sizeof **state);
    **state = *r;
    return OK;
}

EXPORT int fmi2SetFMUstate(Ramp *r, const Ramp *state)
{
    *r = *state;
    return OK;
}

EXPORT int fmi2FreeFMUstate(Ramp *r, Ramp **state)
{
    (void)r;
    free(*state);
    *state = NULL;
    return OK;
}

EXPORT int fmi2SerializedFMUstateSize(Ramp *r, const Ramp *state, size_t *size)
{
    (void)r, (void)state;
    *size = sizeof *state;
    return OK;
}

EXPORT int fmi2SerializeFMUstate(Ramp *r, const Ramp *state, char *bytes, size_t size)
{
    (void)r;
    memcpy(bytes, state, size);
    return OK;
}

EXPORT int fmi2DeSerializeFMUstate(Ramp *r, const char *bytes, size_t size, Ramp **state)
{
    (void)r;
    if (size != sizeof **state)
        return ERROR;
    *state = *state ? *state : malloc(sizeof **state);
    memcpy(*state, bytes, size);
    return OK;
}
