#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#elif defined(__GNUC__)
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT
#endif
#ifdef @FMI@_FUNCTION_PREFIX
#define JOINED(a, b) a##b
#define PREFIXED(a, b) JOINED(a, b)
#define FUNCTION(name) PREFIXED(@FMI@_FUNCTION_PREFIX, name)
#else
#define FUNCTION(name) name
#endif

/* Of a call that must have an instance: NULL, or why it fails. */
#define ANSWER(said) ((c == NULL) ? @fmi@Error : answer((const instance *)c, @fmi@Error, (said)))
#define STATE (&((instance *)c)->s)
#define REFUSED(name, arguments, needless)                                                                             \
    EXPORT @fmi@Status FUNCTION(name) arguments                                                                        \
    {                                                                                                                  \
        return ANSWER((needless) ? NULL : #name ": there is nothing of this kind");                                    \
    }

EXPORT const char *FUNCTION(@fmi@GetVersion)(void)
{
    return "@version@.0";
}

EXPORT @fmi@Status FUNCTION(@fmi@SetDebugLogging)(@instance@ c, @fmi@Boolean on, size_t count,
                                                const @fmi@String categories[])
{
    return ANSWER(NULL); /* what goes wrong is always said, and nothing else */
}

EXPORT @fmi@Status FUNCTION(@fmi@ExitInitializationMode)(@instance@ c)
{
    return ANSWER(enter(STATE, INITIALIZING, STEPPING));
}

EXPORT @fmi@Status FUNCTION(@fmi@Terminate)(@instance@ c)
{
    return ANSWER(enter(STATE, STEPPING, TERMINATED));
}

EXPORT @fmi@Status FUNCTION(@fmi@Reset)(@instance@ c)
{
    if (c != NULL) {
        set_up(STATE);
    }
    return ANSWER(NULL);
}

EXPORT @fmi@Status FUNCTION(@fmi@Get@state@)(@instance@ c, @fmi@@state@ *state)
{
    return ANSWER(copied(STATE, state));
}

EXPORT @fmi@Status FUNCTION(@fmi@Set@state@)(@instance@ c, @fmi@@state@ state)
{
    void *here = c; /* its state comes first */

    return ANSWER(copied((const snapshot *)state, &here));
}

EXPORT @fmi@Status FUNCTION(@fmi@Free@state@)(@instance@ c, @fmi@@state@ *state)
{
    if (state != NULL) {
        free(*state);
        *state = NULL;
    }
    return ANSWER(NULL);
}

EXPORT @fmi@Status FUNCTION(@fmi@Serialized@state@Size)(@instance@ c, @fmi@@state@ state, size_t *size)
{
    *size = STORED_BYTES;
    return ANSWER(NULL);
}

EXPORT @fmi@Status FUNCTION(@fmi@Serialize@state@)(@instance@ c, @fmi@@state@ state,
                                                @fmi@Byte bytes[], size_t size)
{
    return ANSWER(stored((const snapshot *)state, (unsigned char *)bytes, size));
}

EXPORT @fmi@Status FUNCTION(@fmi@@deserialize@@state@)(@instance@ c, const @fmi@Byte bytes[], size_t size,
                                                  @fmi@@state@ *state)
{
    return ANSWER(restored((const unsigned char *)bytes, size, state));
}
