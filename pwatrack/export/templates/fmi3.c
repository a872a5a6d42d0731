/* FMI 3.0 for co-simulation: the functions of the standard around the model of model.h. */
#include "instance.h"

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

typedef void *fmi3Instance;
typedef void *fmi3InstanceEnvironment;
typedef void *fmi3FMUState;
typedef uint32_t fmi3ValueReference;
typedef float fmi3Float32;
typedef double fmi3Float64;
typedef int8_t fmi3Int8;
typedef uint8_t fmi3UInt8;
typedef int16_t fmi3Int16;
typedef uint16_t fmi3UInt16;
typedef int32_t fmi3Int32;
typedef uint32_t fmi3UInt32;
typedef int64_t fmi3Int64;
typedef uint64_t fmi3UInt64;
typedef bool fmi3Boolean;
typedef bool fmi3Clock;
typedef const char *fmi3String;
typedef uint8_t fmi3Byte;
typedef const fmi3Byte *fmi3Binary;
typedef enum { fmi3OK, fmi3Warning, fmi3Discard, fmi3Error, fmi3Fatal } fmi3Status;
typedef enum {
    fmi3Independent,
    fmi3Constant,
    fmi3Fixed,
    fmi3Tunable,
    fmi3Discrete,
    fmi3Dependent
} fmi3DependencyKind;
typedef enum { fmi3IntervalNotYetKnown, fmi3IntervalUnchanged, fmi3IntervalChanged } fmi3IntervalQualifier;
typedef void (*fmi3LogMessageCallback)(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category,
                                       fmi3String message);
typedef void (*fmi3ClockUpdateCallback)(fmi3InstanceEnvironment environment);
typedef void (*fmi3IntermediateUpdateCallback)(fmi3InstanceEnvironment environment, fmi3Float64 time,
                                               fmi3Boolean set_requested, fmi3Boolean get_allowed,
                                               fmi3Boolean step_finished, fmi3Boolean can_return_early,
                                               fmi3Boolean *return_requested, fmi3Float64 *return_time);
typedef void (*fmi3LockPreemptionCallback)(void);
typedef void (*fmi3UnlockPreemptionCallback)(void);

typedef struct {
    snapshot s;
    fmi3LogMessageCallback log;
    fmi3InstanceEnvironment environment;
} instance;

static fmi3Status answer(const instance *of, int status, const char *said)
{
    if (said == NULL) {
        return fmi3OK;
    }
    if (of->log != NULL) {
        of->log(of->environment, (fmi3Status)status, (status == (int)fmi3Warning) ? "logStatusWarning" : "logStatusError",
                said);
    }
    return (fmi3Status)status;
}

@calls@

#define REFS fmi3Instance c, const fmi3ValueReference vr[], size_t count
#define NO_VALUES(type)                                                                                                \
    REFUSED(fmi3Get##type, (REFS, fmi3##type values[], size_t size), count == 0u)                                      \
    REFUSED(fmi3Set##type, (REFS, const fmi3##type values[], size_t size), count == 0u)

EXPORT fmi3Instance FUNCTION(fmi3InstantiateCoSimulation)(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
    fmi3Boolean event_mode, fmi3Boolean early_return, const fmi3ValueReference intermediate[], size_t count,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3IntermediateUpdateCallback update)
{
    instance *made;

    if ((name == NULL) || (token == NULL) || event_mode || (strcmp(token, MODEL_TOKEN) != 0)) {
        if (log != NULL) {
            log(environment, fmi3Error, "logStatusError", "the token is another one, or it is to have an event mode");
        }
        return NULL;
    }
    made = (instance *)calloc(1, sizeof *made);
    if (made != NULL) {
        made->log = log;
        made->environment = environment;
        set_up(&made->s);
    }
    return made;
}

EXPORT fmi3Instance FUNCTION(fmi3InstantiateModelExchange)(fmi3String name, fmi3String token, fmi3String resources,
                                                           fmi3Boolean visible, fmi3Boolean logging,
                                                           fmi3InstanceEnvironment environment,
                                                           fmi3LogMessageCallback log)
{
    return NULL;
}

EXPORT fmi3Instance FUNCTION(fmi3InstantiateScheduledExecution)(
    fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible, fmi3Boolean logging,
    fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, fmi3ClockUpdateCallback update,
    fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock)
{
    return NULL;
}

EXPORT void FUNCTION(fmi3FreeInstance)(fmi3Instance c)
{
    free(c);
}

EXPORT fmi3Status FUNCTION(fmi3EnterInitializationMode)(fmi3Instance c, fmi3Boolean with_tolerance,
                                                        fmi3Float64 tolerance, fmi3Float64 start,
                                                        fmi3Boolean with_stop, fmi3Float64 stop)
{
    const char *said = (c == NULL) ? NULL : start_at(STATE, start);

    return ANSWER((said != NULL) ? said : enter(STATE, MADE, INITIALIZING));
}

REFUSED(fmi3EnterEventMode, (fmi3Instance c), 0)
REFUSED(fmi3EnterStepMode, (fmi3Instance c), 0)
REFUSED(fmi3EnterConfigurationMode, (fmi3Instance c), 0)
REFUSED(fmi3ExitConfigurationMode, (fmi3Instance c), 0)
REFUSED(fmi3EvaluateDiscreteStates, (fmi3Instance c), 0)
REFUSED(fmi3UpdateDiscreteStates,
        (fmi3Instance c, fmi3Boolean *need_update, fmi3Boolean *terminate, fmi3Boolean *nominals_changed,
         fmi3Boolean *values_changed, fmi3Boolean *next_defined, fmi3Float64 *next),
        0)

EXPORT fmi3Status FUNCTION(fmi3GetFloat64)(REFS, fmi3Float64 values[], size_t size)
{
    return ANSWER((size < count) ? "there are too few values" : get_reals(STATE, vr, count, values));
}

EXPORT fmi3Status FUNCTION(fmi3SetFloat64)(REFS, const fmi3Float64 values[], size_t size)
{
    return ANSWER((size < count) ? "there are too few values" : set_reals(STATE, vr, count, values));
}

EXPORT fmi3Status FUNCTION(fmi3GetInt32)(REFS, fmi3Int32 values[], size_t size)
{
    return ANSWER((size < count) ? "there are too few values" : get_integers(STATE, vr, count, values));
}

REFUSED(fmi3SetInt32, (REFS, const fmi3Int32 values[], size_t size), count == 0u)
NO_VALUES(Float32)
NO_VALUES(Int8)
NO_VALUES(UInt8)
NO_VALUES(Int16)
NO_VALUES(UInt16)
NO_VALUES(UInt32)
NO_VALUES(Int64)
NO_VALUES(UInt64)
NO_VALUES(Boolean)
NO_VALUES(String)
REFUSED(fmi3GetBinary, (REFS, size_t sizes[], fmi3Binary values[], size_t size), count == 0u)
REFUSED(fmi3SetBinary, (REFS, const size_t sizes[], const fmi3Binary values[], size_t size), count == 0u)
REFUSED(fmi3GetClock, (REFS, fmi3Clock values[]), count == 0u)
REFUSED(fmi3SetClock, (REFS, const fmi3Clock values[]), count == 0u)
REFUSED(fmi3GetIntervalDecimal, (REFS, fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[]), count == 0u)
REFUSED(fmi3GetIntervalFraction,
        (REFS, fmi3UInt64 counters[], fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[]), count == 0u)
REFUSED(fmi3GetShiftDecimal, (REFS, fmi3Float64 shifts[]), count == 0u)
REFUSED(fmi3GetShiftFraction, (REFS, fmi3UInt64 counters[], fmi3UInt64 resolutions[]), count == 0u)
REFUSED(fmi3SetIntervalDecimal, (REFS, const fmi3Float64 intervals[]), count == 0u)
REFUSED(fmi3SetIntervalFraction, (REFS, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]), count == 0u)
REFUSED(fmi3SetShiftDecimal, (REFS, const fmi3Float64 shifts[]), count == 0u)
REFUSED(fmi3SetShiftFraction, (REFS, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]), count == 0u)
REFUSED(fmi3GetNumberOfVariableDependencies, (fmi3Instance c, fmi3ValueReference vr, size_t *count), 0)
REFUSED(fmi3GetVariableDependencies,
        (fmi3Instance c, fmi3ValueReference dependent, size_t elements[], fmi3ValueReference independents[],
         size_t their_elements[], fmi3DependencyKind kinds[], size_t count),
        0)
REFUSED(fmi3GetDirectionalDerivative,
        (fmi3Instance c, const fmi3ValueReference unknown[], size_t unknowns, const fmi3ValueReference known[],
         size_t knowns, const fmi3Float64 seed[], size_t seeds, fmi3Float64 sensitivity[], size_t sensitivities),
        0)
REFUSED(fmi3GetAdjointDerivative,
        (fmi3Instance c, const fmi3ValueReference unknown[], size_t unknowns, const fmi3ValueReference known[],
         size_t knowns, const fmi3Float64 seed[], size_t seeds, fmi3Float64 sensitivity[], size_t sensitivities),
        0)
REFUSED(fmi3GetOutputDerivatives, (REFS, const fmi3Int32 orders[], fmi3Float64 values[], size_t size), count == 0u)

/* Of model exchange and scheduled execution, which nothing is instantiated for. */
REFUSED(fmi3EnterContinuousTimeMode, (fmi3Instance c), 0)
REFUSED(fmi3CompletedIntegratorStep,
        (fmi3Instance c, fmi3Boolean no_way_back, fmi3Boolean *event_mode, fmi3Boolean *terminate), 0)
REFUSED(fmi3SetTime, (fmi3Instance c, fmi3Float64 time), 0)
REFUSED(fmi3SetContinuousStates, (fmi3Instance c, const fmi3Float64 states[], size_t count), 0)
REFUSED(fmi3GetContinuousStates, (fmi3Instance c, fmi3Float64 states[], size_t count), 0)
REFUSED(fmi3GetContinuousStateDerivatives, (fmi3Instance c, fmi3Float64 derivatives[], size_t count), 0)
REFUSED(fmi3GetEventIndicators, (fmi3Instance c, fmi3Float64 indicators[], size_t count), 0)
REFUSED(fmi3GetNominalsOfContinuousStates, (fmi3Instance c, fmi3Float64 nominals[], size_t count), 0)
REFUSED(fmi3GetNumberOfEventIndicators, (fmi3Instance c, size_t *count), 0)
REFUSED(fmi3GetNumberOfContinuousStates, (fmi3Instance c, size_t *count), 0)
REFUSED(fmi3ActivateModelPartition, (fmi3Instance c, fmi3ValueReference clock, fmi3Float64 time), 0)

EXPORT fmi3Status FUNCTION(fmi3DoStep)(fmi3Instance c, fmi3Float64 from, fmi3Float64 length, fmi3Boolean no_way_back,
                                       fmi3Boolean *event, fmi3Boolean *terminate, fmi3Boolean *early,
                                       fmi3Float64 *last)
{
    const char *said = NULL;
    int found;

    if (c == NULL) {
        return fmi3Error;
    }
    found = step_on(STATE, from, length, &said);
    *event = false;
    *terminate = false;
    *early = false;
    *last = STATE->of.real[0];
    return answer((const instance *)c, found, said);
}
