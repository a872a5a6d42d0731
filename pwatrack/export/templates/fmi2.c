/* FMI 2.0 for co-simulation: the functions of the standard around the model of model.h. */
#include "instance.h"

#include <stddef.h>

typedef void *fmi2Component;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer;
typedef int fmi2Boolean;
typedef const char *fmi2String;
typedef char fmi2Byte;
typedef void *fmi2FMUstate;
typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;
typedef enum { fmi2DoStepStatus, fmi2PendingStatus, fmi2LastSuccessfulTime, fmi2Terminated } fmi2StatusKind;
typedef struct {
    void (*logger)(void *environment, fmi2String instance, fmi2Status status, fmi2String category,
                   fmi2String message, ...);
    void *(*allocateMemory)(size_t count, size_t size);
    void (*freeMemory)(void *memory);
    void (*stepFinished)(void *environment, fmi2Status status);
    void *environment;
} fmi2CallbackFunctions;

typedef struct {
    snapshot s;
    const fmi2CallbackFunctions *functions;
    char *name;
} instance;

static fmi2Status answer(const instance *of, int status, const char *said)
{
    if (said == NULL) {
        return fmi2OK;
    }
    if ((of->functions != NULL) && (of->functions->logger != NULL)) {
        of->functions->logger(of->functions->environment, of->name, (fmi2Status)status,
                              (status == (int)fmi2Warning) ? "logStatusWarning" : "logStatusError", "%s", said);
    }
    return (fmi2Status)status;
}

@calls@

EXPORT const char *FUNCTION(fmi2GetTypesPlatform)(void)
{
    return "default";
}

EXPORT fmi2Component FUNCTION(fmi2Instantiate)(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                                               const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                                               fmi2Boolean logging)
{
    instance *made;
    size_t length;

    if ((name == NULL) || (guid == NULL) || (type != fmi2CoSimulation) || (strcmp(guid, MODEL_TOKEN) != 0)) {
        if ((functions != NULL) && (functions->logger != NULL)) {
            functions->logger(functions->environment, (name == NULL) ? "" : name, fmi2Error, "logStatusError",
                              "it runs in co-simulation only, with the guid of its description");
        }
        return NULL;
    }
    length = strlen(name) + 1u;
    made = (instance *)calloc(1, sizeof *made);
    if (made == NULL) {
        return NULL;
    }
    made->name = (char *)calloc(1, length);
    if (made->name == NULL) {
        free(made);
        return NULL;
    }
    (void)memcpy(made->name, name, length);
    made->functions = functions;
    set_up(&made->s);
    return made;
}

EXPORT void FUNCTION(fmi2FreeInstance)(fmi2Component c)
{
    if (c != NULL) {
        free(((instance *)c)->name);
        free(c);
    }
}

EXPORT fmi2Status FUNCTION(fmi2SetupExperiment)(fmi2Component c, fmi2Boolean with_tolerance, fmi2Real tolerance,
                                                fmi2Real start, fmi2Boolean with_stop, fmi2Real stop)
{
    return ANSWER(start_at(STATE, start));
}

EXPORT fmi2Status FUNCTION(fmi2EnterInitializationMode)(fmi2Component c)
{
    return ANSWER(enter(STATE, MADE, INITIALIZING));
}

EXPORT fmi2Status FUNCTION(fmi2GetReal)(fmi2Component c, const fmi2ValueReference vr[], size_t count, fmi2Real value[])
{
    return ANSWER(get_reals(STATE, vr, count, value));
}

EXPORT fmi2Status FUNCTION(fmi2GetInteger)(fmi2Component c, const fmi2ValueReference vr[], size_t count,
                                           fmi2Integer value[])
{
    return ANSWER(get_integers(STATE, vr, count, value));
}

EXPORT fmi2Status FUNCTION(fmi2SetReal)(fmi2Component c, const fmi2ValueReference vr[], size_t count,
                                        const fmi2Real value[])
{
    return ANSWER(set_reals(STATE, vr, count, value));
}

REFUSED(fmi2GetBoolean, (fmi2Component c, const fmi2ValueReference vr[], size_t count, fmi2Boolean value[]),
        count == 0u)
REFUSED(fmi2GetString, (fmi2Component c, const fmi2ValueReference vr[], size_t count, fmi2String value[]), count == 0u)
REFUSED(fmi2SetInteger, (fmi2Component c, const fmi2ValueReference vr[], size_t count, const fmi2Integer value[]),
        count == 0u)
REFUSED(fmi2SetBoolean, (fmi2Component c, const fmi2ValueReference vr[], size_t count, const fmi2Boolean value[]),
        count == 0u)
REFUSED(fmi2SetString, (fmi2Component c, const fmi2ValueReference vr[], size_t count, const fmi2String value[]),
        count == 0u)

REFUSED(fmi2GetDirectionalDerivative,
        (fmi2Component c, const fmi2ValueReference unknown[], size_t unknowns, const fmi2ValueReference known[],
         size_t knowns, const fmi2Real seed[], fmi2Real sensitivity[]),
        0)
REFUSED(fmi2SetRealInputDerivatives,
        (fmi2Component c, const fmi2ValueReference vr[], size_t count, const fmi2Integer order[],
         const fmi2Real value[]),
        count == 0u)
REFUSED(fmi2GetRealOutputDerivatives,
        (fmi2Component c, const fmi2ValueReference vr[], size_t count, const fmi2Integer order[], fmi2Real value[]),
        count == 0u)

EXPORT fmi2Status FUNCTION(fmi2DoStep)(fmi2Component c, fmi2Real from, fmi2Real length, fmi2Boolean no_way_back)
{
    const char *said = NULL;
    int found;

    if (c == NULL) {
        return fmi2Error;
    }
    found = step_on(STATE, from, length, &said);
    return answer((const instance *)c, found, said);
}

REFUSED(fmi2CancelStep, (fmi2Component c), 0)

/* Of a step that is done when fmi2DoStep returns, only these two are known. */
EXPORT fmi2Status FUNCTION(fmi2GetRealStatus)(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    if ((c == NULL) || (kind != fmi2LastSuccessfulTime)) {
        return fmi2Discard;
    }
    *value = STATE->of.real[0];
    return fmi2OK;
}

EXPORT fmi2Status FUNCTION(fmi2GetBooleanStatus)(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value)
{
    if ((c == NULL) || (kind != fmi2Terminated)) {
        return fmi2Discard;
    }
    *value = 0;
    return fmi2OK;
}

EXPORT fmi2Status FUNCTION(fmi2GetStatus)(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value)
{
    return fmi2Discard;
}

EXPORT fmi2Status FUNCTION(fmi2GetIntegerStatus)(fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value)
{
    return fmi2Discard;
}

EXPORT fmi2Status FUNCTION(fmi2GetStringStatus)(fmi2Component c, const fmi2StatusKind kind, fmi2String *value)
{
    return fmi2Discard;
}
