/* A plant as a model: its inputs are held over a step. */
#ifndef MODEL_H
#define MODEL_H

#include "@name@.h"

#include <string.h>

#define MODEL_TOKEN "@token@"
#define MODEL_INPUTS @inputs@u
#define MODEL_PARAMETER @parameter@u
#define MODEL_REALS @reals@u
#define MODEL_INTEGERS 1u
#define OUTPUT (MODEL_INPUTS + 1u)
#define STATES (OUTPUT + @q@u)

typedef struct {
    double real[MODEL_REALS]; /* time, inputs, outputs, states, and these at the start */
    int32_t integer[MODEL_INTEGERS]; /* the cell */
    @name@_state core;
} model;

static const double model_start[MODEL_REALS] =
    @start@;
static const double model_outputs[@q@][@n@] =
    @C@;

static void model_show(model *of)
{
    int a;
    int k;

    for (k = 0; k < @q@; k++) {
        double total = 0.0;
        for (a = 0; a < @n@; a++) {
            total += model_outputs[k][a] * of->core.x[a];
        }
        of->real[OUTPUT + (unsigned)k] = total;
    }
    (void)memcpy(&of->real[STATES], of->core.x, sizeof of->core.x);
    of->integer[0] = (int32_t)of->core.cell;
}

static void model_begin(model *of)
{
    @name@_start(&of->core, &of->real[MODEL_PARAMETER]);
    model_show(of);
}

static int model_step(model *of, double length, const char **said)
{
    const int status = @name@_advance(&of->core, &of->real[1], length);

    if (status == @NAME@_NOT_FINITE) {
        *said = "an input or a state is not finite, or grew beyond all numbers";
        return 3;
    }
    if (status != @NAME@_OK) {
        *said = "the step takes too many crossings or is too long: make it shorter";
        return 3;
    }
    model_show(of);
    return 0;
}

#endif
