/* An FMU (FMI 2, Co-Simulation) for x' = u - x that goes wrong as its parameters say: `fault` at
 * time `at`. */
#define _GNU_SOURCE
#include <fcntl.h>
#include <fenv.h>
#include <locale.h>
#include <math.h>
#include <signal.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <unistd.h>

typedef void *Component;
typedef void Logger(void *, const char *, int, const char *, const char *, ...);
typedef struct {
    Logger *logger;
    void *(*allocate)(size_t, size_t);
    void (*release)(void *);
    void *finished;
    void *environment;
} Callbacks;

enum { X, U, FAULT, AT, COST, VALUES };

typedef struct {
    const Callbacks *callbacks;
    char name[64];
    double value[VALUES];
    int over, lags;
} Plant;

enum {
    NOTHING, SEGFAULT, ABORT, EXIT, HANG, ERROR, FATAL, DISCARD, OUTSIDE, NOT_A_NUMBER, STACK,
    MEMORY, LOGS, OUTPUT, CLOSES, ONCE, EXIT_READING, FREE_CRASHES, TERMINATES,
    CHANGES, OPENS, FILLS, DAEMON, SLOW, STRANGER, TELLS
};

static int instances;

static int deep(volatile int n)
{
    volatile char room[4096];
    room[0] = (char)n;
    return deep(n + 1) + room[0];
}

static void fill_memory(void)
{
    for (;;) {
        char *block = malloc(1 << 24);
        if (!block)
            abort();
        memset(block, 1, 1 << 24);
        usleep(2000);
    }
}

/* Files without end in the folder for temporary ones. */
static void fill_folder(void)
{
    static char block[1 << 20];
    const char *folder = getenv("TMPDIR");
    for (int k = 0;; k++) {
        char path[4096];
        snprintf(path, sizeof path, "%s/fill%d", folder ? folder : ".", k);
        FILE *file = fopen(path, "w");
        if (file) {
            fwrite(block, 1, sizeof block, file);
            fclose(file);
        }
        usleep(2000);
    }
}

/* A process in a session of its own that goes on for minutes. */
static void leave_daemon(void)
{
    if (fork())
        return;
    setsid();
    if (!fork())
        sleep(300);
    _exit(0);
}

static int go_wrong(Plant *p)
{
    switch ((int)p->value[FAULT]) {
    case SEGFAULT:
        raise(SIGSEGV);
        break;
    case ABORT:
        fprintf(stderr, "assertion failed in %s\n", p->name);
        abort();
    case EXIT:
        exit(0);
    case HANG:
        for (;;)
            usleep(1000);
    case ERROR:
        p->callbacks->logger(p->callbacks->environment, p->name, 3, "e", "no solution at %g", 1.5);
        p->over = 1;
        return 3;
    case FATAL:
        return 4;
    case DISCARD:
        return 2;
    case OUTSIDE:
        return -7;
    case NOT_A_NUMBER:
        p->value[X] = NAN;
        break;
    case STACK:
        return deep(0) & 0;
    case MEMORY:
        fill_memory();
        break;
    case LOGS:
        for (int k = 0; k < 200000; k++)
            p->callbacks->logger(p->callbacks->environment, p->name, 1, NULL, "%s %d",
                                 "many \xff words", k);
        break;
    case STRANGER:
        p->callbacks->logger((void *)1, p->name, 1, NULL, "from nobody");
        p->callbacks->logger(NULL, p->name, 1, NULL, "from nobody");
        break;
    case OUTPUT:
        for (;;)
            printf("%1000d\n", 1);
    case CLOSES:
        for (int k = 3; k < 256; k++)
            close(k);
        break;
    case OPENS:
        for (;;)
            if (open("/dev/null", O_RDONLY) < 0)
                usleep(1000);
    case FILLS:
        fill_folder();
        break;
    case DAEMON:
        leave_daemon();
        break;
    case CHANGES: /* what it shares with the others in its process */
        fesetround(FE_UPWARD);
        if (!setlocale(LC_NUMERIC, "C.UTF-8") || chdir("/"))
            abort();
        p->callbacks->logger(p->callbacks->environment, p->name, 0, NULL, setlocale(LC_ALL, NULL));
        break;
    case TELLS: /* how it finds its process */
        p->callbacks->logger(p->callbacks->environment, p->name, 0, NULL, setlocale(LC_ALL, NULL));
        break;
    case SLOW: /* here, and when it is read */
        usleep(900000);
        p->lags = 1;
        break;
    case ONCE: { /* the first time that a process of this folder gets here */
        const char *mark = getenv("POSMAS_TEST_MARK");
        if (mark && open(mark, O_CREAT | O_EXCL, 0600) >= 0)
            abort();
        break;
    }
    default:
        break;
    }
    return 0;
}

const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }

Component fmi2Instantiate(const char *name, int kind, const char *guid, const char *resources,
                          const Callbacks *callbacks, int visible, int logging)
{
    (void)kind, (void)guid, (void)resources, (void)visible, (void)logging;
#ifdef ONLY_ONCE
    if (instances)
        return NULL;
#endif
    instances++;
    Plant *p = calloc(1, sizeof *p);
    p->callbacks = callbacks;
    strncpy(p->name, name, sizeof p->name - 1);
    p->value[AT] = 1;
    return p;
}

void fmi2FreeInstance(Component c)
{
    if (c && ((Plant *)c)->value[FAULT] == FREE_CRASHES)
        abort();
    free(c);
    instances--;
}

int fmi2SetupExperiment(Component c, int t, double tolerance, double start, int s, double stop)
{
    (void)c, (void)t, (void)tolerance, (void)start, (void)s, (void)stop;
    return 0;
}

int fmi2EnterInitializationMode(Component c) { (void)c; return 0; }

int fmi2ExitInitializationMode(Component c)
{
    Plant *p = c;
    return p->value[AT] < 0 ? go_wrong(p) : 0;
}

int fmi2Terminate(Component c) { (void)c; return 0; }
int fmi2Reset(Component c) { ((Plant *)c)->over = 0; return 0; }

int fmi2GetReal(Component c, const unsigned *references, size_t n, double *values)
{
    Plant *p = c;
    if (p->value[FAULT] == EXIT_READING && p->value[AT] == 0)
        _exit(9);
    if (p->lags)
        usleep(900000);
    p->lags = 0;
    for (size_t k = 0; k < n; k++)
        values[k] = p->value[references[k]];
    return 0;
}

int fmi2SetReal(Component c, const unsigned *references, size_t n, const double *values)
{
    for (size_t k = 0; k < n; k++)
        ((Plant *)c)->value[references[k]] = values[k];
    return 0;
}

int fmi2DoStep(Component c, double t, double h, int no_set)
{
    Plant *p = c;
    (void)no_set;
    if (p->over)
        return 3;
    for (volatile double k = 0; k < p->value[COST]; k++)
        ;
    p->value[X] = p->value[U] + (p->value[X] - p->value[U]) * exp(-h);
    if (p->value[FAULT] == FREE_CRASHES && t >= p->value[AT])
        return 3;
    if (t >= p->value[AT] && p->value[AT] >= 0) {
        p->value[AT] = 1e300; /* once */
        return go_wrong(p);
    }
    return 0;
}

int fmi2GetFMUstate(Component c, void **state)
{
    if (!*state)
        *state = malloc(sizeof(Plant));
    memcpy(*state, c, sizeof(Plant));
    return 0;
}

int fmi2SetFMUstate(Component c, void *state)
{
    Plant *p = c, *s = state;
    memcpy(p->value, s->value, sizeof p->value);
    p->over = s->over;
    return 0;
}

int fmi2FreeFMUstate(Component c, void **state)
{
    (void)c;
    free(*state);
    *state = NULL;
    return 0;
}

int fmi2SerializedFMUstateSize(Component c, void *state, size_t *size)
{
    (void)c, (void)state;
    *size = sizeof(Plant);
    return 0;
}

int fmi2SerializeFMUstate(Component c, void *state, char *bytes, size_t size)
{
    (void)c;
    memcpy(bytes, state, size);
    return 0;
}

int fmi2DeSerializeFMUstate(Component c, const char *bytes, size_t size, void **state)
{
    (void)c;
    *state = malloc(sizeof(Plant));
    memcpy(*state, bytes, size);
    return 0;
}
