/* The communication loop over FMUs and controllers: the same loop as that of master.py, in C.
 *
 * All memory belongs to the caller. Every member has 8 bytes, so that the structure is the same in
 * any language. */
#ifndef ENGINE_H
#define ENGINE_H

#include <stdint.h>

#include "controller.h"
#include "fmus.h"

typedef enum { GOES_ON, COMPLETE, DIVERGED, FAILED, NO_THREAD } Ended;

typedef struct {
    /* ---- definition ---- */
    const Fmus *fmus;
    const Controller *controller;
    int64_t steps;              /* communication steps in all */
    int64_t period;             /* [ns] */
    int64_t shows_states;       /* whether the FMUs show x */
    int64_t all_arcs;           /* between agents, numbered by receiver, then from the leader */
    const int64_t *first_arc;   /* (n + 1) of each receiver */
    const int64_t *sender;      /* of each arc between agents */
    const double *weight;       /* of what is heard over it in the input */
    const double *innovation_weight; /* and in the observer; NULL: nothing */
    const int64_t *leader_arc;  /* (n) number of the arc from the leader, -1: not pinned */
    const double *own;          /* (n) weights of the own estimate, leader and innovation */
    const double *leader;
    const double *own_innovation;
    const int64_t *delay;       /* (all_arcs) steps; NULL: none, or `arrivals` */
    int64_t slots;              /* communication points that are remembered: longest delay + 2 */

    /* ---- state ---- */
    int64_t k;                  /* communication point that comes next = steps done */
    int64_t ready;              /* the FMUs were read at k */
    int64_t diverging;          /* an agent is beyond the limit at k */
    double *xhat;               /* (slots, n + 1, M): point k at k % slots; last row: leader */
    double *innovation;         /* (slots, n + 1, Q) */
    double *readings;           /* (2, n, Q [+ M]): point k at k % 2 */
    double *held;               /* (all_arcs, M + Q) last message; NULL without `arrivals` */
    double *min_state;          /* (n) smallest state of each agent so far, and its time */
    double *min_time;
    double limit;               /* beyond it a run has diverged */

    /* ---- one slice ---- */
    int64_t until;              /* communication point to stop before */
    int64_t threads;
    double *scratch;            /* (threads, room) */
    Report *reports;            /* (threads) */
    const int32_t *arrivals;    /* (slice, all_arcs) age of the message that comes, -1: none;
                                   NULL: constant delays */
    double *time;               /* rows recorded in this slice; each may be NULL */
    double *x;
    double *xhat_rows;
    double *u;
    double *sec_u;
    double *y;
    double *s;
    int64_t rows;               /* recorded in this slice */
    int64_t halt;               /* set it, from any thread, to stop at the next point */
    int64_t ended;              /* one of Ended */
} Engine;

#endif
