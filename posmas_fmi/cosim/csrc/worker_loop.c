/* The loop of a worker process: do what is posted, until there is a request for Python. */
#include "remote.h"

#include "export.h"
#include "surroundings.h"
#include "waiting.h"

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

/* Look for a while whether the bell, last seen so, has been rung. */
static int is_rung(const WorkerLoop *w, uint32_t seen)
{
    const int64_t until = clock_now() + w->looks;
    do {
        if (__atomic_load_n(&w->head->bell, __ATOMIC_ACQUIRE) != seen)
            return 1;
        look_away();
    } while (clock_now() < until);
    return 0;
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
        if (is_rung(w, bell))
            continue;
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
