/* Numbers side by side in vectors of the processor: GNU C's, which gcc and clang know. Before this file stands scalars.c.

   Strict arithmetic: NaN and infinity come out as from the C library. */
#ifdef __AVX512F__
#define BYTES 64
#elif defined(__AVX__)
#define BYTES 32
#else
#define BYTES 16
#endif
#define VL ((long) (BYTES / sizeof(real)))
#if defined(__AVX__) || defined(__SSE2__)
#include <immintrin.h>
#endif

typedef real vec __attribute__((vector_size(BYTES)));
typedef real memory_vec __attribute__((vector_size(BYTES), aligned(sizeof(real)), may_alias));
typedef whole mask __attribute__((vector_size(BYTES)));

static inline vec load(const real *p) { return *(const memory_vec *) p; }
static inline void store(real *p, vec x) { *(memory_vec *) p = x; }
static inline vec all(real x) { return x - (vec) {0}; } /* keeps -0 */

/* Of an array whose end is near. */
static inline vec load_some(const real *p, long left) {
  vec x = {0};
  if (left >= VL) return load(p);
  memcpy(&x, p, (size_t) left * sizeof(real));
  return x;
}
static inline void store_some(real *p, vec x, long left) {
  if (left >= VL)
    store(p, x);
  else
    memcpy(p, &x, (size_t) left * sizeof(real));
}

/* Number by number, or by the C library's vector functions where it has them. */
#define FUNCTIONS_1(DO) \
  DO(exp) DO(log) DO(sin) DO(cos) DO(tan) DO(asin) DO(acos) DO(atan) DO(sinh) DO(cosh) DO(tanh) DO(asinh) DO(acosh) \
  DO(atanh) DO(erf) DO(log1p) DO(expm1)
#define FUNCTIONS_2(DO) DO(pow) DO(atan2) DO(hypot)
#define EACH_1(name) \
  static vec v_##name(vec x) { \
    vec y; \
    int i; \
    for (i = 0; i < VL; ++i) y[i] = s_##name(x[i]); \
    return y; \
  }
#define EACH_2(name) \
  static vec v_##name(vec x, vec y) { \
    vec z; \
    int i; \
    for (i = 0; i < VL; ++i) z[i] = s_##name(x[i], y[i]); \
    return z; \
  }
#ifdef LIBMVEC /* names of x86-64: instruction set, unmasked, numbers in a vector, a letter per argument */
#if defined(__AVX512F__) && defined(SINGLE)
#define VECTOR_LIBRARY _ZGVeN16
#elif defined(__AVX512F__)
#define VECTOR_LIBRARY _ZGVeN8
#elif defined(__AVX2__) && defined(SINGLE)
#define VECTOR_LIBRARY _ZGVdN8
#elif defined(__AVX2__)
#define VECTOR_LIBRARY _ZGVdN4
#elif defined(__AVX__) && defined(SINGLE)
#define VECTOR_LIBRARY _ZGVcN8
#elif defined(__AVX__)
#define VECTOR_LIBRARY _ZGVcN4
#elif defined(SINGLE)
#define VECTOR_LIBRARY _ZGVbN4
#else
#define VECTOR_LIBRARY _ZGVbN2
#endif
#define PASTE_(a, b, c) a##b##c
#define PASTE(a, b, c) PASTE_(a, b, c)
#define VECTOR_NAME(letters, name) PASTE(VECTOR_LIBRARY, letters, MATH(_##name))
#define LIBRARY_1(name) \
  extern vec VECTOR_NAME(v, name)(vec); \
  static inline vec v_##name(vec x) { return VECTOR_NAME(v, name)(x); }
#define LIBRARY_2(name) \
  extern vec VECTOR_NAME(vv, name)(vec, vec); \
  static inline vec v_##name(vec x, vec y) { return VECTOR_NAME(vv, name)(x, y); }
FUNCTIONS_1(LIBRARY_1)
FUNCTIONS_2(LIBRARY_2)
#else
FUNCTIONS_1(EACH_1)
FUNCTIONS_2(EACH_2)
#endif
EACH_1(erfinv)
EACH_1(floor)
EACH_1(ceil)
EACH_1(sign)
EACH_2(fmod)
EACH_2(remainder)
EACH_2(copysign)
#if defined(__AVX512F__) && !defined(SINGLE)
static inline vec v_sqrt(vec x) { return (vec) _mm512_sqrt_pd((__m512d) x); }
#elif defined(__AVX512F__)
static inline vec v_sqrt(vec x) { return (vec) _mm512_sqrt_ps((__m512) x); }
#elif defined(__AVX__) && !defined(SINGLE)
static inline vec v_sqrt(vec x) { return (vec) _mm256_sqrt_pd((__m256d) x); }
#elif defined(__AVX__)
static inline vec v_sqrt(vec x) { return (vec) _mm256_sqrt_ps((__m256) x); }
#else
EACH_1(sqrt)
#endif

static inline vec pick(mask where, vec x, vec y) { return (vec) ((where & (mask) x) | (~where & (mask) y)); }
static inline vec one_where(mask where) { return (vec) (where & (mask) all(1)); }
static inline vec v_fabs(vec x) { return (vec) ((mask) x & ~(mask) all((real) -0.0)); }
static inline vec v_fmax(vec x, vec y) { return pick((x > y) | (y != y), x, y); }
static inline vec v_fmin(vec x, vec y) { return pick((x < y) | (y != y), x, y); }
static inline vec v_lt(vec x, vec y) { return one_where(x < y); }
static inline vec v_le(vec x, vec y) { return one_where(x <= y); }
static inline vec v_eq(vec x, vec y) { return one_where(x == y); }
static inline vec v_ne(vec x, vec y) { return one_where(x != y); }
static inline vec v_not(vec x) { return one_where(x == 0); }
static inline vec v_and(vec x, vec y) { return one_where((x != 0) & (y != 0)); }
static inline vec v_or(vec x, vec y) { return one_where((x != 0) | (y != 0)); }
static inline vec v_if_else_zero(vec x, vec y) { return (vec) ((x != 0) & (mask) y); }
static inline vec v_step(vec x, vec y) {
  return pick(x > y, all(1), pick(x < y, all(0), pick(x == y, all((real) 0.5), all((real) NAN))));
}
