/* An FMU of FMI 2 and 3 that misbehaves in one way. The file resources/defect.txt says where and
 * how: "DoStep segv", or "DoStep segv 3" for the third call on. Without it the FMU is a good one:
 * x' = u - x, y = x, one explicit Euler step for each communication step. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fenv.h>
#include <fcntl.h>
#include <limits.h>
#include <locale.h>
#include <math.h>
#include <pthread.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "fmi2.h"
#include "fmi3.h"

#define API __attribute__((visibility("default")))

typedef struct {
    double x, u;
    int fmi;
    fmi2CallbackLogger *log2;
    fmi3LogMessageCallback *log3;
    void *environment;
    char name[64];
    char *ballast;
} Instance;

static char where[64], how[64];
static int from = 1, seen;
static double shared_x; /* of all instances, where they share */
static Instance *only;
static int value_kind; /* 1 NaN, 2 infinite, 3 absurd */

static int is(const char *call, const char *action)
{
    return strcmp(where, call) == 0 && strcmp(how, action) == 0;
}

/* ---- what it can do ---------------------------------------------------------------------- */

static void say(Instance *i, int status, const char *category, const char *text)
{
    if (!i)
        return;
    if (i->fmi == 2 && i->log2)
        i->log2(i->environment, i->name, (fmi2Status)status, category, text);
    else if (i->fmi == 3 && i->log3)
        i->log3(i->environment, (fmi3Status)status, category, text);
}

static __attribute__((noinline)) int deeper(volatile char *above)
{
    volatile char block[4096];
    block[0] = above ? above[0] : 1;
    return deeper(block) + block[0];
}

static void *talk(void *instance)
{
    say(instance, 0, "events", "from another thread");
    return NULL;
}

static void *stay(void *nothing)
{
    for (;;)
        sleep(1);
    return nothing;
}

/* 1 MiB more in the folder for temporary files. */
static void fill_folder(int number)
{
    static char block[1 << 20];
    char path[4096];
    const char *folder = getenv("TMPDIR");
    snprintf(path, sizeof path, "%s/fill%d", folder ? folder : ".", number);
    FILE *file = fopen(path, "w");
    if (!file)
        return;
    fwrite(block, 1, sizeof block, file);
    fclose(file);
    usleep(500);
}

/* A process that goes on for minutes, in a session of its own if it is a daemon. */
static void leave_behind(int apart)
{
    if (fork())
        return;
    if (apart) {
        setsid();
        if (fork())
            _exit(0);
    }
    sleep(300);
    _exit(0);
}

static volatile int zero;

static int perform(Instance *i)
{
    pthread_t thread;
    if (!strcmp(how, "segv"))
        *(volatile int *)8 = 1;
    if (!strcmp(how, "fpe")) {
        zero = 1 / zero;
        raise(SIGFPE);
    }
    if (!strcmp(how, "overflow"))
        zero = deeper(NULL);
    if (!strcmp(how, "abort"))
        abort();
    if (!strcmp(how, "exit0"))
        exit(0);
    if (!strcmp(how, "exit3"))
        _exit(3);
    if (!strcmp(how, "kill"))
        kill(0, SIGKILL);
    if (!strcmp(how, "stop"))
        raise(SIGSTOP);
    if (!strcmp(how, "ill"))
        raise(SIGILL);
    if (!strcmp(how, "hang"))
        for (;;)
            sleep(1);
    if (!strcmp(how, "slow"))
        usleep(400000);
    if (!strcmp(how, "spin"))
        for (;;)
            zero = 0;
    if (!strcmp(how, "memory"))
        for (;;) {
            char *block = malloc(4 << 20);
            if (block)
                memset(block, 1, 4 << 20);
            usleep(2000);
        }
    if (!strcmp(how, "flood"))
        for (;;)
            puts("all work and no play");
    if (!strcmp(how, "warning"))
        return 1;
    if (!strcmp(how, "discard"))
        return 2;
    if (!strcmp(how, "error"))
        return 3;
    if (!strcmp(how, "fatal"))
        return 4;
    if (!strcmp(how, "pending"))
        return 5;
    if (!strcmp(how, "six"))
        return 6;
    if (!strcmp(how, "minus"))
        return -1;
    if (!strcmp(how, "far"))
        return INT_MAX;
    if (!strcmp(how, "nan"))
        value_kind = 1;
    if (!strcmp(how, "inf"))
        value_kind = 2;
    if (!strcmp(how, "absurd"))
        value_kind = 3;
    if (!strcmp(how, "log-null"))
        say(i, 0, "events", NULL);
    if (!strcmp(how, "log-category"))
        say(i, 0, NULL, "of no category");
    if (!strcmp(how, "log-utf8"))
        say(i, 0, "events", "\xff\xfe temperature in \xb0""C");
    if (!strcmp(how, "log-format"))
        say(i, 0, "events", "%s%s%n%");
    if (!strcmp(how, "log-status"))
        say(i, 99, "events", "of no status");
    if (!strcmp(how, "log-environment") && i) {
        void *kept = i->environment;
        i->environment = (void *)(intptr_t)1;
        say(i, 0, "events", "from nobody");
        i->environment = kept;
    }
    if (!strcmp(how, "log-large")) {
        char *text = malloc(8 << 20);
        memset(text, 'a', 8 << 20);
        text[(8 << 20) - 1] = 0;
        say(i, 0, "events", text);
        free(text);
    }
    if (!strcmp(how, "log-endless"))
        for (;;)
            say(i, 0, "events", "all work and no play");
    if (!strcmp(how, "log-thread") && !pthread_create(&thread, NULL, talk, i))
        pthread_join(thread, NULL);
    if (!strcmp(how, "thread") && !pthread_create(&thread, NULL, stay, NULL))
        pthread_detach(thread);
    if (!strcmp(how, "leak"))
        memset(malloc(64 << 10), 1, 64 << 10);
    if (!strcmp(how, "folder") && chdir("/"))
        return 3;
    if (!strcmp(how, "locale") && !strcmp(setlocale(LC_ALL, NULL), setlocale(LC_ALL, "C")))
        setlocale(LC_ALL, "C.UTF-8");
    if (!strcmp(how, "environment"))
        setenv("LC_NUMERIC", "de_DE.UTF-8", 1);
    if (!strcmp(how, "rounding"))
        fesetround(FE_UPWARD);
#ifdef __x86_64__
    if (!strcmp(how, "denormals"))
        __builtin_ia32_ldmxcsr(__builtin_ia32_stmxcsr() | 0x8040);
#endif
#ifdef __GLIBC__
    if (!strcmp(how, "traps"))
        feenableexcept(FE_DIVBYZERO | FE_INVALID);
#endif
    if (!strcmp(how, "signals"))
        signal(SIGINT, SIG_IGN);
    if (!strcmp(how, "handler"))
        signal(SIGSEGV, SIG_IGN);
    if (!strcmp(how, "close"))
        for (int fd = 0; fd < 256; fd++)
            close(fd);
    if (!strcmp(how, "opens"))
        for (;;)
            if (open("/dev/null", O_RDONLY) < 0)
                usleep(1000);
    if (!strcmp(how, "fills"))
        for (int file = 0;; file++)
            fill_folder(file);
    if (!strcmp(how, "child") && seen == from)
        leave_behind(0);
    if (!strcmp(how, "daemon") && seen == from)
        leave_behind(1);
    if (!strcmp(how, "open") && open("/dev/null", O_RDONLY) < 0)
        return 3;
    return 0;
}

/* What every call begins with. */
static int at(Instance *i, const char *call)
{
    if (strcmp(call, where) || ++seen < from)
        return 0;
    return perform(i);
}

__attribute__((constructor)) static void loaded(void)
{
    Dl_info info;
    char path[4096], *end;
    if (!dladdr((void *)&loaded, &info))
        return;
    snprintf(path, sizeof path - 64, "%s", info.dli_fname);
    for (int up = 0; up < 3; up++) { /* binaries/linux64/hostile.so */
        end = strrchr(path, '/');
        if (!end)
            return;
        *end = 0;
    }
    strcat(path, "/resources/defect.txt");
    FILE *file = fopen(path, "r");
    if (!file)
        return;
    if (fscanf(file, "%63s %63s %d", where, how, &from) < 2)
        where[0] = 0;
    fclose(file);
    at(NULL, "dlopen");
}

__attribute__((destructor)) static void unloaded(void)
{
    at(NULL, "dlclose");
}

static Instance *made(int fmi, const char *name, const char *token)
{
    if (token && *token && strcmp(token, "{1}"))
        return NULL;
    Instance *i = only && is("Instantiate", "same") ? only : calloc(1, sizeof *i);
    only = i;
    i->fmi = fmi;
    snprintf(i->name, sizeof i->name, "%s", name ? name : "");
    i->x = shared_x = 1.0;
    if (is("FreeInstance", "keeps"))
        i->ballast = memset(malloc(1 << 20), 1, 1 << 20);
    return i;
}

static void advance(Instance *i, double h)
{
    double *x = is("DoStep", "shared") ? &shared_x : &i->x;
    *x += h * (i->u - *x);
    if (is("DoStep", "random"))
        *x += 0.01 * ++seen;
    i->x = *x;
}

static void fill(Instance *i, const unsigned *vr, size_t n, double *y)
{
    for (size_t k = 0; k < n; k++)
        y[k] = value_kind == 1 ? NAN : value_kind == 2 ? INFINITY : value_kind == 3 ? 1e300
               : vr[k] == 0 ? i->u : vr[k] == 2 ? i->u - i->x : i->x;
}

static void back_to_start(Instance *i)
{
    if (is("Reset", "nothing"))
        return;
    i->x = shared_x = 1.0;
    i->u = 0.0;
}

static void restored(Instance *i, const Instance *state)
{
    if (is("SetFMUstate", "nothing"))
        return;
    i->x = shared_x = state->x;
    i->u = state->u;
    if (is("SetFMUstate", "noise"))
        i->x *= 1.0 + 1e-5;
}

static void forget(Instance *i)
{
    if (is("Instantiate", "same"))
        return;
    if (is("FreeInstance", "twice"))
        free(i);
    free(i);
}

/* ---- FMI 2 --------------------------------------------------------------------------------- */

API fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid,
                                  fmi2String resources, const fmi2CallbackFunctions *functions,
                                  fmi2Boolean visible, fmi2Boolean logging)
{
    (void)type, (void)resources, (void)visible;
    Instance *i = made(2, name, guid);
    if (!i && logging) /* many say why only if they are asked to */
        functions->logger(functions->componentEnvironment, name, fmi2Error, "error",
                          "this GUID is not mine");
    if (!i)
        return NULL;
    i->log2 = functions->logger;
    i->environment = functions->componentEnvironment;
    at(i, "Instantiate");
    return is("Instantiate", "null") ? NULL : i;
}

API void fmi2FreeInstance(fmi2Component i)
{
    at(i, "FreeInstance");
    forget(i);
}

API fmi2Status fmi2SetupExperiment(fmi2Component i, fmi2Boolean a, fmi2Real b, fmi2Real c,
                                   fmi2Boolean d, fmi2Real e)
{
    (void)a, (void)b, (void)c, (void)d, (void)e;
    return (fmi2Status)at(i, "SetupExperiment");
}

#define PLAIN2(call)                                                                             \
    API fmi2Status fmi2##call(fmi2Component i) { return (fmi2Status)at(i, #call); }
PLAIN2(EnterInitializationMode)
PLAIN2(ExitInitializationMode)
PLAIN2(Terminate)

API fmi2Status fmi2Reset(fmi2Component i)
{
    back_to_start(i);
    return (fmi2Status)at(i, "Reset");
}

API fmi2Status fmi2GetReal(fmi2Component i, const fmi2ValueReference *vr, size_t n, fmi2Real *y)
{
    int status = at(i, "Get");
    fill(i, vr, n, y);
    return (fmi2Status)status;
}

API fmi2Status fmi2SetReal(fmi2Component i, const fmi2ValueReference *vr, size_t n,
                           const fmi2Real *u)
{
    for (size_t k = 0; k < n; k++)
        *(vr[k] == 0 ? &((Instance *)i)->u : &((Instance *)i)->x) = u[k];
    return (fmi2Status)at(i, "Set");
}

API fmi2Status fmi2DoStep(fmi2Component i, fmi2Real t, fmi2Real h, fmi2Boolean keep)
{
    (void)t, (void)keep;
    int status = at(i, "DoStep");
    advance(i, h);
    return (fmi2Status)status;
}

static int saved(Instance *i, void **state)
{
    if (!*state)
        *state = malloc(sizeof(Instance));
    memcpy(*state, i, sizeof(Instance));
    return at(i, "GetFMUstate");
}

static int freed(Instance *i, void **state)
{
    free(*state);
    *state = NULL;
    return at(i, "FreeFMUstate");
}

static int serialised(Instance *i, void *state, void *bytes)
{
    memcpy(bytes, state, sizeof(Instance));
    return at(i, "SerializeFMUstate");
}

static int deserialised(Instance *i, const void *bytes, void **state)
{
    *state = malloc(sizeof(Instance));
    memcpy(*state, bytes, sizeof(Instance));
    if (is("DeSerializeFMUstate", "zero"))
        ((Instance *)*state)->x = 0;
    return at(i, "DeSerializeFMUstate");
}

API fmi2Status fmi2GetFMUstate(fmi2Component i, fmi2FMUstate *s) { return (fmi2Status)saved(i, s); }
API fmi2Status fmi2FreeFMUstate(fmi2Component i, fmi2FMUstate *s) { return (fmi2Status)freed(i, s); }
API fmi2Status fmi2SetFMUstate(fmi2Component i, fmi2FMUstate s)
{
    restored(i, s);
    return (fmi2Status)at(i, "SetFMUstate");
}
API fmi2Status fmi2SerializedFMUstateSize(fmi2Component i, fmi2FMUstate s, size_t *n)
{
    (void)s;
    *n = sizeof(Instance);
    return (fmi2Status)at(i, "SerializedFMUstateSize");
}
API fmi2Status fmi2SerializeFMUstate(fmi2Component i, fmi2FMUstate s, fmi2Byte *b, size_t n)
{
    (void)n;
    return (fmi2Status)serialised(i, s, b);
}
API fmi2Status fmi2DeSerializeFMUstate(fmi2Component i, const fmi2Byte *b, size_t n,
                                       fmi2FMUstate *s)
{
    (void)n;
    return (fmi2Status)deserialised(i, b, s);
}

/* ---- FMI 3 --------------------------------------------------------------------------------- */

API fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
    fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early, const fmi3ValueReference *required,
    size_t n, fmi3InstanceEnvironment environment, fmi3LogMessageCallback *log, void *update)
{
    (void)resources, (void)visible, (void)events, (void)early;
    (void)required, (void)n, (void)update;
    Instance *i = made(3, name, token);
    if (!i && logging)
        log(environment, fmi3Error, "error", "this token is not mine");
    if (!i)
        return NULL;
    i->log3 = log;
    i->environment = environment;
    at(i, "Instantiate");
    return is("Instantiate", "null") ? NULL : i;
}

API void fmi3FreeInstance(fmi3Instance i)
{
    at(i, "FreeInstance");
    forget(i);
}

API fmi3Status fmi3EnterInitializationMode(fmi3Instance i, fmi3Boolean a, fmi3Float64 b,
                                           fmi3Float64 c, fmi3Boolean d, fmi3Float64 e)
{
    (void)a, (void)b, (void)c, (void)d, (void)e;
    return (fmi3Status)at(i, "EnterInitializationMode");
}

#define PLAIN3(call)                                                                             \
    API fmi3Status fmi3##call(fmi3Instance i) { return (fmi3Status)at(i, #call); }
PLAIN3(ExitInitializationMode)
PLAIN3(Terminate)

API fmi3Status fmi3Reset(fmi3Instance i)
{
    back_to_start(i);
    return (fmi3Status)at(i, "Reset");
}

API fmi3Status fmi3GetFloat64(fmi3Instance i, const fmi3ValueReference *vr, size_t n,
                              fmi3Float64 *y, size_t count)
{
    (void)count;
    int status = at(i, "Get");
    fill(i, vr, n, y);
    return (fmi3Status)status;
}

API fmi3Status fmi3SetFloat64(fmi3Instance i, const fmi3ValueReference *vr, size_t n,
                              const fmi3Float64 *u, size_t count)
{
    (void)count;
    return (fmi3Status)fmi2SetReal(i, vr, n, u);
}

API fmi3Status fmi3DoStep(fmi3Instance i, fmi3Float64 t, fmi3Float64 h, fmi3Boolean keep,
                          fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early,
                          fmi3Float64 *last)
{
    (void)keep;
    int status = at(i, "DoStep");
    *event = false;
    *terminate = is("DoStep", "terminates");
    *early = is("DoStep", "stuck");
    *last = *early ? t : t + h;
    advance(i, h);
    return (fmi3Status)status;
}

API fmi3Status fmi3GetFMUState(fmi3Instance i, fmi3FMUState *s) { return (fmi3Status)saved(i, s); }
API fmi3Status fmi3FreeFMUState(fmi3Instance i, fmi3FMUState *s) { return (fmi3Status)freed(i, s); }
API fmi3Status fmi3SetFMUState(fmi3Instance i, fmi3FMUState s)
{
    restored(i, s);
    return (fmi3Status)at(i, "SetFMUstate");
}
API fmi3Status fmi3SerializedFMUStateSize(fmi3Instance i, fmi3FMUState s, size_t *n)
{
    (void)s;
    *n = sizeof(Instance);
    return (fmi3Status)at(i, "SerializedFMUstateSize");
}
API fmi3Status fmi3SerializeFMUState(fmi3Instance i, fmi3FMUState s, fmi3Byte *b, size_t n)
{
    (void)n;
    return (fmi3Status)serialised(i, s, b);
}
API fmi3Status fmi3DeserializeFMUState(fmi3Instance i, const fmi3Byte *b, size_t n,
                                       fmi3FMUState *s)
{
    (void)n;
    return (fmi3Status)deserialised(i, b, s);
}
