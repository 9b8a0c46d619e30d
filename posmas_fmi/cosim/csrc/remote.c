/* The master's side of worker processes: the functions of `Remote` in fmus.h. */
#define _GNU_SOURCE
#include "remote.h"

#include <errno.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <sys/wait.h>
#include <time.h>

#include "export.h"
#include "waiting.h"

enum { NAP = 20000000, DYING = 100 }; /* ns between two looks at a worker; looks */

static double *inputs_of(Slot *slot)
{
    return (double *)(slot + 1);
}

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* ---- posting --------------------------------------------------------------------------------- */

static void remember(RemoteInstance *x, double t, double h, const double *inputs)
{
    Past *past = &x->past;
    const int64_t width = 2 + x->inputs;
    if (!past->wanted || past->cut)
        return;
    if (past->n == past->room) {
        const int64_t room = past->room ? 2 * past->room : 64;
        double *rows = past->n < past->most
                           ? realloc(past->rows, (size_t)(room * width) * sizeof *rows)
                           : NULL;
        if (!rows) {
            past->cut = 1;
            return;
        }
        past->rows = rows;
        past->room = room;
    }
    double *row = past->rows + past->n++ * width;
    row[0] = t;
    row[1] = h;
    memcpy(row + 2, inputs, (size_t)x->inputs * sizeof *row);
}

static void order(Workers *r, RemoteInstance *x)
{
    __atomic_store_n(&x->slot->posted, x->slot->posted + 1, __ATOMIC_RELEASE);
    __atomic_store_n(&r->workers[x->worker]->posted, 1, __ATOMIC_RELAXED);
}

static void remote_post(void *context, int64_t i, double t, double h, const double *inputs)
{
    Workers *r = context;
    RemoteInstance *x = &r->instances[i];
    if (x->given_up)
        return;
    remember(x, t, h, inputs);
    memcpy(inputs_of(x->slot), inputs, (size_t)x->inputs * sizeof *inputs);
    x->slot->t = t;
    x->slot->h = h;
    x->slot->steps = 1;
    order(r, x);
}

static void ring(Worker *w)
{
    __atomic_add_fetch(&w->head->bell, 1, __ATOMIC_SEQ_CST);
    __atomic_thread_fence(__ATOMIC_SEQ_CST);
    if (__atomic_load_n(&w->head->asleep, __ATOMIC_SEQ_CST))
        word_wake(&w->head->bell);
}

static void remote_send(void *context)
{
    Workers *r = context;
    for (int64_t k = 0; k < r->n_workers; k++)
        if (r->workers[k] && __atomic_exchange_n(&r->workers[k]->posted, 0, __ATOMIC_ACQ_REL))
            ring(r->workers[k]);
}

/* ---- waiting --------------------------------------------------------------------------------- */

/* Whether the process of a worker has ended; its parent may still ask for its status. */
static int has_ended(Worker *w)
{
    siginfo_t info;
    memset(&info, 0, sizeof info);
    int got;
    do
        got = waitid(P_PID, (id_t)w->process, &info, WEXITED | WNOHANG | WNOWAIT);
    while (got < 0 && errno == EINTR);
    if (got < 0)
        return 1; /* somebody has asked already: `code` stays unknown */
    if (!info.si_pid)
        return 0;
    w->code = info.si_code == CLD_EXITED ? info.si_status : -(int64_t)info.si_status;
    return 1;
}

static void kill_worker(Worker *w)
{
    kill((pid_t)w->process, SIGKILL);
    for (int look = 0; look < DYING && !has_ended(w); look++)
        nanosleep(&(struct timespec){0, NAP / 2}, NULL);
}

/* Look for a while whether the order of x is done. */
static int is_done_soon(Workers *r, const RemoteInstance *x)
{
    const int64_t until = clock_now() + r->looks;
    do {
        if (__atomic_load_n(&x->slot->done, __ATOMIC_ACQUIRE) == x->slot->posted)
            return 1;
        look_away();
    } while (clock_now() < until);
    return 0;
}

/* What keeps the order of x from being done: CALL_NONE when it is done. */
static int64_t await(Workers *r, RemoteInstance *x)
{
    Worker *w = r->workers[x->worker];
    Head *head = w->head;
    const int64_t posted = x->slot->posted;
    const int64_t *done = &x->slot->done;
    if (is_done_soon(r, x))
        return CALL_NONE;
    int64_t begun = -1;
    double since = 0;
    for (;;) {
        const uint32_t turn = __atomic_load_n(&head->turn, __ATOMIC_SEQ_CST);
        __atomic_add_fetch(&head->waiting, 1, __ATOMIC_SEQ_CST);
        __atomic_thread_fence(__ATOMIC_SEQ_CST);
        if (__atomic_load_n(done, __ATOMIC_ACQUIRE) != posted && !w->ended)
            word_wait(&head->turn, turn, NAP);
        __atomic_sub_fetch(&head->waiting, 1, __ATOMIC_SEQ_CST);
        if (__atomic_load_n(done, __ATOMIC_ACQUIRE) == posted)
            return CALL_NONE;
        if (w->ended)
            return w->ended;
        if (__atomic_load_n(&head->turn, __ATOMIC_SEQ_CST) != turn)
            continue;
        if (has_ended(w)) /* what it did before it ended counts */
            return __atomic_load_n(done, __ATOMIC_ACQUIRE) == posted ? CALL_NONE
                                                                     : CALL_WORKER_DIED;
        if (r->interrupted && r->interrupted())
            return CALL_INTERRUPTED;
        const int64_t calls = __atomic_load_n(&head->calling.begun, __ATOMIC_ACQUIRE);
        if (calls != begun) {
            begun = calls;
            since = now();
        } else if (now() - since > r->deadline) {
            return CALL_DEADLINE;
        }
    }
}

/* A worker does not answer: end it, and say what it was doing. */
static Incident post_mortem(Workers *r, int64_t i, int64_t why)
{
    Worker *w = r->workers[r->instances[i].worker];
    if (why == CALL_DEADLINE && !w->ended)
        kill_worker(w);
    w->ended = why;
    Incident incident = {why, i, w->code, w->head->calling.call, 0, 0};
    const int64_t at = w->head->calling.instance;
    if (incident.port != CALL_NONE && at >= 0 && at < w->instances)
        incident.instance = w->numbers[at];
    return incident;
}

static void lock(int64_t *word)
{
    while (__atomic_exchange_n(word, 1, __ATOMIC_ACQUIRE))
        nanosleep(&(struct timespec){0, NAP / 100}, NULL);
}

static int remote_wait(void *context, int64_t i, double *readings, Report *report)
{
    Workers *r = context;
    RemoteInstance *x = &r->instances[i];
    while (!x->given_up) {
        const Slot *slot = x->slot;
        const int64_t why = await(r, x);
        const Report *got = &x->slot->report;
        if (!why && !got->failure.call) {
            memcpy(readings, inputs_of(x->slot) + x->inputs,
                   (size_t)x->readings * sizeof *readings);
            break;
        }
        if (why == CALL_INTERRUPTED) {
            report->failure = (Incident){.call = why, .instance = i};
            return 0;
        }
        lock(&r->recovering);
        int again = x->slot != slot || x->given_up; /* another thread has seen to it */
        Incident incident = {0, 0, 0, 0, 0, 0};
        if (!again) {
            incident = why ? post_mortem(r, i, why) : got->failure;
            if (!why)
                incident.instance = i;
            x->incident = incident;
            again = incident.call != CALL_STEP_TERMINATED && r->recover && r->recover(i);
        }
        __atomic_store_n(&r->recovering, 0, __ATOMIC_RELEASE);
        if (!again) {
            if (!report->failure.call || incident_before(&incident, &report->failure))
                report->failure = incident;
            return 0;
        }
    }
    if (x->given_up) {
        report->failure = x->incident;
        return 0;
    }
    const Report *got = &x->slot->report;
    if (got->warnings && !report->warnings) {
        report->warning = got->warning;
        report->warning.instance = i;
    }
    report->warnings += got->warnings;
    return 1;
}

static int remote_read(void *context, int64_t i, double *readings, Report *report)
{
    Workers *r = context;
    RemoteInstance *x = &r->instances[i];
    if (!x->given_up) {
        x->slot->steps = 0;
        order(r, x);
        remote_send(r);
    }
    return remote_wait(r, i, readings, report);
}

/* ---- for Python ------------------------------------------------------------------------------ */

EXPORT void remote_define(Remote *remote, Workers *workers)
{
    *remote = (Remote){workers, remote_post, remote_send, remote_wait, remote_read};
}

/* Tell a worker that a request comes over its socket. */
EXPORT void remote_ask(Worker *w)
{
    __atomic_add_fetch(&w->head->asked, 1, __ATOMIC_SEQ_CST);
    ring(w);
}

/* Whether a worker's process has ended: `code` says how. */
EXPORT int64_t remote_ended(Worker *w)
{
    return has_ended(w);
}

EXPORT void remote_kill(Worker *w)
{
    if (!has_ended(w))
        kill_worker(w);
}

EXPORT void remote_forget(RemoteInstance *x)
{
    free(x->past.rows);
    x->past.rows = NULL;
    x->past.n = x->past.room = x->past.cut = 0;
}

EXPORT int64_t remote_size(int64_t which)
{
    const int64_t sizes[] = {sizeof(Head), sizeof(Slot), sizeof(Worker), sizeof(RemoteInstance),
                             sizeof(Workers), sizeof(WorkerLoop)};
    return which >= 0 && which < 6 ? sizes[which] : 0;
}
