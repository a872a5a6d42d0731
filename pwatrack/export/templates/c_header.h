@comment@
#ifndef @upper@_H
#define @upper@_H

#include <stdint.h>

#define @upper@_OUTPUTS @q@
#define @upper@_INPUTS @m@
#define @upper@_REFERENCE @s@
#define @upper@_STATE_BYTES @state_bytes@
#define @upper@_CONSTANT_BYTES @constant_bytes@
@units@
typedef @real@ @name@_real;

typedef struct {
@lines@
} @name@_state;

#ifdef __cplusplus
extern "C" {
#endif

/* What a step returns. */
#define @upper@_OK 0
#define @upper@_ENDED 1       /* the reference has ended: it stays as it is */
#define @upper@_REFUSED (-1)  /* a null pointer, or a number that is @refused@: state kept, last input held */
#define @upper@_NOT_READY (-2) /* no init before, or the state was overwritten: u = 0 */

/* Make a state ready: @name@_reset does the same, to start anew. -1 for a null pointer. */
int @name@_init(@name@_state *state);
int @name@_reset(@name@_state *state);

/* Run once: read y and ref, write u, which is to be put out now. */
int @name@_step(@name@_state *state, const @name@_real y[],
    const @name@_real ref[], @name@_real u[]);

#ifdef __cplusplus
}
#endif

#endif
