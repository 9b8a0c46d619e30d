/* Processes that wait for each other; see waiting.h. */
#define _GNU_SOURCE
#include "waiting.h"

#include <sched.h>
#include <time.h>

int64_t clock_now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

void look_away(void)
{
    sched_yield();
}

#if defined __linux__
#include <linux/futex.h>
#include <sys/syscall.h>
#include <unistd.h>

void word_wait(uint32_t *word, uint32_t seen, int64_t most)
{
    const struct timespec time = {most / 1000000000, most % 1000000000};
    syscall(SYS_futex, word, FUTEX_WAIT, seen, &time, NULL, 0);
}

void word_wake(uint32_t *word)
{
    syscall(SYS_futex, word, FUTEX_WAKE, INT32_MAX, NULL, NULL, 0);
}

#else

void word_wait(uint32_t *word, uint32_t seen, int64_t most)
{
    for (int64_t nap = 20000; most > 0; most -= nap) {
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
