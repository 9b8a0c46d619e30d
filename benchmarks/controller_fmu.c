/* A controller of the protocol as an FMU (FMI 2, Co-Simulation), from the same C source as the
 * engine's: for masters that know nothing of protocols. A step takes y and what was heard at its
 * beginning and gives u, held from its end on, and the estimate there.
 *
 * `controller_data.h` (generated) holds CONTROLLER, the constants, HEARD and TOKEN. A controller
 * whose weights are all 0 is a leader: its estimate runs free. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "controller.h"
#include "controller_data.h"
#include "export.h"
#include "fmi2.h"

/* Value references are places in this array. */
enum {
    AT_Y = 0,
    AT_HEARD = AT_Y + Q,            /* estimates of HEARD neighbours */
    AT_S = AT_HEARD + HEARD * M,    /* the leader's state */
    AT_OWN = AT_S + M,              /* weights, as in engine.h */
    AT_WEIGHT = AT_OWN + 1,
    AT_LEADER = AT_WEIGHT + HEARD,
    AT_INNOVATION = AT_LEADER + 1,
    AT_U = AT_INNOVATION + 1,
    AT_XHAT = AT_U + P,
    VALUES = AT_XHAT + M
};

typedef struct {
    double v[VALUES];
} Instance;

static void act(double *v, double t)
{
    const double silence[2] = {0, 0};
    double message[MESSAGE], disagreement[MESSAGE], next[MEMORY], applied[P];
    controller_send(&CONTROLLER, NULL, v + AT_XHAT, v + AT_Y, message);
    for (int j = 0; j < M; j++) {
        double heard = 0;
        for (int n = 0; n < HEARD; n++)
            heard += v[AT_WEIGHT + n] * v[AT_HEARD + n * M + j];
        disagreement[j] = v[AT_OWN] * message[j] - heard - v[AT_LEADER] * v[AT_S + j];
    }
    for (int j = M; j < MESSAGE; j++)
        disagreement[j] = v[AT_INNOVATION] * message[j];
    controller_step(&CONTROLLER, NULL, t, v + AT_Y, disagreement, silence, v + AT_XHAT, next,
                    v + AT_U, applied);
    memcpy(v + AT_XHAT, next, M * sizeof *next);
}

EXPORT fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String token,
                                     fmi2String resources, const fmi2CallbackFunctions *functions,
                                     fmi2Boolean visible, fmi2Boolean logging)
{
    (void)name, (void)resources, (void)functions, (void)visible, (void)logging;
    if (type != fmi2CoSimulation || strcmp(token, TOKEN) != 0)
        return NULL;
    return calloc(1, sizeof(Instance));
}

EXPORT void fmi2FreeInstance(fmi2Component c)
{
    free(c);
}

EXPORT fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                              const fmi2Real value[])
{
    for (size_t i = 0; i < n; i++) {
        if (vr[i] >= VALUES)
            return fmi2Error;
        ((Instance *)c)->v[vr[i]] = value[i];
    }
    return fmi2OK;
}

EXPORT fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                              fmi2Real value[])
{
    for (size_t i = 0; i < n; i++) {
        if (vr[i] >= VALUES)
            return fmi2Error;
        value[i] = ((Instance *)c)->v[vr[i]];
    }
    return fmi2OK;
}

EXPORT fmi2Status fmi2DoStep(fmi2Component c, fmi2Real t, fmi2Real h, fmi2Boolean no_return)
{
    (void)no_return;
    if (fabs(h - CONTROLLER.h) > 1e-9 * CONTROLLER.h)
        return fmi2Error;
    act(((Instance *)c)->v, t);
    return fmi2OK;
}

EXPORT const char *fmi2GetTypesPlatform(void)
{
    return "default";
}

EXPORT const char *fmi2GetVersion(void)
{
    return "2.0";
}

/* What any importer calls and this FMU has nothing to do for, then what it does not have. */
#define NOTHING(NAME, STATUS, ...)                                                                \
    EXPORT fmi2Status NAME(__VA_ARGS__)                                                           \
    {                                                                                             \
        return STATUS;                                                                            \
    }
#define C fmi2Component c
NOTHING(fmi2SetupExperiment, fmi2OK, C, fmi2Boolean d, fmi2Real e, fmi2Real b, fmi2Boolean g,
        fmi2Real f)
NOTHING(fmi2EnterInitializationMode, fmi2OK, C)
NOTHING(fmi2ExitInitializationMode, fmi2OK, C)
NOTHING(fmi2Terminate, fmi2OK, C)
NOTHING(fmi2Reset, fmi2Error, C)
NOTHING(fmi2SetDebugLogging, fmi2OK, C, fmi2Boolean on, size_t n, const fmi2String s[])
NOTHING(fmi2CancelStep, fmi2Error, C)
#define TYPE(NAME)                                                                                \
    NOTHING(fmi2Get##NAME, n ? fmi2Error : fmi2OK, C, const fmi2ValueReference r[], size_t n,     \
            fmi2##NAME v[])                                                                       \
    NOTHING(fmi2Set##NAME, n ? fmi2Error : fmi2OK, C, const fmi2ValueReference r[], size_t n,     \
            const fmi2##NAME v[])
TYPE(Integer)
TYPE(Boolean)
TYPE(String)
NOTHING(fmi2GetFMUstate, fmi2Error, C, fmi2FMUstate *s)
NOTHING(fmi2SetFMUstate, fmi2Error, C, fmi2FMUstate s)
NOTHING(fmi2FreeFMUstate, fmi2Error, C, fmi2FMUstate *s)
NOTHING(fmi2SerializedFMUstateSize, fmi2Error, C, fmi2FMUstate s, size_t *n)
NOTHING(fmi2SerializeFMUstate, fmi2Error, C, fmi2FMUstate s, fmi2Byte b[], size_t n)
NOTHING(fmi2DeSerializeFMUstate, fmi2Error, C, const fmi2Byte b[], size_t n, fmi2FMUstate *s)
NOTHING(fmi2GetDirectionalDerivative, fmi2Error, C, const fmi2ValueReference a[], size_t n,
        const fmi2ValueReference b[], size_t m, const fmi2Real d[], fmi2Real e[])
NOTHING(fmi2SetRealInputDerivatives, fmi2Error, C, const fmi2ValueReference r[], size_t n,
        const fmi2Integer o[], const fmi2Real v[])
NOTHING(fmi2GetRealOutputDerivatives, fmi2Error, C, const fmi2ValueReference r[], size_t n,
        const fmi2Integer o[], fmi2Real v[])
NOTHING(fmi2GetStatus, fmi2Discard, C, const fmi2StatusKind k, fmi2Status *v)
NOTHING(fmi2GetRealStatus, fmi2Discard, C, const fmi2StatusKind k, fmi2Real *v)
NOTHING(fmi2GetIntegerStatus, fmi2Discard, C, const fmi2StatusKind k, fmi2Integer *v)
NOTHING(fmi2GetBooleanStatus, fmi2Discard, C, const fmi2StatusKind k, fmi2Boolean *v)
NOTHING(fmi2GetStringStatus, fmi2Discard, C, const fmi2StatusKind k, fmi2String *v)
