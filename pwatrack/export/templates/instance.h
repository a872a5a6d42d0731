/* What an instance of this model does, the same in FMI 2.0 and 3.0. */
#ifndef INSTANCE_H
#define INSTANCE_H

#include "model.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define MADE 0
#define INITIALIZING 1
#define STEPPING 2
#define TERMINATED 3

#define FAILED 3 /* fmi2Error, fmi3Error */

/* All that a state of an instance is. */
typedef struct {
    int32_t phase;
    model of;
} snapshot;

#define STORED_BYTES (sizeof(MODEL_TOKEN) + sizeof(snapshot))

static void set_up(snapshot *s)
{
    (void)memset(s, 0, sizeof *s);
    (void)memcpy(s->of.real, model_start, sizeof s->of.real);
    s->phase = MADE;
    model_begin(&s->of);
}

/* Each of these returns NULL, or why it does nothing. */

static const char *enter(snapshot *s, int from, int to)
{
    if (s->phase != from) {
        return "this call is out of order";
    }
    s->phase = to;
    return NULL;
}

static const char *start_at(snapshot *s, double time)
{
    if (s->phase != MADE) {
        return "the start time is set after the initialization began";
    }
    if (!(fabs(time) <= 1e100)) {
        return "the start time is not finite";
    }
    s->of.real[0] = time;
    return NULL;
}

static const char *get_reals(const snapshot *s, const uint32_t references[], size_t count, double values[])
{
    size_t k;

    for (k = 0; k < count; k++) {
        if (references[k] >= MODEL_REALS) {
            return "there is no real variable of this reference";
        }
        values[k] = s->of.real[references[k]];
    }
    return NULL;
}

static const char *get_integers(const snapshot *s, const uint32_t references[], size_t count, int32_t values[])
{
    size_t k;

    for (k = 0; k < count; k++) {
        if ((references[k] < MODEL_REALS) || ((references[k] - MODEL_REALS) >= MODEL_INTEGERS)) {
            return "there is no integer variable of this reference";
        }
        values[k] = s->of.integer[references[k] - MODEL_REALS];
    }
    return NULL;
}

/* All values are set, or none. */
static const char *set_reals(snapshot *s, const uint32_t references[], size_t count, const double values[])
{
    size_t k;

    for (k = 0; k < count; k++) {
        const uint32_t r = references[k];
        int parameter = 0;
        if ((r >= MODEL_PARAMETER) && (r < MODEL_REALS)) {
            parameter = 1;
        } else if ((r < 1u) || (r > MODEL_INPUTS)) {
            return "only inputs and parameters can be set";
        } else {
            /* an input */
        }
        if ((s->phase == TERMINATED) || ((parameter != 0) && (s->phase == STEPPING))) {
            return "it is too late to set this variable";
        }
        if ((parameter != 0) && !(fabs(values[k]) <= 1e100)) {
            return "a parameter is not finite";
        }
    }
    for (k = 0; k < count; k++) {
        s->of.real[references[k]] = values[k];
    }
    if (s->phase != STEPPING) {
        model_begin(&s->of);
    }
    return NULL;
}

/* Step on by a length; what is returned is 0, 1 (a warning) or FAILED, and said is why. */
static int step_on(snapshot *s, double from, double length, const char **said)
{
    const double now = s->of.real[0];
    int found;

    if (s->phase != STEPPING) {
        *said = "a step before the initialization or after the end";
        return FAILED;
    }
    if (!(length > 0.0) || !(length <= 1e100)) {
        *said = "the length of the step is not positive";
        return FAILED;
    }
    if (!(fabs(from - now) <= (1e-6 * length) + (1e-9 * fabs(now)))) {
        *said = "the step does not begin where the last one ended";
        return FAILED;
    }
    found = model_step(&s->of, length, said);
    if (found != FAILED) {
        s->of.real[0] = from + length;
    }
    return found;
}

static const char *stored(const snapshot *s, unsigned char bytes[], size_t size)
{
    if ((s == NULL) || (bytes == NULL) || (size < STORED_BYTES)) {
        return "there is no state, or too little room for it";
    }
    (void)memcpy(bytes, MODEL_TOKEN, sizeof(MODEL_TOKEN));
    (void)memcpy(&bytes[sizeof(MODEL_TOKEN)], s, sizeof *s);
    return NULL;
}

/* Copy a state, to one that is made if there is none yet. */
static const char *copied(const snapshot *from, void **to)
{
    if ((from == NULL) || (to == NULL)) {
        return "there is no state";
    }
    if (*to == NULL) {
        *to = calloc(1, sizeof *from);
    }
    if (*to == NULL) {
        return "there is no memory";
    }
    (void)memcpy(*to, from, sizeof *from);
    return NULL;
}

static const char *restored(const unsigned char bytes[], size_t size, void **to)
{
    snapshot found;

    if ((bytes == NULL) || (size != STORED_BYTES) || (memcmp(bytes, MODEL_TOKEN, sizeof(MODEL_TOKEN)) != 0)) {
        return "this is no state of this model";
    }
    (void)memcpy(&found, &bytes[sizeof(MODEL_TOKEN)], sizeof found);
    return copied(&found, to);
}

#endif
