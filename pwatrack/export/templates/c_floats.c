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
