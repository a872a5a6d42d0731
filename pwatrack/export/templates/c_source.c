#include "@name@.h"

#include <float.h>
@math@#include <stddef.h>

#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && (__FINITE_MATH_ONLY__ != 0))
#error "this controller needs IEEE arithmetic: no -ffast-math, and no part of it"
#endif
#if @widths@
#error "this controller needs arithmetic in the width of its numbers: on x86, -msse2 -mfpmath=sse"
#endif

/* No product may be fused with a sum, whatever the options are. GCC has a pragma that is stronger than they are; no
   other compiler must, and clang heeds none with -ffp-contract=fast: there each product goes through memory. */
#if defined(__GNUC__) && (__GNUC__ >= 5) && !defined(__clang__) && !defined(__EDG__)
#pragma GCC optimize ("fp-contract=off", "no-unsafe-math-optimizations", "no-associative-math")
#define ROUNDED
#else
#define ROUNDED volatile
#endif

#define READY 0x70776131u

@constants@
typedef char state_size[(sizeof(@name@_state) == @upper@_STATE_BYTES) ? 1 : -1];
typedef char constant_size[((@sizes@) == @upper@_CONSTANT_BYTES) ? 1 : -1];

/* Put out the input that is held, 0 where that is no number. */
static void hold(const @name@_state *state, @real@ u[])
{
    int32_t b;

@hold@
}

/* One tick of a state that is ready: each product and each sum is rounded by itself. */
static void tick(@name@_state *state, const @real@ y[]@ref@, @real@ u[])
{
    @name@_state next;
@own@

@body@
}

int @name@_init(@name@_state *state)
{
    int status = @upper@_REFUSED;
    int32_t k;

    if (state != NULL) {
@begin@
        state->ready = READY;
        status = @upper@_OK;
    }
    return status;
}

int @name@_reset(@name@_state *state)
{
    return @name@_init(state);
}

int @name@_step(@name@_state *state, const @real@ y[],
    const @real@ ref[], @real@ u[])
{
    int status = @upper@_REFUSED;
    int32_t b;

@unused@    if ((state != NULL) && (u != NULL)) {
        if (state->ready != READY) {
            for (b = 0; b < @m@; b++) {
                u[b] = @zero@;
            }
            state->status = @upper@_NOT_READY;
        }
        else if (@missing@) {
            hold(state, u);
            state->status = @upper@_REFUSED;
        }
        else {
            tick(state, y@pass_ref@, u);
        }
        status = (int)state->status;
    }
    return status;
}
