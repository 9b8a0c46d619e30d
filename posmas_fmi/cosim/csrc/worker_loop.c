/* The loop of a worker process: do what is posted, until there is a request for Python. */
#define _GNU_SOURCE
#include "remote.h"

#include <time.h>

#include "export.h"
#include "surroundings.h"

#if defined __linux__
#include <linux/futex.h>
#include <sys/syscall.h>
#include <unistd.h>

void word_wait(uint32_t *word, uint32_t seen, int64_t nanoseconds)
{
    const struct timespec most = {nanoseconds / 1000000000, nanoseconds % 1000000000};
    syscall(SYS_futex, word, FUTEX_WAIT, seen, &most, NULL, 0);
}

void word_wake(uint32_t *word)
{
    syscall(SYS_futex, word, FUTEX_WAKE, INT32_MAX, NULL, NULL, 0);
}

#else

void word_wait(uint32_t *word, uint32_t seen, int64_t nanoseconds)
{
    for (int64_t nap = 20000; nanoseconds > 0; nanoseconds -= nap) {
        if (__atomic_load_n(word, __ATOMIC_SEQ_CST) != seen)
            return;
        nanosleep(&(struct timespec){0, nap}, NULL);
        if (nap < 1000000)
            nap *= 2;
    }
}

void word_wake(uint32_t *word)
{
    (void)word; /* it looks */
}
#endif

enum { NAP = 200000000 }; /* ns; whoever rings wakes it before */

static double *inputs_of(Slot *slot)
{
    return (double *)(slot + 1);
}

/* Do the order of instance i. */
static void do_order(const WorkerLoop *w, int64_t i, int64_t order)
{
    Slot *s = w->slots[i];
    const Binding *b = &w->fmus->bindings[w->fmus->binding[i]];
    double *inputs = inputs_of(s), *readings = inputs + fmus_inputs(b);
    Report report = {{0}, {0}, 0};
    if (!s->steps || fmus_step(w->fmus, i, s->t, s->h, inputs, w->scratch, &report))
        fmus_read(w->fmus, i, readings, w->scratch, &report);
    surroundings_put_back_floats(); /* the next may be another FMU */
    w->head->calling.call = CALL_NONE;
    s->report = report;
    __atomic_store_n(&s->done, order, __ATOMIC_RELEASE);
}

EXPORT void worker_run(WorkerLoop *w)
{
    Head *head = w->head;
    for (;;) {
        const uint32_t bell = __atomic_load_n(&head->bell, __ATOMIC_SEQ_CST);
        int worked = 0;
        for (int64_t i = 0; i < w->fmus->n; i++) {
            const int64_t order = __atomic_load_n(&w->slots[i]->posted, __ATOMIC_ACQUIRE);
            if (order == w->slots[i]->done)
                continue;
            do_order(w, i, order);
            worked = 1;
        }
        if (worked) {
            __atomic_add_fetch(&head->turn, 1, __ATOMIC_SEQ_CST);
            __atomic_thread_fence(__ATOMIC_SEQ_CST);
            if (__atomic_load_n(&head->waiting, __ATOMIC_SEQ_CST))
                word_wake(&head->turn);
            surroundings_put_back();
            continue;
        }
        /* a request may be read before it is counted here */
        if (__atomic_load_n(&head->asked, __ATOMIC_SEQ_CST) > w->answered)
            return;
        for (int64_t n = 0; n < w->spins; n++) {
            if (__atomic_load_n(&head->bell, __ATOMIC_ACQUIRE) != bell)
                break;
            pause_briefly();
        }
        __atomic_store_n(&head->asleep, 1, __ATOMIC_SEQ_CST);
        __atomic_thread_fence(__ATOMIC_SEQ_CST);
        if (__atomic_load_n(&head->bell, __ATOMIC_SEQ_CST) == bell)
            word_wait(&head->bell, bell, NAP);
        __atomic_store_n(&head->asleep, 0, __ATOMIC_SEQ_CST);
    }
}

/* Do steps (n rows of t, h, inputs) of one instance again and then read it, as if it had done an
 * order; return how many steps went well. */
EXPORT int64_t worker_replay(const WorkerLoop *w, int64_t i, const double *rows, int64_t n)
{
    const int64_t inputs = fmus_inputs(&w->fmus->bindings[w->fmus->binding[i]]);
    Slot *s = w->slots[i];
    Report report = {{0}, {0}, 0};
    int64_t k = 0;
    for (; k < n; k++, rows += 2 + inputs) {
        s->t = rows[0]; /* where it is, should it get no further */
        if (!fmus_step(w->fmus, i, rows[0], rows[1], rows + 2, w->scratch, &report))
            break;
    }
    if (k == n)
        fmus_read(w->fmus, i, inputs_of(s) + inputs, w->scratch, &report);
    surroundings_put_back();
    w->head->calling.call = CALL_NONE;
    s->report = report;
    return k;
}
