/* FMI 3.0, Model Exchange and Co-Simulation: translates each call into one of instance.h. */
#include "fmi3.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "export.h"
#include "instance.h"

#define INSTANCE(c) ((Instance *)(c))
#define EXPECT(call, modes)                                                                       \
    do {                                                                                          \
        if (!instance)                                                                            \
            return fmi3Error;                                                                     \
        if (instance_expect(INSTANCE(instance), call, modes) != STATUS_OK)                        \
            return fmi3Error;                                                                     \
    } while (0)

static void log_fmi3(const Instance *c, Status status, const char *category, const char *message)
{
    ((fmi3LogMessageCallback *)c->callback)(c->environment, (fmi3Status)status, category, message);
}

static fmi3Status not_provided(fmi3Instance instance, const char *what)
{
    if (instance)
        instance_log(INSTANCE(instance), STATUS_ERROR, "this FMU has no %s", what);
    return fmi3Error;
}

/* ---- common ------------------------------------------------------------------------------ */

EXPORT const char *fmi3GetVersion(void)
{
    return "3.0";
}

static void describe(Instance *first, fmi3String instanceName, fmi3InstanceEnvironment environment,
                     fmi3LogMessageCallback *logMessage)
{
    memset(first, 0, sizeof *first);
    first->log = log_fmi3;
    first->name = (char *)instanceName;
    first->environment = environment;
    first->callback = (void (*)(void))logMessage;
}

EXPORT fmi3Instance fmi3InstantiateModelExchange(fmi3String instanceName,
                                                 fmi3String instantiationToken,
                                                 fmi3String resourcePath, fmi3Boolean visible,
                                                 fmi3Boolean loggingOn,
                                                 fmi3InstanceEnvironment instanceEnvironment,
                                                 fmi3LogMessageCallback *logMessage)
{
    (void)resourcePath;
    (void)visible;
    (void)loggingOn; /* only warnings and errors are logged, and those always */
    Instance first;
    describe(&first, instanceName, instanceEnvironment, logMessage);
    return instance_new(&first, instantiationToken, MODEL_EXCHANGE, 1);
}

EXPORT fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
    fmi3Boolean visible, fmi3Boolean loggingOn, fmi3Boolean eventModeUsed,
    fmi3Boolean earlyReturnAllowed, const fmi3ValueReference requiredIntermediateVariables[],
    size_t nRequiredIntermediateVariables, fmi3InstanceEnvironment instanceEnvironment,
    fmi3LogMessageCallback *logMessage, fmi3IntermediateUpdateCallback *intermediateUpdate)
{
    (void)resourcePath;
    (void)visible;
    (void)loggingOn;
    (void)earlyReturnAllowed; /* this FMU never returns early */
    (void)requiredIntermediateVariables;
    (void)intermediateUpdate;
    Instance first;
    describe(&first, instanceName, instanceEnvironment, logMessage);
    if (eventModeUsed || nRequiredIntermediateVariables > 0) {
        instance_log(&first, STATUS_ERROR, "this FMU has no %s",
                     eventModeUsed ? "Event Mode in Co-Simulation" : "intermediate update");
        return NULL;
    }
    return instance_new(&first, instantiationToken, CO_SIMULATION, 1);
}

EXPORT fmi3Instance fmi3InstantiateScheduledExecution(
    fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
    fmi3Boolean visible, fmi3Boolean loggingOn, fmi3InstanceEnvironment instanceEnvironment,
    fmi3LogMessageCallback *logMessage, fmi3ClockUpdateCallback *clockUpdate,
    fmi3LockPreemptionCallback *lockPreemption, fmi3UnlockPreemptionCallback *unlockPreemption)
{
    (void)instantiationToken;
    (void)resourcePath;
    (void)visible;
    (void)loggingOn;
    (void)clockUpdate;
    (void)lockPreemption;
    (void)unlockPreemption;
    Instance first;
    describe(&first, instanceName, instanceEnvironment, logMessage);
    instance_log(&first, STATUS_ERROR, "this FMU has no Scheduled Execution");
    return NULL;
}

EXPORT void fmi3FreeInstance(fmi3Instance instance)
{
    instance_free(INSTANCE(instance));
}

EXPORT fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean loggingOn,
                                      size_t nCategories, const fmi3String categories[])
{
    (void)loggingOn;
    (void)nCategories;
    (void)categories;
    return instance ? fmi3OK : fmi3Error;
}

EXPORT fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined,
                                              fmi3Float64 tolerance, fmi3Float64 startTime,
                                              fmi3Boolean stopTimeDefined, fmi3Float64 stopTime)
{
    EXPECT("fmi3EnterInitializationMode", MODE_INSTANTIATED);
    Status status = instance_setup(INSTANCE(instance), startTime, toleranceDefined ? tolerance : 0,
                                   stopTimeDefined ? stopTime : HUGE_VAL);
    return (fmi3Status)(status == STATUS_OK ? instance_initialise(INSTANCE(instance)) : status);
}

EXPORT fmi3Status fmi3ExitInitializationMode(fmi3Instance instance)
{
    return instance ? (fmi3Status)instance_initialised(INSTANCE(instance)) : fmi3Error;
}

EXPORT fmi3Status fmi3EnterEventMode(fmi3Instance instance)
{
    if (instance && INSTANCE(instance)->kind == CO_SIMULATION)
        return not_provided(instance, "Event Mode in Co-Simulation");
    EXPECT("fmi3EnterEventMode", MODE_EVENT | MODE_CONTINUOUS);
    INSTANCE(instance)->state.mode = MODE_EVENT;
    return fmi3OK;
}

EXPORT fmi3Status fmi3Terminate(fmi3Instance instance)
{
    return instance ? (fmi3Status)instance_terminate(INSTANCE(instance)) : fmi3Error;
}

EXPORT fmi3Status fmi3Reset(fmi3Instance instance)
{
    EXPECT("fmi3Reset", MODE_ANY);
    instance_reset(INSTANCE(instance));
    return fmi3OK;
}

/* ---- values ------------------------------------------------------------------------------ */

EXPORT fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                 size_t nValueReferences, fmi3Float64 values[], size_t nValues)
{
    return instance ? (fmi3Status)instance_get(INSTANCE(instance), valueReferences,
                                               nValueReferences, values, nValues)
                    : fmi3Error;
}

EXPORT fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                 size_t nValueReferences, const fmi3Float64 values[],
                                 size_t nValues)
{
    return instance ? (fmi3Status)instance_set(INSTANCE(instance), valueReferences,
                                               nValueReferences, values, nValues)
                    : fmi3Error;
}

/* The other types: this FMU has no such variables, so only a call for none of them is right. */
#define NO_VARIABLES(TYPE)                                                                        \
    EXPORT fmi3Status fmi3Get##TYPE(fmi3Instance instance,                                        \
                                    const fmi3ValueReference valueReferences[],                   \
                                    size_t nValueReferences, fmi3##TYPE values[], size_t nValues) \
    {                                                                                             \
        (void)valueReferences;                                                                    \
        (void)values;                                                                             \
        return instance && nValueReferences == 0 && nValues == 0                                  \
                   ? fmi3OK                                                                       \
                   : not_provided(instance, #TYPE " variables");                                  \
    }                                                                                             \
    EXPORT fmi3Status fmi3Set##TYPE(                                                              \
        fmi3Instance instance, const fmi3ValueReference valueReferences[],                        \
        size_t nValueReferences, const fmi3##TYPE values[], size_t nValues)                       \
    {                                                                                             \
        (void)valueReferences;                                                                    \
        (void)values;                                                                             \
        return instance && nValueReferences == 0 && nValues == 0                                  \
                   ? fmi3OK                                                                       \
                   : not_provided(instance, #TYPE " variables");                                  \
    }

NO_VARIABLES(Float32)
NO_VARIABLES(Int8)
NO_VARIABLES(UInt8)
NO_VARIABLES(Int16)
NO_VARIABLES(UInt16)
NO_VARIABLES(Int32)
NO_VARIABLES(UInt32)
NO_VARIABLES(Int64)
NO_VARIABLES(UInt64)
NO_VARIABLES(Boolean)
NO_VARIABLES(String)

EXPORT fmi3Status fmi3GetBinary(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                size_t nValueReferences, size_t valueSizes[], fmi3Binary values[],
                                size_t nValues)
{
    (void)valueReferences;
    (void)valueSizes;
    (void)values;
    return instance && nValueReferences == 0 && nValues == 0
               ? fmi3OK
               : not_provided(instance, "Binary variables");
}

EXPORT fmi3Status fmi3SetBinary(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                size_t nValueReferences, const size_t valueSizes[],
                                const fmi3Binary values[], size_t nValues)
{
    (void)valueReferences;
    (void)valueSizes;
    (void)values;
    return instance && nValueReferences == 0 && nValues == 0
               ? fmi3OK
               : not_provided(instance, "Binary variables");
}

EXPORT fmi3Status fmi3GetClock(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                               size_t nValueReferences, fmi3Clock values[])
{
    (void)valueReferences;
    (void)values;
    return instance && nValueReferences == 0 ? fmi3OK : not_provided(instance, "clocks");
}

EXPORT fmi3Status fmi3SetClock(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                               size_t nValueReferences, const fmi3Clock values[])
{
    (void)valueReferences;
    (void)values;
    return instance && nValueReferences == 0 ? fmi3OK : not_provided(instance, "clocks");
}

EXPORT fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance instance,
                                                      fmi3ValueReference valueReference,
                                                      size_t *nDependencies)
{
    (void)valueReference;
    (void)nDependencies;
    return not_provided(instance, "dependencies per element");
}

EXPORT fmi3Status fmi3GetVariableDependencies(
    fmi3Instance instance, fmi3ValueReference dependent, size_t elementIndicesOfDependent[],
    fmi3ValueReference independents[], size_t elementIndicesOfIndependents[],
    fmi3DependencyKind dependencyKinds[], size_t nDependencies)
{
    (void)dependent;
    (void)elementIndicesOfDependent;
    (void)independents;
    (void)elementIndicesOfIndependents;
    (void)dependencyKinds;
    (void)nDependencies;
    return not_provided(instance, "dependencies per element");
}

EXPORT fmi3Status fmi3GetDirectionalDerivative(
    fmi3Instance instance, const fmi3ValueReference unknowns[], size_t nUnknowns,
    const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
    fmi3Float64 sensitivity[], size_t nSensitivity)
{
    EXPECT("fmi3GetDirectionalDerivative",
           MODE_INITIALISING | MODE_RUNNING | MODE_TERMINATED | MODE_FAILED);
    return (fmi3Status)instance_directional(INSTANCE(instance), unknowns, nUnknowns, knowns,
                                            nKnowns, seed, nSeed, sensitivity, nSensitivity);
}

EXPORT fmi3Status fmi3GetAdjointDerivative(fmi3Instance instance,
                                           const fmi3ValueReference unknowns[], size_t nUnknowns,
                                           const fmi3ValueReference knowns[], size_t nKnowns,
                                           const fmi3Float64 seed[], size_t nSeed,
                                           fmi3Float64 sensitivity[], size_t nSensitivity)
{
    (void)unknowns;
    (void)nUnknowns;
    (void)knowns;
    (void)nKnowns;
    (void)seed;
    (void)nSeed;
    (void)sensitivity;
    (void)nSensitivity;
    return not_provided(instance, "adjoint derivatives");
}

/* ---- state ------------------------------------------------------------------------------- */

EXPORT fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *FMUState)
{
    return instance && FMUState ? (fmi3Status)instance_save(INSTANCE(instance), (State **)FMUState)
                                : fmi3Error;
}

EXPORT fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState FMUState)
{
    return instance ? (fmi3Status)instance_restore(INSTANCE(instance), FMUState) : fmi3Error;
}

EXPORT fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *FMUState)
{
    if (!instance)
        return fmi3Error;
    if (FMUState) {
        free(*FMUState);
        *FMUState = NULL;
    }
    return fmi3OK;
}

EXPORT fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState FMUState,
                                             size_t *size)
{
    if (!instance || !FMUState || !size)
        return fmi3Error;
    *size = instance_serialised_size();
    return fmi3OK;
}

EXPORT fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState FMUState,
                                        fmi3Byte serializedState[], size_t size)
{
    return instance ? (fmi3Status)instance_serialise(INSTANCE(instance), FMUState,
                                                     (char *)serializedState, size)
                    : fmi3Error;
}

EXPORT fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte serializedState[],
                                          size_t size, fmi3FMUState *FMUState)
{
    return instance && FMUState
               ? (fmi3Status)instance_deserialise(INSTANCE(instance), (const char *)serializedState,
                                                  size, (State **)FMUState)
               : fmi3Error;
}

/* ---- configuration, clocks, partitions: declared absent in the model description ---------- */

EXPORT fmi3Status fmi3EnterConfigurationMode(fmi3Instance instance)
{
    return not_provided(instance, "structural parameters");
}

EXPORT fmi3Status fmi3ExitConfigurationMode(fmi3Instance instance)
{
    return not_provided(instance, "structural parameters");
}

#define NO_CLOCKS(FUNCTION, ...)                                                                  \
    EXPORT fmi3Status FUNCTION(fmi3Instance instance, const fmi3ValueReference valueReferences[], \
                               size_t nValueReferences, __VA_ARGS__)                              \
    {                                                                                             \
        (void)valueReferences;                                                                    \
        (void)a;                                                                                  \
        (void)b;                                                                                  \
        (void)q;                                                                                  \
        return instance && nValueReferences == 0 ? fmi3OK : not_provided(instance, "clocks");     \
    }
#define NO_CLOCKS_1(FUNCTION, A)                                                                  \
    EXPORT fmi3Status FUNCTION(fmi3Instance instance, const fmi3ValueReference valueReferences[], \
                               size_t nValueReferences, A)                                        \
    {                                                                                             \
        (void)valueReferences;                                                                    \
        (void)a;                                                                                  \
        return instance && nValueReferences == 0 ? fmi3OK : not_provided(instance, "clocks");     \
    }
#define NO_CLOCKS_2(FUNCTION, A, B)                                                               \
    EXPORT fmi3Status FUNCTION(fmi3Instance instance, const fmi3ValueReference valueReferences[], \
                               size_t nValueReferences, A, B)                                     \
    {                                                                                             \
        (void)valueReferences;                                                                    \
        (void)a;                                                                                  \
        (void)b;                                                                                  \
        return instance && nValueReferences == 0 ? fmi3OK : not_provided(instance, "clocks");     \
    }

NO_CLOCKS(fmi3GetIntervalFraction, fmi3UInt64 a[], fmi3UInt64 b[], fmi3IntervalQualifier q[])
NO_CLOCKS_2(fmi3GetIntervalDecimal, fmi3Float64 a[], fmi3IntervalQualifier b[])
NO_CLOCKS_2(fmi3GetShiftFraction, fmi3UInt64 a[], fmi3UInt64 b[])
NO_CLOCKS_2(fmi3SetIntervalFraction, const fmi3UInt64 a[], const fmi3UInt64 b[])
NO_CLOCKS_2(fmi3SetShiftFraction, const fmi3UInt64 a[], const fmi3UInt64 b[])
NO_CLOCKS_1(fmi3GetShiftDecimal, fmi3Float64 a[])
NO_CLOCKS_1(fmi3SetIntervalDecimal, const fmi3Float64 a[])
NO_CLOCKS_1(fmi3SetShiftDecimal, const fmi3Float64 a[])

EXPORT fmi3Status fmi3ActivateModelPartition(fmi3Instance instance,
                                             fmi3ValueReference clockReference,
                                             fmi3Float64 activationTime)
{
    (void)clockReference;
    (void)activationTime;
    return not_provided(instance, "Scheduled Execution");
}

/* ---- events ------------------------------------------------------------------------------ */

EXPORT fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance instance)
{
    EXPECT("fmi3EvaluateDiscreteStates", MODE_INITIALISING | MODE_EVENT);
    return fmi3OK;
}

EXPORT fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance,
                                           fmi3Boolean *discreteStatesNeedUpdate,
                                           fmi3Boolean *terminateSimulation,
                                           fmi3Boolean *nominalsOfContinuousStatesChanged,
                                           fmi3Boolean *valuesOfContinuousStatesChanged,
                                           fmi3Boolean *nextEventTimeDefined,
                                           fmi3Float64 *nextEventTime)
{
    EXPECT("fmi3UpdateDiscreteStates", MODE_EVENT);
    *discreteStatesNeedUpdate = false;
    *terminateSimulation = false;
    *nominalsOfContinuousStatesChanged = false;
    *valuesOfContinuousStatesChanged = false;
    *nextEventTimeDefined = false;
    *nextEventTime = 0;
    return fmi3OK;
}

/* ---- Model Exchange ---------------------------------------------------------------------- */

EXPORT fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance instance)
{
    EXPECT("fmi3EnterContinuousTimeMode", MODE_EVENT);
    INSTANCE(instance)->state.mode = MODE_CONTINUOUS;
    return fmi3OK;
}

EXPORT fmi3Status fmi3CompletedIntegratorStep(fmi3Instance instance,
                                              fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                                              fmi3Boolean *enterEventMode,
                                              fmi3Boolean *terminateSimulation)
{
    (void)noSetFMUStatePriorToCurrentPoint;
    EXPECT("fmi3CompletedIntegratorStep", MODE_CONTINUOUS);
    *enterEventMode = false;
    *terminateSimulation = false;
    return fmi3OK;
}

EXPORT fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 time)
{
    return instance ? (fmi3Status)instance_set_time(INSTANCE(instance), time) : fmi3Error;
}

EXPORT fmi3Status fmi3SetContinuousStates(fmi3Instance instance,
                                          const fmi3Float64 continuousStates[],
                                          size_t nContinuousStates)
{
    return instance ? (fmi3Status)instance_set_states(INSTANCE(instance), continuousStates,
                                                      nContinuousStates)
                    : fmi3Error;
}

EXPORT fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance,
                                                    fmi3Float64 derivatives[],
                                                    size_t nContinuousStates)
{
    return instance ? (fmi3Status)instance_get_derivatives(INSTANCE(instance), derivatives,
                                                           nContinuousStates)
                    : fmi3Error;
}

EXPORT fmi3Status fmi3GetEventIndicators(fmi3Instance instance, fmi3Float64 eventIndicators[],
                                         size_t nEventIndicators)
{
    (void)eventIndicators;
    return instance && nEventIndicators == 0 ? fmi3OK : not_provided(instance, "event indicators");
}

EXPORT fmi3Status fmi3GetContinuousStates(fmi3Instance instance, fmi3Float64 continuousStates[],
                                          size_t nContinuousStates)
{
    return instance ? (fmi3Status)instance_get_states(INSTANCE(instance), continuousStates,
                                                      nContinuousStates)
                    : fmi3Error;
}

EXPORT fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance instance, fmi3Float64 nominals[],
                                                    size_t nContinuousStates)
{
    return instance ? (fmi3Status)instance_get_nominals(INSTANCE(instance), nominals,
                                                        nContinuousStates)
                    : fmi3Error;
}

EXPORT fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *nEventIndicators)
{
    if (!instance)
        return fmi3Error;
    *nEventIndicators = 0;
    return fmi3OK;
}

EXPORT fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *nContinuousStates)
{
    if (!instance)
        return fmi3Error;
    *nContinuousStates = MODEL_NX;
    return fmi3OK;
}

/* ---- Co-Simulation ----------------------------------------------------------------------- */

EXPORT fmi3Status fmi3EnterStepMode(fmi3Instance instance)
{
    return not_provided(instance, "Event Mode in Co-Simulation");
}

EXPORT fmi3Status fmi3GetOutputDerivatives(fmi3Instance instance,
                                           const fmi3ValueReference valueReferences[],
                                           size_t nValueReferences, const fmi3Int32 orders[],
                                           fmi3Float64 values[], size_t nValues)
{
    (void)valueReferences;
    (void)orders;
    (void)values;
    return instance && nValueReferences == 0 && nValues == 0
               ? fmi3OK
               : not_provided(instance, "output derivatives");
}

EXPORT fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 currentCommunicationPoint,
                             fmi3Float64 communicationStepSize,
                             fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                             fmi3Boolean *eventHandlingNeeded, fmi3Boolean *terminateSimulation,
                             fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime)
{
    (void)noSetFMUStatePriorToCurrentPoint;
    if (!instance)
        return fmi3Error;
    Status status =
        instance_step(INSTANCE(instance), currentCommunicationPoint, communicationStepSize);
    *eventHandlingNeeded = false;
    *terminateSimulation = false;
    *earlyReturn = false;
    *lastSuccessfulTime = INSTANCE(instance)->state.v[AT_TIME];
    return (fmi3Status)status;
}
