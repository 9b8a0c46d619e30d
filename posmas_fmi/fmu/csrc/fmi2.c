/* FMI 2.0, Model Exchange and Co-Simulation: translates each call into one of instance.h. */
#include "fmi2.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "export.h"
#include "instance.h"

#define INSTANCE(c) ((Instance *)(c))
#define EXPECT(call, modes)                                                                       \
    do {                                                                                          \
        if (!c)                                                                                   \
            return fmi2Error;                                                                     \
        if (instance_expect(INSTANCE(c), call, modes) != STATUS_OK)                               \
            return fmi2Error;                                                                     \
    } while (0)

static void log_fmi2(const Instance *c, Status status, const char *category, const char *message)
{
    ((fmi2CallbackLogger *)c->callback)(c->environment, c->name, (fmi2Status)status, category,
                                        message);
}

static fmi2Status not_provided(fmi2Component c, const char *what)
{
    if (c)
        instance_log(INSTANCE(c), STATUS_ERROR, "this FMU has no %s", what);
    return fmi2Error;
}

/* ---- common ------------------------------------------------------------------------------ */

EXPORT const char *fmi2GetTypesPlatform(void)
{
    return "default";
}

EXPORT const char *fmi2GetVersion(void)
{
    return "2.0";
}

EXPORT fmi2Component fmi2Instantiate(fmi2String instanceName, fmi2Type fmuType, fmi2String fmuGUID,
                                     fmi2String fmuResourceLocation,
                                     const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                                     fmi2Boolean loggingOn)
{
    (void)fmuResourceLocation;
    (void)visible;
    (void)loggingOn; /* only warnings and errors are logged, and those always */
    Instance first;
    memset(&first, 0, sizeof first);
    first.log = log_fmi2;
    first.name = (char *)instanceName;
    if (functions) {
        first.callback = (void (*)(void))functions->logger;
        first.environment = functions->componentEnvironment;
    }
    return instance_new(&first, fmuGUID,
                        fmuType == fmi2CoSimulation ? CO_SIMULATION : MODEL_EXCHANGE, 0);
}

EXPORT void fmi2FreeInstance(fmi2Component c)
{
    instance_free(INSTANCE(c));
}

EXPORT fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean loggingOn, size_t nCategories,
                                      const fmi2String categories[])
{
    (void)loggingOn;
    (void)nCategories;
    (void)categories;
    return c ? fmi2OK : fmi2Error;
}

EXPORT fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined,
                                      fmi2Real tolerance, fmi2Real startTime,
                                      fmi2Boolean stopTimeDefined, fmi2Real stopTime)
{
    EXPECT("fmi2SetupExperiment", MODE_INSTANTIATED);
    return (fmi2Status)instance_setup(INSTANCE(c), startTime, toleranceDefined ? tolerance : 0,
                                      stopTimeDefined ? stopTime : HUGE_VAL);
}

EXPORT fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    return c ? (fmi2Status)instance_initialise(INSTANCE(c)) : fmi2Error;
}

EXPORT fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    return c ? (fmi2Status)instance_initialised(INSTANCE(c)) : fmi2Error;
}

EXPORT fmi2Status fmi2Terminate(fmi2Component c)
{
    return c ? (fmi2Status)instance_terminate(INSTANCE(c)) : fmi2Error;
}

EXPORT fmi2Status fmi2Reset(fmi2Component c)
{
    EXPECT("fmi2Reset", MODE_ANY);
    instance_reset(INSTANCE(c));
    return fmi2OK;
}

/* ---- values ------------------------------------------------------------------------------ */

EXPORT fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                              fmi2Real value[])
{
    return c ? (fmi2Status)instance_get(INSTANCE(c), vr, nvr, value, nvr) : fmi2Error;
}

EXPORT fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                              const fmi2Real value[])
{
    return c ? (fmi2Status)instance_set(INSTANCE(c), vr, nvr, value, nvr) : fmi2Error;
}

/* The other types: this FMU has no such variables, so only a call for none of them is right. */
#define NO_VARIABLES(TYPE)                                                                        \
    EXPORT fmi2Status fmi2Get##TYPE(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,   \
                                    fmi2##TYPE value[])                                           \
    {                                                                                             \
        (void)vr;                                                                                 \
        (void)value;                                                                              \
        return c && nvr == 0 ? fmi2OK : not_provided(c, #TYPE " variables");                      \
    }                                                                                             \
    EXPORT fmi2Status fmi2Set##TYPE(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,   \
                                    const fmi2##TYPE value[])                                     \
    {                                                                                             \
        (void)vr;                                                                                 \
        (void)value;                                                                              \
        return c && nvr == 0 ? fmi2OK : not_provided(c, #TYPE " variables");                      \
    }

NO_VARIABLES(Integer)
NO_VARIABLES(Boolean)
NO_VARIABLES(String)

EXPORT fmi2Status fmi2GetDirectionalDerivative(fmi2Component c,
                                               const fmi2ValueReference vUnknown_ref[],
                                               size_t nUnknown,
                                               const fmi2ValueReference vKnown_ref[], size_t nKnown,
                                               const fmi2Real dvKnown[], fmi2Real dvUnknown[])
{
    EXPECT("fmi2GetDirectionalDerivative",
           MODE_INITIALISING | MODE_RUNNING | MODE_TERMINATED | MODE_FAILED);
    return (fmi2Status)instance_directional(INSTANCE(c), vUnknown_ref, nUnknown, vKnown_ref, nKnown,
                                            dvKnown, nKnown, dvUnknown, nUnknown);
}

/* ---- state ------------------------------------------------------------------------------- */

EXPORT fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *FMUstate)
{
    return c && FMUstate ? (fmi2Status)instance_save(INSTANCE(c), (State **)FMUstate) : fmi2Error;
}

EXPORT fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate FMUstate)
{
    return c ? (fmi2Status)instance_restore(INSTANCE(c), FMUstate) : fmi2Error;
}

EXPORT fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *FMUstate)
{
    if (!c)
        return fmi2Error;
    if (FMUstate) {
        free(*FMUstate);
        *FMUstate = NULL;
    }
    return fmi2OK;
}

EXPORT fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate FMUstate, size_t *size)
{
    if (!c || !FMUstate || !size)
        return fmi2Error;
    *size = instance_serialised_size();
    return fmi2OK;
}

EXPORT fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate FMUstate,
                                        fmi2Byte serializedState[], size_t size)
{
    return c ? (fmi2Status)instance_serialise(INSTANCE(c), FMUstate, serializedState, size)
             : fmi2Error;
}

EXPORT fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte serializedState[],
                                          size_t size, fmi2FMUstate *FMUstate)
{
    return c && FMUstate ? (fmi2Status)instance_deserialise(INSTANCE(c), serializedState, size,
                                                            (State **)FMUstate)
                         : fmi2Error;
}

/* ---- Model Exchange ---------------------------------------------------------------------- */

EXPORT fmi2Status fmi2EnterEventMode(fmi2Component c)
{
    EXPECT("fmi2EnterEventMode", MODE_EVENT | MODE_CONTINUOUS);
    INSTANCE(c)->state.mode = MODE_EVENT;
    return fmi2OK;
}

EXPORT fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *eventInfo)
{
    EXPECT("fmi2NewDiscreteStates", MODE_EVENT);
    memset(eventInfo, 0, sizeof *eventInfo); /* no events: nothing changes, none is due */
    return fmi2OK;
}

EXPORT fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c)
{
    EXPECT("fmi2EnterContinuousTimeMode", MODE_EVENT);
    INSTANCE(c)->state.mode = MODE_CONTINUOUS;
    return fmi2OK;
}

EXPORT fmi2Status fmi2CompletedIntegratorStep(fmi2Component c,
                                              fmi2Boolean noSetFMUStatePriorToCurrentPoint,
                                              fmi2Boolean *enterEventMode,
                                              fmi2Boolean *terminateSimulation)
{
    (void)noSetFMUStatePriorToCurrentPoint;
    EXPECT("fmi2CompletedIntegratorStep", MODE_CONTINUOUS);
    *enterEventMode = fmi2False;
    *terminateSimulation = fmi2False;
    return fmi2OK;
}

EXPORT fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time)
{
    return c ? (fmi2Status)instance_set_time(INSTANCE(c), time) : fmi2Error;
}

EXPORT fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t nx)
{
    return c ? (fmi2Status)instance_set_states(INSTANCE(c), x, nx) : fmi2Error;
}

EXPORT fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real derivatives[], size_t nx)
{
    return c ? (fmi2Status)instance_get_derivatives(INSTANCE(c), derivatives, nx) : fmi2Error;
}

EXPORT fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real eventIndicators[], size_t ni)
{
    (void)eventIndicators;
    return c && ni == 0 ? fmi2OK : not_provided(c, "event indicators");
}

EXPORT fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t nx)
{
    return c ? (fmi2Status)instance_get_states(INSTANCE(c), x, nx) : fmi2Error;
}

EXPORT fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x_nominal[],
                                                    size_t nx)
{
    return c ? (fmi2Status)instance_get_nominals(INSTANCE(c), x_nominal, nx) : fmi2Error;
}

/* ---- Co-Simulation ----------------------------------------------------------------------- */

EXPORT fmi2Status fmi2DoStep(fmi2Component c, fmi2Real currentCommunicationPoint,
                             fmi2Real communicationStepSize,
                             fmi2Boolean noSetFMUStatePriorToCurrentPoint)
{
    (void)noSetFMUStatePriorToCurrentPoint;
    return c ? (fmi2Status)instance_step(INSTANCE(c), currentCommunicationPoint,
                                         communicationStepSize)
             : fmi2Error;
}

EXPORT fmi2Status fmi2CancelStep(fmi2Component c)
{
    return not_provided(c, "asynchronous steps");
}

EXPORT fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[],
                                              size_t nvr, const fmi2Integer order[],
                                              const fmi2Real value[])
{
    (void)vr;
    (void)order;
    (void)value;
    return c && nvr == 0 ? fmi2OK : not_provided(c, "interpolation of inputs");
}

EXPORT fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[],
                                               size_t nvr, const fmi2Integer order[],
                                               fmi2Real value[])
{
    (void)vr;
    (void)order;
    (void)value;
    return c && nvr == 0 ? fmi2OK : not_provided(c, "output derivatives");
}

EXPORT fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind s, fmi2Status *value)
{
    (void)s;
    (void)value;
    return not_provided(c, "asynchronous steps");
}

EXPORT fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind s, fmi2Real *value)
{
    if (!c || s != fmi2LastSuccessfulTime)
        return not_provided(c, "such status");
    *value = INSTANCE(c)->state.v[AT_TIME];
    return fmi2OK;
}

EXPORT fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind s, fmi2Integer *value)
{
    (void)s;
    (void)value;
    return not_provided(c, "such status");
}

EXPORT fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value)
{
    if (!c || s != fmi2Terminated)
        return not_provided(c, "such status");
    *value = fmi2False; /* the model never asks to end the simulation */
    return fmi2OK;
}

EXPORT fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind s, fmi2String *value)
{
    (void)s;
    (void)value;
    return not_provided(c, "such status");
}
