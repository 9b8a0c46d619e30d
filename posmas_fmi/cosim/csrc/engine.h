/* The communication loop over FMUs and controllers: the same loop as that of master.py, in C.
 *
 * All memory belongs to the caller. Every member has 8 bytes, so that the structure is the same in
 * any language. Instances 0 … agents-1 are the agents' plants, the others (shared facilities) have
 * no controller. What is constant here may be changed between slices, as conditions change. */
#ifndef ENGINE_H
#define ENGINE_H

#include <stdint.h>

#include "controller.h"
#include "fmus.h"

typedef enum { GOES_ON, COMPLETE, DIVERGED, FAILED, NO_THREAD } Ended;

typedef struct {
    /* ---- definition ---- */
    const Fmus *fmus;
    int64_t agents;
    const Controller *controllers; /* one for each period that agents have */
    const int64_t *controller;  /* (agents) which of them */
    const int64_t *every;       /* (instances) its period, in communication steps */
    const double *own_values;   /* (agents, OWN) */
    int64_t steps;              /* communication steps in all */
    int64_t period;             /* [ticks] */
    int64_t per_second;         /* ticks */
    int64_t shows_states;       /* whether the agents' FMUs show x */

    /* the digraph */
    int64_t all_arcs;           /* between agents, numbered by receiver, then from the leader */
    const int64_t *first_arc;   /* (agents + 1) of each receiver */
    const int64_t *sender;      /* of each arc between agents */
    const double *weight;       /* of what is heard over it in the input */
    const double *innovation_weight; /* and in the observer; NULL: nothing */
    const int64_t *leader_arc;  /* (agents) number of the arc from the leader, -1: not pinned */
    const double *own;          /* (agents) weights of the own estimate, leader and innovation */
    const double *leader;
    const double *own_innovation;
    const int64_t *delay;       /* (all_arcs) steps; NULL: none, or `arrivals` */
    int64_t slots;              /* communication points that are remembered: longest delay + 2 */
    double resolution;          /* messages are rounded to multiples of it; 0: they are not */

    /* wiring: inputs of the FMUs beside the agents' u */
    const int64_t *first_extra; /* (instances + 1) of each instance */
    const int64_t *first_term;  /* (extras + 1) of each such input */
    const int64_t *term;        /* >= 0: a reading; < 0: column -1 - term of `drive` */
    const double *term_weight;
    const double *extra_bias;   /* (extras) input = bias + sum of weight * term */
    int64_t drives;             /* columns of `drive` */
    const int64_t *measured_from; /* (agents, MEASURED - Q) as `term`: what is measured beside y */
    int64_t measures_others;    /* some of it is read from other instances: all are read first */
    const int64_t *recorded;    /* (extra_columns) as `term`: what is recorded besides */
    int64_t extra_columns;

    /* ---- conditions: faults of sensors and actuators, and what has failed ---- */
    const double *sensor_gain;   /* (agents, MEASURED) 1: follows, 0: stuck; NULL: all follow */
    const double *sensor_offset;
    const double *sensor_resolution; /* 0: none */
    const double *actuator_gain; /* (agents, P) 1: follows, 0: stuck, between: slow; NULL */
    int64_t *frozen;             /* (instances) not stepped: readings and messages stay */
    int64_t freezes;             /* whether an instance that fails is frozen instead of an end */
    Incident *incident;          /* (instances) why it was; NULL unless `freezes` */

    /* ---- state ---- */
    int64_t k;                  /* communication point that comes next = steps done */
    int64_t ready;              /* 0: read the FMUs at k; 2: only send anew, conditions have changed */
    int64_t diverging;          /* an agent is beyond the limit at k */
    double *memory;             /* (2, agents + 1, MEMORY): point k at k % 2; last row: leader */
    double *pending;            /* (agents, MEMORY) to be remembered after a long period */
    double *message;            /* (slots, agents + 1, MESSAGE): point k at k % slots */
    double *readings;           /* (2, all readings): point k at k % 2 */
    double *measured;           /* (2, agents, MEASURED) */
    double *u;                  /* (agents, P) last input, what the controller took it for, and */
    double *applied;            /* what the actuator made of it */
    double *actuated;
    double *inputs;             /* (all inputs) held over the present step of each instance */
    double *held;               /* (all_arcs, MESSAGE) last message; NULL without `arrivals` */
    int64_t *sent_at;           /* (all_arcs) its communication point */
    double *min_state;          /* (agents) smallest state of each agent so far, and its time */
    double *min_time;
    double limit;               /* beyond it a run has diverged */

    /* ---- one slice ---- */
    int64_t until;              /* communication point to stop before */
    int64_t threads;
    double *scratch;            /* (threads, room) */
    Report *reports;            /* (threads) */
    const int32_t *arrivals;    /* (slice, all_arcs) age of the message that comes, -1: none;
                                   NULL: constant delays */
    const double *drive;        /* (slice + 1, drives) exogenous signals, from k on */
    const double *noise;        /* (slice + 1, agents, MEASURED) of the sensors; NULL: none */
    double *time;               /* rows recorded in this slice; each may be NULL */
    double *x_rows;
    double *xhat_rows;
    double *u_rows;
    double *applied_rows;
    double *y_rows;
    double *s_rows;
    double *measured_rows;
    double *extra_rows;
    int64_t rows;               /* recorded in this slice */
    int64_t halt;               /* set it, from any thread, to stop at the next point */
    int64_t ended;              /* one of Ended */
} Engine;

#endif
