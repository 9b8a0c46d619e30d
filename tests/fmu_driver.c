/* Drives an FMU's sources, linked statically, through their whole life: for the sanitisers. */
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"

#define CHECK(condition)                                              \
    do {                                                              \
        if (!(condition)) {                                           \
            fprintf(stderr, "line %d: %s\n", __LINE__, #condition);   \
            exit(1);                                                  \
        }                                                             \
    } while (0)

static int messages;

#ifdef DRIVE_FMI2
#include "fmi2.c"
typedef fmi2Component Component;
typedef fmi2FMUstate Saved;
static void log_message(fmi2ComponentEnvironment environment, fmi2String name, fmi2Status status,
                        fmi2String category, fmi2String message, ...)
{
    (void)environment, (void)status, (void)category;
    CHECK(name && message && !strchr(message, '%'));
    messages++;
}
static Component create(const char *token, int exchange)
{
    /* The importer may drop the structure; only what it points to must stay. */
    fmi2CallbackFunctions functions = {log_message, calloc, free, NULL, NULL};
    return fmi2Instantiate("agent", exchange ? fmi2ModelExchange : fmi2CoSimulation, token, "",
                           &functions, 0, 0);
}
#define CALL(name) fmi2##name
#define GET(c, vr, n, value, count) fmi2GetReal(c, vr, n, value)
#define SET(c, vr, n, value, count) fmi2SetReal(c, vr, n, value)
#define SAVE fmi2GetFMUstate
#define RESTORE fmi2SetFMUstate
#define RELEASE fmi2FreeFMUstate
#define SIZE fmi2SerializedFMUstateSize
#define WRITE(c, s, b, n) fmi2SerializeFMUstate(c, s, b, n)
#define READ(c, b, n, s) fmi2DeSerializeFMUstate(c, b, n, s)
static int step(Component c, double t, double h)
{
    return fmi2DoStep(c, t, h, 0);
}
static int enter(Component c)
{
    CHECK(fmi2SetupExperiment(c, 1, 1e-8, 0, 1, 100) == 0);
    return fmi2EnterInitializationMode(c);
}
static int directional(Component c, const uint32_t *of, const uint32_t *by, const double *seed,
                       double *result)
{
    return fmi2GetDirectionalDerivative(c, of, 1, by, 1, seed, result);
}
static void discrete(Component c)
{
    fmi2EventInfo info;
    CHECK(fmi2NewDiscreteStates(c, &info) == 0);
}
#define DERIVATIVES fmi2GetDerivatives
#define WIDTH(vr) 1
#else
#include "fmi3.c"
typedef fmi3Instance Component;
typedef fmi3FMUState Saved;
static void log_message(fmi3InstanceEnvironment environment, fmi3Status status,
                        fmi3String category, fmi3String message)
{
    (void)environment, (void)status, (void)category;
    CHECK(message && !strchr(message, '%'));
    messages++;
}
static Component create(const char *token, int exchange)
{
    return exchange ? fmi3InstantiateModelExchange("agent", token, "", 0, 0, NULL, log_message)
                    : fmi3InstantiateCoSimulation("agent", token, "", 0, 0, 0, 0, NULL, 0, NULL,
                                                  log_message, NULL);
}
#define CALL(name) fmi3##name
#define GET fmi3GetFloat64
#define SET fmi3SetFloat64
#define SAVE fmi3GetFMUState
#define RESTORE fmi3SetFMUState
#define RELEASE fmi3FreeFMUState
#define SIZE fmi3SerializedFMUStateSize
#define WRITE(c, s, b, n) fmi3SerializeFMUState(c, s, (fmi3Byte *)(b), n)
#define READ(c, b, n, s) fmi3DeserializeFMUState(c, (const fmi3Byte *)(b), n, s)
static int step(Component c, double t, double h)
{
    bool event, terminate, early;
    double last;
    return fmi3DoStep(c, t, h, 0, &event, &terminate, &early, &last);
}
static int enter(Component c)
{
    return fmi3EnterInitializationMode(c, 1, 1e-8, 0, 1, 100);
}
static int directional(Component c, const uint32_t *of, const uint32_t *by, const double *seed,
                       double *result)
{
    return fmi3GetDirectionalDerivative(c, of, 1, by, 1, seed, model_size[*by], result,
                                        model_size[*of]);
}
static void discrete(Component c)
{
    bool flag[5];
    double next;
    CHECK(fmi3UpdateDiscreteStates(c, flag, flag + 1, flag + 2, flag + 3, flag + 4, &next) == 0);
}
#define DERIVATIVES fmi3GetContinuousStateDerivatives
#define WIDTH(vr) model_size[vr]
#endif

int main(void)
{
    enum { N = 50 };
    static Component many[N];
    const uint32_t u = AT_U, x = AT_X, dx = AT_DX, y = AT_Y, p = AT_P, none = MODEL_NV + 7;
    double value[MODEL_NV], again[MODEL_NV], seed[MODEL_NV] = {1};

    CHECK(!create("{not-this-one}", 0) && !create(NULL, 1) && messages == 2);

    for (int i = 0; i < N; i++) {
        Component c = many[i] = create(MODEL_TOKEN, 0);
        CHECK(c);
        CHECK(step(c, 0, 0.1) == 3); /* too early */
        CHECK(enter(c) == 0 && CALL(ExitInitializationMode)(c) == 0);
    }
    for (int k = 0; k < 20; k++)
        for (int i = 0; i < N; i++) {
            double input[MODEL_NU] = {0.01 * i};
            CHECK(SET(many[i], &u, 1, input, MODEL_NU) == 0);
            CHECK(step(many[i], 0.1 * k, 0.1) == 0);
            CHECK(GET(many[i], &y, 1, value, WIDTH(y)) == 0);
        }

    Component c = many[7];
    double nothing = NAN;
    int before = messages;
    CHECK(SET(c, &none, 1, value, 1) == 3 && GET(c, &none, 1, value, 1) == 3);
    CHECK(SET(c, &u, 1, &nothing, 1) == 3);
    CHECK(SET(c, &x, 1, value, WIDTH(x)) == 3 && step(c, 1.0, 0.1) == 3);
    CHECK(step(c, 2.0, -0.1) == 3 && step(c, 2.0, 200) == 3);
    CHECK(CALL(ExitInitializationMode)(c) == 3);
    CHECK(messages == before + 8);
    CHECK(directional(c, &dx, &x, seed, value) == 0 && directional(c, &y, &u, seed, value) == 0);
    CHECK(directional(c, &dx, &p, seed, value) == 3 && directional(c, &x, &u, seed, value) == 3);

    Saved state = NULL, other = NULL;
    size_t size = 0;
    CHECK(SAVE(c, &state) == 0 && SAVE(c, &state) == 0 && SIZE(c, state, &size) == 0);
    char *bytes = malloc(size);
    CHECK(WRITE(c, state, bytes, size - 1) == 3 && WRITE(c, state, bytes, size) == 0);
    CHECK(step(c, 2.0, 0.37) == 0 && GET(c, &x, 1, value, WIDTH(x)) == 0);
    CHECK(READ(c, bytes, size - 1, &other) == 3 && READ(c, bytes, size, &other) == 0);
    CHECK(RESTORE(c, NULL) == 3 && RESTORE(c, other) == 0);
    CHECK(step(c, 2.0, 0.37) == 0 && GET(c, &x, 1, again, WIDTH(x)) == 0);
    CHECK(memcmp(value, again, WIDTH(x) * sizeof *value) == 0);
    bytes[3] ^= 1; /* of another model */
    CHECK(READ(c, bytes, size, &other) == 3);
    CHECK(RELEASE(c, &state) == 0 && RELEASE(c, &other) == 0 && RELEASE(c, &other) == 0);
    free(bytes);
    CHECK(CALL(Terminate)(c) == 0 && CALL(Terminate)(c) == 3);
    CHECK(CALL(Reset)(c) == 0 && enter(c) == 0);
    for (int i = 0; i < N; i++)
        CALL(FreeInstance)(many[i]);
    CALL(FreeInstance)(NULL);

    c = create(MODEL_TOKEN, 1);
    CHECK(c && enter(c) == 0 && CALL(ExitInitializationMode)(c) == 0);
    CHECK(step(c, 0, 0.1) == 3);
    discrete(c);
    CHECK(CALL(EnterContinuousTimeMode)(c) == 0);
    CHECK(CALL(GetContinuousStates)(c, value, MODEL_NX) == 0);
    CHECK(CALL(SetTime)(c, 0.5) == 0 && CALL(SetContinuousStates)(c, value, MODEL_NX) == 0);
    CHECK(DERIVATIVES(c, value, MODEL_NX) == 0 && DERIVATIVES(c, value, MODEL_NX + 1) == 3);
    CHECK(CALL(GetNominalsOfContinuousStates)(c, value, MODEL_NX) == 0 && value[0] > 0);
    CHECK(CALL(GetEventIndicators)(c, NULL, 0) == 0);
    CHECK(CALL(SetContinuousStates)(c, &nothing, 1) != 0);
    CALL(FreeInstance)(c);
    return 0;
}
