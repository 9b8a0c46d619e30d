/* Threads and a barrier that spins at first: a step of few agents takes microseconds. */
#define _POSIX_C_SOURCE 200809L
#include "threads.h"

#include <string.h>

#if defined _WIN32
#include <windows.h>

static DWORD WINAPI run(LPVOID thread)
{
    ((Thread *)thread)->work(((Thread *)thread)->argument);
    return 0;
}

static int create(Thread *thread)
{
    HANDLE handle = CreateThread(NULL, 0, run, thread, 0, NULL);
    thread->handle[0] = (uintptr_t)handle;
    return handle != NULL;
}

void thread_join(Thread *thread)
{
    WaitForSingleObject((HANDLE)thread->handle[0], INFINITE);
    CloseHandle((HANDLE)thread->handle[0]);
}

static void give_way(int long_wait)
{
    Sleep(long_wait ? 1 : 0);
}

#else
#include <pthread.h>
#include <sched.h>
#include <time.h>

typedef char handle_fits[sizeof(pthread_t) <= sizeof(uintptr_t[2]) ? 1 : -1];

static void *run(void *thread)
{
    ((Thread *)thread)->work(((Thread *)thread)->argument);
    return NULL;
}

static int create(Thread *thread)
{
    pthread_t handle;
    if (pthread_create(&handle, NULL, run, thread) != 0)
        return 0;
    memcpy(thread->handle, &handle, sizeof handle);
    return 1;
}

void thread_join(Thread *thread)
{
    pthread_t handle;
    memcpy(&handle, thread->handle, sizeof handle);
    pthread_join(handle, NULL);
}

static void give_way(int long_wait)
{
    if (long_wait)
        nanosleep(&(struct timespec){0, 20000}, NULL);
    else
        sched_yield();
}
#endif

enum { SPINS = 4000, YIELDS = 200 };

int thread_start(Thread *thread, void (*work)(void *), void *argument)
{
    thread->work = work;
    thread->argument = argument;
    return create(thread);
}

/* Spin, then let others run, then sleep: FMUs may need long for a step. */
static int patience(int tries)
{
    if (tries >= SPINS)
        give_way(tries >= SPINS + YIELDS);
    return tries < SPINS + YIELDS ? tries + 1 : tries;
}

void barrier_wait(Barrier *barrier, int64_t team)
{
    if (team == 1)
        return;
    const int64_t turn = __atomic_load_n(&barrier->turn, __ATOMIC_ACQUIRE);
    if (__atomic_add_fetch(&barrier->waiting, 1, __ATOMIC_ACQ_REL) == team) {
        __atomic_store_n(&barrier->waiting, 0, __ATOMIC_RELAXED);
        __atomic_store_n(&barrier->turn, turn + 1, __ATOMIC_RELEASE);
        return;
    }
    int tries = 0;
    while (__atomic_load_n(&barrier->turn, __ATOMIC_ACQUIRE) == turn)
        tries = patience(tries);
}

int64_t gate_wait(const int64_t *gate)
{
    int tries = 0;
    int64_t number;
    while (!(number = __atomic_load_n(gate, __ATOMIC_ACQUIRE)))
        tries = patience(tries);
    return number;
}

void gate_open(int64_t *gate, int64_t number)
{
    __atomic_store_n(gate, number, __ATOMIC_RELEASE);
}
