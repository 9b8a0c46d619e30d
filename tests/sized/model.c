/* An FMI 3 Co-Simulation FMU whose vectors have as many elements as a structural parameter says:
 * y = gain * u, element by element, at the end of each step. */
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
enum { MOST = 5 };
typedef struct {
    uint64_t m;
    bool configuring, running;
    double v[3][MOST]; /* gain, u, y */
} Sized;

EXPORT void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *path,
                                         bool visible, bool logging, bool events, bool early,
                                         const uint32_t *required, size_t n, void *environment,
                                         void *log, void *update)
{
    (void)name, (void)token, (void)path, (void)visible, (void)logging, (void)required, (void)n;
    (void)environment, (void)log, (void)update, (void)events, (void)early;
    Sized *s = calloc(1, sizeof *s);
    s->m = 2;
    for (int k = 0; k < MOST; k++)
        s->v[0][k] = 1;
    return s;
}

EXPORT void fmi3FreeInstance(void *c) { free(c); }

EXPORT int fmi3EnterConfigurationMode(Sized *s)
{
    if (s->running || s->configuring)
        return ERROR;
    s->configuring = true;
    return OK;
}

EXPORT int fmi3ExitConfigurationMode(Sized *s)
{
    s->configuring = false;
    return OK;
}

EXPORT int fmi3SetUInt64(Sized *s, const uint32_t *references, size_t n, const uint64_t *values,
                         size_t size)
{
    (void)size;
    if (n != 1 || references[0] != 1 || values[0] > MOST || !s->configuring)
        return ERROR;
    s->m = values[0];
    return OK;
}

EXPORT int fmi3EnterInitializationMode(Sized *s, bool tolerance_defined, double tolerance,
                                       double start, bool stop_defined, double stop)
{
    (void)tolerance_defined, (void)tolerance, (void)start, (void)stop_defined, (void)stop;
    s->running = true;
    return s->configuring ? ERROR : OK;
}

EXPORT int fmi3ExitInitializationMode(Sized *s)
{
    (void)s;
    return OK;
}

EXPORT int fmi3DoStep(Sized *s, double t, double h, bool no_set, bool *event, bool *terminate,
                      bool *early, double *reached)
{
    (void)no_set;
    *event = *terminate = *early = false;
    *reached = t + h;
    for (uint64_t k = 0; k < s->m; k++)
        s->v[2][k] = s->v[0][k] * s->v[1][k];
    return OK;
}

EXPORT int fmi3GetFloat64(Sized *s, const uint32_t *references, size_t n, double *values,
                          size_t size)
{
    if (size != n * s->m)
        return ERROR;
    for (size_t j = 0; j < n; j++)
        for (uint64_t k = 0; k < s->m; k++)
            *values++ = s->v[references[j] - 2][k];
    return OK;
}

EXPORT int fmi3SetFloat64(Sized *s, const uint32_t *references, size_t n, const double *values,
                          size_t size)
{
    if (size != n * s->m)
        return ERROR;
    for (size_t j = 0; j < n; j++)
        for (uint64_t k = 0; k < s->m; k++)
            s->v[references[j] - 2][k] = *values++;
    return OK;
}
