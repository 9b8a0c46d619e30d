/* The little of threads that the engine needs, on POSIX and Windows. */
#ifndef THREADS_H
#define THREADS_H

#include <stdint.h>

typedef struct {
    void (*work)(void *);
    void *argument;
    uintptr_t handle[2]; /* room for the system's own */
} Thread;

/* Return whether it runs. */
int thread_start(Thread *thread, void (*work)(void *), void *argument);
void thread_join(Thread *thread);

/* Where all threads of a team wait for each other; zero it before use. */
typedef struct {
    int64_t waiting;
    int64_t turn;
} Barrier;

/* A gate is 0 until it is opened with another number, which all that wait for it return. */
int64_t gate_wait(const int64_t *gate);
void gate_open(int64_t *gate, int64_t number);

void barrier_wait(Barrier *barrier, int64_t team);

#endif
