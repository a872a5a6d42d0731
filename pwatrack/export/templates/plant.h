/*
 * @title@
 *
 * x' = A_i x + b_i + B u in the cell i of x, with u held over a step.
 * Written by pwatrack. It belongs to its user: see LICENSE-EXCEPTION of pwatrack.
 *
 * Spec         sha256 @spec@
 * States       @states@
 * Inputs       @inputs_said@
 */
#ifndef @NAME@_H
#define @NAME@_H

#include <stdint.h>

#define @NAME@_STATES @n@
#define @NAME@_INPUTS @m@

typedef struct {
    double x[@n@];
    uint32_t cell;
} @name@_state;

#define @NAME@_OK 0
#define @NAME@_NOT_FINITE (-1) /* an input or a state, or it grows beyond all numbers, or the cell is none: all is kept */
#define @NAME@_TOO_LONG (-2)   /* more steps or crossings than are taken at once: the state is kept */

/* Set a state, and find its cell. */
void @name@_start(@name@_state *state, const double x[]);

/* Go on for a length of time in s, with inputs that do not change. */
int @name@_advance(@name@_state *state, const double input[], double length);

#endif
