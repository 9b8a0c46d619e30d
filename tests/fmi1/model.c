/* An FMU of FMI 1.0, for Co-Simulation and for Model Exchange: x' = -x + u + (open ? 1 : 0); the
 * number of times that x has risen above 0.5 is counted. */
#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#if defined _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif
#define F(name) EXPORT int one_fmi##name

enum { OK, ERROR = 3 };
enum { U, X, REALS };
typedef struct {
    void (*logger)(void *, const char *, int, const char *, const char *, ...);
    void *(*allocate)(size_t, size_t);
    void (*free)(void *);
    void (*finished)(void *, int);
} Callbacks;
typedef struct {
    char converged, references_changed, values_changed, terminate, upcoming;
    double next;
} EventInfo;
typedef struct {
    double v[REALS], time;
    int count, above;
    char open, begun;
    Callbacks call;
} One;

static One *made(const char *name, const char *guid, Callbacks call)
{
    if (strcmp(guid, "one")) {
        call.logger(NULL, name, ERROR, "error", "the GUID is not that of this model");
        return NULL;
    }
    One *m = call.allocate(1, sizeof *m);
    m->call = call;
    return m;
}

static double inflow(const One *m) { return m->v[U] + (m->open ? 1 : 0); }

static void count(One *m)
{
    const int above = m->v[X] > 0.5;
    m->count += above && !m->above;
    m->above = above;
}

F(GetReal)(One *m, const unsigned *r, size_t n, double *values)
{
    for (size_t k = 0; k < n; k++)
        values[k] = m->v[r[k]];
    return OK;
}

F(SetReal)(One *m, const unsigned *r, size_t n, const double *values)
{
    for (size_t k = 0; k < n; k++)
        m->v[r[k]] = values[k];
    return OK;
}

F(GetInteger)(One *m, const unsigned *r, size_t n, int *values)
{
    for (size_t k = 0; k < n; k++)
        values[k] = m->count;
    (void)r;
    return OK;
}

F(GetBoolean)(One *m, const unsigned *r, size_t n, char *values)
{
    for (size_t k = 0; k < n; k++)
        values[k] = m->open;
    (void)r;
    return OK;
}

F(SetBoolean)(One *m, const unsigned *r, size_t n, const char *values)
{
    for (size_t k = 0; k < n; k++)
        m->open = values[k];
    (void)r;
    return OK;
}

/* ---- Co-Simulation ---- */

EXPORT void *one_fmiInstantiateSlave(const char *name, const char *guid, const char *location,
                                     const char *type, double timeout, char visible,
                                     char interactive, Callbacks call, char logging)
{
    (void)location, (void)type, (void)timeout, (void)visible, (void)interactive, (void)logging;
    return made(name, guid, call);
}

F(InitializeSlave)(One *m, double start, char stop_defined, double stop)
{
    (void)stop_defined, (void)stop;
    if (m->begun)
        return ERROR;
    m->begun = 1;
    m->time = start;
    m->above = m->v[X] > 0.5;
    return OK;
}

F(DoStep)(One *m, double t, double h, char new_step)
{
    if (!m->begun || !new_step || fabs(t - m->time) > 1e-9)
        return ERROR;
    m->v[X] = inflow(m) + (m->v[X] - inflow(m)) * exp(-h);
    m->time = t + h;
    count(m);
    return OK;
}

F(TerminateSlave)(One *m) { return m->begun ? OK : ERROR; }

F(ResetSlave)(One *m)
{
    const Callbacks call = m->call;
    memset(m, 0, sizeof *m);
    m->call = call;
    return OK;
}

EXPORT void one_fmiFreeSlaveInstance(One *m) { m->call.free(m); }

/* ---- Model Exchange ---- */

EXPORT void *one_fmiInstantiateModel(const char *name, const char *guid, Callbacks call,
                                     char logging)
{
    (void)logging;
    return made(name, guid, call);
}

static int told(EventInfo *info)
{
    memset(info, 0, sizeof *info);
    info->converged = 1;
    return OK;
}

F(Initialize)(One *m, char controlled, double tolerance, EventInfo *info)
{
    (void)controlled, (void)tolerance;
    m->begun = 1;
    m->above = m->v[X] > 0.5;
    return told(info);
}

F(EventUpdate)(One *m, char intermediate, EventInfo *info)
{
    (void)intermediate;
    count(m);
    return told(info);
}

F(SetTime)(One *m, double time)
{
    m->time = time;
    return OK;
}

F(SetContinuousStates)(One *m, const double *x, size_t n)
{
    (void)n;
    m->v[X] = x[0];
    return OK;
}

F(GetContinuousStates)(One *m, double *x, size_t n)
{
    (void)n;
    x[0] = m->v[X];
    return OK;
}

F(GetNominalContinuousStates)(One *m, double *x, size_t n)
{
    (void)m, (void)n;
    x[0] = 1;
    return OK;
}

F(GetDerivatives)(One *m, double *dx, size_t n)
{
    (void)n;
    dx[0] = inflow(m) - m->v[X];
    return OK;
}

F(GetEventIndicators)(One *m, double *z, size_t n)
{
    (void)n;
    z[0] = m->v[X] - 0.5;
    return OK;
}

F(CompletedIntegratorStep)(One *m, char *event)
{
    (void)m;
    *event = 0;
    return OK;
}

F(Terminate)(One *m) { return m->begun ? OK : ERROR; }

EXPORT void one_fmiFreeModelInstance(One *m) { m->call.free(m); }
