/* Replay vector.h: every input must come out as it is there, in every bit. */
#include "@name@.h"
#include "vector.h"

#include <stdio.h>
#include <string.h>

int main(void)
{
    @name@_state state;
    @name@_real u[@upper@_INPUTS];
    long wrong = 0;
    long k;

    if (@name@_init(&state) != @upper@_OK) {
        wrong++;
    }
    for (k = 0; k < VECTOR_STEPS; k++) {
        const int status = @name@_step(&state, vector_y[k], @vector_ref@, u);
        if ((status < @upper@_OK) || (memcmp(u, vector_u[k], sizeof u) != 0)) {
            wrong++;
        }
    }
    (void)printf("%ld steps, %ld wrong; state %lu bytes, constants %lu bytes\n", k, wrong,
                 (unsigned long)sizeof(state), (unsigned long)@upper@_CONSTANT_BYTES);
    return (wrong == 0) ? 0 : 1;
}
