/*
 * The flow of a continuous piecewise affine plant, from crossing to crossing.
 *
 * In a cell x(t) is a Taylor series, with steps so short that its terms beyond the last are rounding. A hyperplane that
 * bounds the cell is a polynomial q(t / h) on a step of length h, moved outwards by what rounding can make of it. With all its
 * Bernstein coefficients positive it is not crossed; where they fall throughout and the last is negative, it is crossed
 * once; otherwise the step is halved. The field is continuous, so what is within rounding of a border has the field of
 * either side.
 */
#include "@name@.h"

#include <float.h>
#include <math.h>
#include <string.h>

#define N @n@
#define M @m@
#define CELLS @cells@u
#define PLANES @planes@
#define DEGREE @degree@
#define UNIT (@unit@ * DBL_EPSILON) /* of the sizes of the terms of a sum: what it can be off by */
#define FINEST 1e-9                 /* of a step: shorter ones are not halved */
#define MOST_STEPS 100000000L
#define MOST_IDLE 1000 /* crossings without progress in time */

static const double table_A[CELLS][N][N] =
    @A@;
static const double table_b[CELLS][N] =
    @b@;
static const double table_B[N][M] =
    @B@;
static const double table_step[CELLS] =
    @step@;
static const double table_H[PLANES][N] =
    @H@;
static const double table_h[PLANES] =
    @h@;
static const int8_t table_signs[CELLS][PLANES] =
    @signs@;

/* A step in one cell: x(t) is the sum of term[j] (t / h)^j; size is the sum of their sizes. */
typedef struct {
    double term[DEGREE + 1][N];
    double size[N];
} expansion;

static int expand(expansion *of, uint32_t cell, const double x[], const double input[], double h)
{
    int fine = 1;
    int a;
    int c;
    int j;

    for (a = 0; a < N; a++) {
        of->term[0][a] = x[a];
        of->size[a] = fabs(x[a]);
    }
    for (j = 1; j <= DEGREE; j++) {
        for (a = 0; a < N; a++) {
            double total = 0.0;
            if (j == 1) {
                total = table_b[cell][a];
                for (c = 0; c < M; c++) {
                    total += table_B[a][c] * input[c];
                }
            }
            for (c = 0; c < N; c++) {
                total += table_A[cell][a][c] * of->term[j - 1][c];
            }
            of->term[j][a] = total * (h / (double)j);
            of->size[a] += fabs(of->term[j][a]);
        }
    }
    for (a = 0; a < N; a++) {
        if (!(of->size[a] <= DBL_MAX)) {
            fine = 0;
        }
    }
    return fine;
}

/* x at a part of a step: the small terms first. */
static void arrive(const expansion *of, double part, double x[])
{
    int a;
    int j;

    for (a = 0; a < N; a++) {
        double total = of->term[DEGREE][a];
        for (j = DEGREE - 1; j >= 0; j--) {
            total = (total * part) + of->term[j][a];
        }
        x[a] = total;
    }
}

static double value(const double q[], double part)
{
    double total = q[DEGREE];
    int j;

    for (j = DEGREE - 1; j >= 0; j--) {
        total = (total * part) + q[j];
    }
    return total;
}

#define NONE 0
#define CROSSED 1
#define UNSURE 2

/* Where a polynomial that begins at 0 or above falls below 0 on [0, 1]. */
static int fall(const double q[], int finest, double *part)
{
    double b[DEGREE + 1];
    double binomial = 1.0;
    double low = q[0];
    double from = 0.0;
    double to = 1.0;
    int falling = 1;
    int positive = 1;
    int j;
    int k;

    for (j = 1; j <= DEGREE; j++) {
        low += (q[j] < 0.0) ? q[j] : 0.0;
    }
    if (low >= 0.0) {
        return NONE;
    }
    for (j = 0; j <= DEGREE; j++) {
        b[j] = q[j] / binomial;
        binomial = (binomial * ((double)DEGREE - (double)j)) / ((double)j + 1.0);
    }
    for (j = 1; j <= DEGREE; j++) {
        for (k = DEGREE; k >= j; k--) {
            b[k] += b[k - 1];
        }
    }
    for (j = 0; j <= DEGREE; j++) {
        if (!(b[j] >= 0.0)) {
            positive = 0;
        }
        if ((j > 0) && !(b[j] <= b[j - 1])) {
            falling = 0;
        }
    }
    if ((positive != 0) || ((finest != 0) && (value(q, 1.0) >= 0.0))) {
        return NONE;
    }
    if (((falling == 0) || !(b[DEGREE] < 0.0)) && (finest == 0)) {
        return UNSURE;
    }
    for (j = 0; j < 60; j++) {
        const double middle = 0.5 * (from + to);
        if (value(q, middle) >= 0.0) {
            from = middle;
        } else {
            to = middle;
        }
    }
    *part = to;
    return CROSSED;
}

/* The first part of a step at which a border of the cell is crossed. */
static int leave(const expansion *of, uint32_t cell, int finest, double *part)
{
    double q[DEGREE + 1];
    double here = 1.0;
    int found = NONE;
    int a;
    int j;
    int k;

    for (k = 0; k < PLANES; k++) {
        const double sign = (double)table_signs[cell][k];
        double size = fabs(table_h[k]);
        int now;
        if (table_signs[cell][k] == 0) {
            continue;
        }
        for (a = 0; a < N; a++) {
            size += fabs(table_H[k][a]) * of->size[a];
        }
        for (j = 0; j <= DEGREE; j++) {
            double total = (j == 0) ? table_h[k] : 0.0;
            for (a = 0; a < N; a++) {
                total += table_H[k][a] * of->term[j][a];
            }
            q[j] = sign * total;
        }
        q[0] += UNIT * size;
        now = CROSSED;
        here = 0.0;
        if (q[0] >= 0.0) {
            now = fall(q, finest, &here);
        }
        if (now == UNSURE) {
            return UNSURE;
        }
        if ((now == CROSSED) && ((found == NONE) || (here < *part))) {
            *part = here;
            found = CROSSED;
        }
    }
    return found;
}

/* The first cell that x contradicts least, counted in what rounding can make of it; never the one that is left. */
static uint32_t cell_of(const double x[], uint32_t left)
{
    double g[PLANES];
    double least = 0.0;
    uint32_t cell = CELLS;
    uint32_t i;
    int a;
    int k;

    for (k = 0; k < PLANES; k++) {
        double total = table_h[k];
        double size = fabs(table_h[k]);
        for (a = 0; a < N; a++) {
            total += table_H[k][a] * x[a];
            size += fabs(table_H[k][a] * x[a]);
        }
        g[k] = (size > 0.0) ? (total / (UNIT * size)) : 0.0;
    }
    for (i = 0u; i < CELLS; i++) {
        double worst = 0.0;
        for (k = 0; k < PLANES; k++) {
            const double off = -g[k] * (double)table_signs[i][k];
            worst = (off > worst) ? off : worst;
        }
        if ((i != left) && ((cell == CELLS) || (worst < least))) {
            cell = i;
            least = worst;
        }
    }
    return (cell == CELLS) ? left : cell;
}

static int all_finite(const double v[], int count)
{
    int all = 1;
    int k;

    for (k = 0; k < count; k++) {
        if (!(fabs(v[k]) <= DBL_MAX)) {
            all = 0;
        }
    }
    return all;
}

void @name@_start(@name@_state *state, const double x[])
{
    (void)memcpy(state->x, x, sizeof state->x);
    state->cell = cell_of(x, CELLS);
}

int @name@_advance(@name@_state *state, const double input[], double length)
{
    @name@_state next;
    double fraction = 1.0;
    double left = length;
    int idle = 0;
    long k;

    next = *state;
    if ((all_finite(input, M) == 0) || (all_finite(next.x, N) == 0) || !(fabs(length) <= DBL_MAX)
        || (next.cell >= CELLS)) {
        return @NAME@_NOT_FINITE;
    }
    for (k = 0; (k < MOST_STEPS) && (idle < MOST_IDLE) && (left > 0.0); k++) {
        const double h = ((table_step[next.cell] < left) ? table_step[next.cell] : left) * fraction;
        expansion of;
        double part = 1.0;
        int whole = 0;
        int found;
        if ((table_step[next.cell] >= left) && (fraction >= 1.0)) {
            whole = 1;
        }
        if (expand(&of, next.cell, next.x, input, h) == 0) {
            return @NAME@_NOT_FINITE;
        }
        found = leave(&of, next.cell, (fraction < FINEST) ? 1 : 0, &part);
        if (found == UNSURE) {
            fraction *= 0.5;
            continue;
        }
        if (fraction < 1.0) {
            fraction = 2.0 * fraction;
        }
        arrive(&of, part, next.x);
        if (found == CROSSED) {
            idle = ((part * h) > 0.0) ? 0 : (idle + 1);
            left -= part * h;
            next.cell = cell_of(next.x, next.cell);
        } else {
            idle = 0;
            left = (whole != 0) ? 0.0 : (left - h);
        }
    }
    if (left > 0.0) {
        return @NAME@_TOO_LONG;
    }
    *state = next;
    return @NAME@_OK;
}
