/* How many units a number is, rounded to nearest, the upper one of two. */
static int64_t nearest(int64_t value, int64_t unit)
{
    const int64_t raised = value + (unit / 2);
    int64_t found = raised / unit;

    if ((found * unit) > raised) {
        found = found - 1;
    }
    return found;
}

/* The same, cut off where 32 bits end: then it counts as no number. */
static int32_t narrowed(int64_t value, int64_t unit)
{
    int64_t found = nearest(value, unit);

    if (found > INT32_MAX) {
        found = INT32_MAX;
    }
    if (found < -INT32_MAX) {
        found = -INT32_MAX;
    }
    return (int32_t)found;
}

