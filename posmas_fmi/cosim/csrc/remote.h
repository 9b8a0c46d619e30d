/* FMUs in worker processes: what a master and a worker share.
 *
 * Posted work and answers are counters in shared memory; a process waits for one of the other's, see
 * waiting.h. Every member has 8 bytes or comes in a pair of 4. */
#ifndef REMOTE_H
#define REMOTE_H

#include <stdint.h>

#include "fmus.h"

enum { LINE = 64 }; /* bytes that two processors do not write at a time */

/* Of one worker, in shared memory. */
typedef struct {
    /* written by the master */
    uint32_t bell;   /* rung when there is work: the worker sleeps on it */
    uint32_t waiting; /* threads of the master that sleep on `turn` */
    int64_t asked;   /* requests beside the steps, so far: they come over a socket */
    char apart[LINE - 16];
    /* written by the worker */
    uint32_t turn;   /* turned when posted work is done */
    uint32_t asleep;
    Calling calling; /* `call` is CALL_NONE outside the calls of steps and reads */
    int64_t gave_up; /* why it ended itself: 0, or one of the worker's reasons */
    char also_apart[LINE - 40];
    char doing[LINE]; /* the call that is going on for a request */
} Head;

/* Of one instance, in shared memory; its inputs and then its readings follow. */
typedef struct {
    /* written by the master */
    int64_t posted; /* orders so far */
    int64_t steps;  /* whether the last one is a step, else a read only */
    double t, h;
    char apart[LINE - 32];
    /* written by the worker */
    int64_t done;   /* orders done */
    Report report;  /* on the last one */
    char also_apart[2 * LINE - 8 - sizeof(Report)];
} Slot;

/* ---- the master's side ----------------------------------------------------------------------- */

typedef struct {
    Head *head;
    int64_t process;        /* its id */
    const int64_t *numbers; /* of its instances, as the master counts them */
    int64_t instances;
    int64_t posted;         /* since the last wake-up */
    int64_t ended;          /* CALL_NONE, CALL_WORKER_DIED or CALL_DEADLINE */
    int64_t code;           /* then: exit code, or minus the signal */
} Worker;

/* The steps of an instance since a state that it can be brought back to. */
typedef struct {
    int64_t wanted; /* whether they are kept */
    int64_t n, room, most;
    int64_t cut;    /* more than `most` were done, or memory was short: they are incomplete */
    double *rows;   /* (n, 2 + inputs): t, h, inputs */
} Past;

typedef struct {
    int64_t worker;     /* number of its worker; -1: it is in this process */
    Slot *slot;
    int64_t inputs, readings; /* how many */
    int64_t given_up;   /* it is not stepped any more; `incident` says why */
    Incident incident;
    Past past;
} RemoteInstance;

typedef struct {
    Worker **workers;   /* NULL where there is none at present */
    int64_t n_workers;
    RemoteInstance *instances;
    double deadline;    /* [s] for one call */
    int64_t looks;      /* [ns] how long it looks before it sleeps */
    /* Called when an instance failed, or its worker ended, with the incident in the instance: brings
     * back what can be, gives up the rest, and returns whether to look again. NULL: it is final. */
    int (*recover)(int64_t instance);
    /* Called every now and then while a worker is waited for; whether to give that up. NULL: no. */
    int (*interrupted)(void);
    int64_t recovering; /* a lock */
} Workers;

/* ---- the worker's side ----------------------------------------------------------------------- */

typedef struct {
    Head *head;
    const Fmus *fmus;
    Slot *const *slots;  /* of each instance */
    double *scratch;
    int64_t looks;       /* [ns] how long it looks before it sleeps */
    int64_t answered;    /* requests answered so far */
} WorkerLoop;

#endif
