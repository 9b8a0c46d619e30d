/* FMU instances, FMI 2 and 3: set the inputs, step, read outputs and states. */
#ifndef FMUS_H
#define FMUS_H

#include <stdint.h>

#include "message_log.h"

/* Every member has 8 bytes, so that the structures are the same in any language. */

/* Places of protocol quantities among the values that one call of the FMU exchanges. */
typedef struct {
    const uint32_t *references;
    int64_t n_references;
    int64_t n_values;       /* that a call exchanges */
    int64_t n_ports;        /* that are wanted among them */
    const int64_t *places;  /* of the ports among the values; NULL: one after the other */
    const double *scale;    /* FMU value = scale * value + offset; NULL: as it is */
    const double *offset;
    int64_t partial;        /* some of the values are no ports: they are read before setting */
} Ports;

/* The functions of one FMU file and its ports. */
typedef struct {
    int64_t fmi; /* 2 or 3 */
    void (*get)(void);
    void (*set)(void);
    void (*do_step)(void);
    void (*boolean_status)(void); /* FMI 2, after Discard; NULL: not there */
    void (*real_status)(void);
    Ports inputs;
    Ports readings; /* outputs y, then states x where they are shown */
    void (*set_rates)(void);         /* FMI 2: input derivatives, of order 1; NULL: none */
    const uint32_t *rate_references; /* of the inputs that go on with a slope */
    const int32_t *rate_orders;
    int64_t n_rates;                 /* they follow the inputs of the ports */
} Binding;

typedef enum {
    CALL_NONE,
    CALL_SET,
    CALL_GET_BEFORE_SET,
    CALL_STEP,
    CALL_STEP_TERMINATED, /* the FMU asked to end the simulation */
    CALL_STEP_EARLY,      /* FMI 3: returned early */
    CALL_GET,
    CALL_NOT_FINITE,      /* a value that was read */
    CALL_WORKER_DIED,     /* the process that runs the FMU */
    CALL_DEADLINE,        /* it did not answer in time */
    CALL_INTERRUPTED,     /* the user wants an end; it is not waited for any more */
    CALL_SET_RATES
} Call;

/* Which call was not right. */
typedef struct {
    int64_t call; /* one of Call */
    int64_t instance;
    int64_t status;
    int64_t port;  /* which value is not finite */
    double value;  /* it, or the time that a step got to */
    int64_t said;  /* number of messages before the call */
} Incident;

typedef struct {
    Incident failure;  /* call is CALL_NONE: none */
    Incident warning;  /* the first one */
    int64_t warnings;
} Report;

/* Instances in other processes: their steps are posted, sent together, and waited for. Inputs and
 * readings are those of the ports, as for `fmus_step` and `fmus_read`. */
typedef struct {
    void *context;
    void (*post)(void *context, int64_t instance, double t, double h, const double *inputs);
    void (*send)(void *context); /* wake each process that has work, once */
    int (*wait)(void *context, int64_t instance, double *readings, Report *report);
    int (*read)(void *context, int64_t instance, double *readings, Report *report); /* no step */
} Remote;

/* What is going on, for another process that watches. */
typedef struct {
    int64_t begun;    /* calls so far */
    int64_t call;     /* one of Call */
    int64_t instance;
} Calling;

/* All instances: the agents' first, then those that are no agents. */
typedef struct {
    int64_t n;
    const Binding *bindings;
    const int64_t *binding;     /* of each instance */
    void *const *component;     /* of each instance */
    const int64_t *input_at;    /* (n + 1) where its inputs stand among those of all */
    const int64_t *reading_at;  /* (n + 1) and its readings */
    int64_t room;               /* values in the largest exchange */
    const MessageLog *messages; /* NULL: kept elsewhere */
    const Remote *remote;       /* NULL: none */
    const int64_t *is_remote;   /* of each instance */
    Calling *calling;           /* is told before each call; NULL: nobody watches */
} Fmus;

/* Number of inputs of an instance: those of its ports and the slopes after them. */
static inline int64_t fmus_inputs(const Binding *b)
{
    return b->inputs.n_ports + b->n_rates;
}

static inline int fmus_is_remote(const Fmus *f, int64_t instance)
{
    return f->remote && f->is_remote[instance];
}

/* Tell the processor which instance comes next: thousands of them do not fit into its caches, and
 * what it fetches while another one steps it need not wait for. How large an instance is only the
 * FMU knows; fetching what is not there does no harm. */
static inline void fmus_expect(const Fmus *f, int64_t instance)
{
    enum { LINE = 64, LINES = 8 };
    if (instance < f->n)
        for (int line = 0; line < LINES; line++)
            __builtin_prefetch((const char *)f->component[instance] + line * LINE);
}

/* Both return whether all went well; inputs and values are those of the ports, `scratch` has room
 * for an exchange. A remote instance is read only; its steps go through `remote`. */
int fmus_step(const Fmus *fmus, int64_t instance, double t, double h, const double *inputs,
              double *scratch, Report *report);
int fmus_read(const Fmus *fmus, int64_t instance, double *values, double *scratch, Report *report);

/* Of two failures in one communication step, whether `a` is the one that a loop over all instances
 * that steps, and then one that reads, meets first. */
int incident_before(const Incident *a, const Incident *b);

#endif
