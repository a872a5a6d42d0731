/* The multiple of a step that is nearest. */
static int64_t stepped(int64_t value, int64_t step)
{
    return nearest(value, step) * step;
}

