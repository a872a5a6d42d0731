/* A controller as a model: it runs at the start of a sample, and holds what it puts out. */
#ifndef MODEL_H
#define MODEL_H

#include "@name@.h"

#include <math.h>
#include <string.h>

#define MODEL_TOKEN "@token@"
#define MODEL_INPUTS @inputs@u
#define MODEL_PARAMETER @parameter@u
#define MODEL_REALS @reals@u
#define MODEL_INTEGERS 3u
#define SAMPLE_TIME @sample_time@
#define OUTPUT (MODEL_INPUTS + 1u)
#define NEXT (OUTPUT + @m@u)
#define ESTIMATE (NEXT + @next@u)
#define GENERATOR (ESTIMATE + @N@u)
#define DESIRED (GENERATOR + @p@u)

typedef struct {
    double real[MODEL_REALS]; /* time, y, the reference if given, u, next u if late, x_hat, eta_hat, x_d, both at the start */
    int32_t integer[MODEL_INTEGERS]; /* status, cell of x_hat, cell of x_d */
    @name@_state core;
} model;

static const double model_start[MODEL_REALS] =
    @start@;

static void model_show(model *of)
{
    const double *v = of->core.v;

    (void)memcpy(&of->real[OUTPUT], &v[@q@], @m@u * sizeof(double));
@show_next@    (void)memcpy(&of->real[ESTIMATE], &v[@X@], (@N@u + @p@u) * sizeof(double));
    (void)memcpy(&of->real[DESIRED], of->core.x_d, @n@u * sizeof(double));
    of->integer[0] = of->core.status;
    of->integer[1] = of->core.cell;
    of->integer[2] = of->core.cell_d;
}

static void model_begin(model *of)
{
    (void)@name@_init(&of->core);
    (void)memcpy(&of->core.v[@X@], &of->real[MODEL_PARAMETER], (@N@u + @p@u) * sizeof(double));
    model_show(of);
}

static int model_step(model *of, double length, const char **said)
{
    const double count = floor((length / SAMPLE_TIME) + 0.5);
    double u[@m@];
    int64_t k;
    int lowest = 0;

    if (!(count >= 1.0) || !(count <= 9e15) || (fabs(length - (count * SAMPLE_TIME)) > (1e-6 * SAMPLE_TIME))) {
        *said = "the step is not a whole number of samples of @sample_time@ s";
        return 3;
    }
    for (k = 0; k < (int64_t)count; k++) {
        const int status = @name@_step(&of->core, &of->real[1], @ref@, u);
        lowest = (status < lowest) ? status : lowest;
    }
    model_show(of);
    if (lowest < 0) {
        *said = "an input, or what comes of it, is not finite: the last output is held";
        return 1;
    }
    return 0;
}

#endif
