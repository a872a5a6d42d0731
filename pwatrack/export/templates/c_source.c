#include "@name@.h"

@headers@#include <stddef.h>

@arithmetic@
#define READY 0x70776131u

@constants@
typedef char state_size[(sizeof(@name@_state) == @upper@_STATE_BYTES) ? 1 : -1];
typedef char constant_size[((@sizes@) == @upper@_CONSTANT_BYTES) ? 1 : -1];

@operations@/* Put out the input that is held, 0 where that is no number. */
static void hold(const @name@_state *state, @real@ u[])
{
    int32_t b;

@hold@
}

/* One tick of a state that is ready: @rounded@. */
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
