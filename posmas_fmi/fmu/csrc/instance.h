/* One instance of the model: its state, what may be called when, and the calls that FMI 2 and
 * FMI 3 have in common. `fmi2.c` and `fmi3.c` only translate. */
#ifndef INSTANCE_H
#define INSTANCE_H

#include <stddef.h>
#include <stdint.h>

#include "model.h"

/* The numbers agree with fmi2Status and fmi3Status. */
typedef enum { STATUS_OK, STATUS_WARNING, STATUS_DISCARD, STATUS_ERROR, STATUS_FATAL } Status;

typedef enum { MODEL_EXCHANGE, CO_SIMULATION } Kind;

typedef enum {
    MODE_INSTANTIATED = 1,
    MODE_INITIALISING = 2,
    MODE_EVENT = 4,
    MODE_CONTINUOUS = 8, /* Model Exchange, between events */
    MODE_STEP = 16,      /* Co-Simulation, at a communication point */
    MODE_TERMINATED = 32,
    MODE_FAILED = 64, /* a step could not be done; only reading, reset, set state, free */
    MODE_RUNNING = MODE_EVENT | MODE_CONTINUOUS | MODE_STEP,
    MODE_ANY = 127
} Mode;

/* Everything that a run changes. Flat and without padding, so that copying the bytes is saving
 * the state, exactly: the step-size memory and the derivative kept from the last step included. */
typedef struct {
    double v[MODEL_NV];  /* see model.h */
    double step;         /* what the solver would try next [s]; 0: not known yet */
    double tolerance;    /* relative; absolute is tolerance times nominal */
    double stop_time;    /* the importer promised not to go beyond; HUGE_VAL: no promise */
    uint32_t mode;       /* one of Mode */
    uint32_t dx_known;   /* v[AT_DX...] belongs to the present time, p, u and x */
    uint32_t y_known;    /* v[AT_Y...] does */
    uint32_t unused;     /* keeps the size a multiple of 8 */
} State;

typedef struct Instance Instance;
typedef void Logger(const Instance *c, Status status, const char *category, const char *message);

struct Instance {
    State state;
    double k[7][MODEL_NX_ROOM];  /* solver: slopes of the stages */
    double xs[MODEL_NX_ROOM];    /* solver: state at a stage */
    double x0[MODEL_NX_ROOM];    /* solver: state to return to when a step fails */
    Kind kind;
    int arrays;                  /* value references address arrays (FMI 3) or elements (FMI 2) */
    Logger *log;
    void *environment;           /* the importer's, for its callback */
    void (*callback)(void);      /* the importer's logger, in its own type */
    char *name;
};

/* Creation. NULL when the token is wrong or memory is out; logged through `first`, of which only
 * log, environment, callback and name need to be set. */
Instance *instance_new(const Instance *first, const char *token, Kind kind, int arrays);
void instance_free(Instance *c);

void instance_log(const Instance *c, Status status, const char *format, ...);

/* OK if the present mode is one of `modes`, else Error and a message that names `call`. */
Status instance_expect(const Instance *c, const char *call, unsigned modes);

/* The way from instantiation to the first step. */
Status instance_setup(Instance *c, double start, double tolerance, double stop_time);
Status instance_initialise(Instance *c);
Status instance_initialised(Instance *c);
Status instance_terminate(Instance *c);
void instance_reset(Instance *c);

/* Values by reference; n_values counts elements. */
Status instance_get(Instance *c, const uint32_t vr[], size_t n, double value[], size_t n_values);
Status instance_set(Instance *c, const uint32_t vr[], size_t n, const double value[],
                    size_t n_values);
Status instance_directional(Instance *c, const uint32_t unknown[], size_t n_unknown,
                            const uint32_t known[], size_t n_known, const double seed[],
                            size_t n_seed, double result[], size_t n_result);

/* Co-Simulation. */
Status instance_step(Instance *c, double time, double step);

/* Model Exchange. */
Status instance_set_time(Instance *c, double time);
Status instance_set_states(Instance *c, const double x[], size_t n);
Status instance_get_states(Instance *c, double x[], size_t n);
Status instance_get_derivatives(Instance *c, double dx[], size_t n);
Status instance_get_nominals(Instance *c, double nominal[], size_t n);

/* The whole state. */
Status instance_save(const Instance *c, State **slot);
Status instance_restore(Instance *c, const State *saved);
size_t instance_serialised_size(void);
Status instance_serialise(const Instance *c, const State *saved, char bytes[], size_t size);
Status instance_deserialise(const Instance *c, const char bytes[], size_t size, State **slot);

#endif
