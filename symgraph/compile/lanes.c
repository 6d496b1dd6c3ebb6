/* Numbers side by side: vectors of the processor, and arrays with a number for each of B lanes.

   GNU C's vectors, which gcc and clang know. Strict arithmetic: NaN and infinity come out as from the C library. */
#include <math.h>
#include <string.h>

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

/* Scalars. */
static inline real s_fmax(real x, real y) { return x > y || y != y ? x : y; } /* NaN gives way to a number */
static inline real s_fmin(real x, real y) { return x < y || y != y ? x : y; }
static inline real s_sign(real x) { return x > 0 ? 1 : x < 0 ? -1 : x; }
static inline real s_lt(real x, real y) { return x < y; }
static inline real s_le(real x, real y) { return x <= y; }
static inline real s_eq(real x, real y) { return x == y; }
static inline real s_ne(real x, real y) { return x != y; }
static inline real s_not(real x) { return x == 0; }
static inline real s_and(real x, real y) { return x != 0 && y != 0; }
static inline real s_or(real x, real y) { return x != 0 || y != 0; }
static inline real s_if_else_zero(real x, real y) { return x != 0 ? y : 0; }
static inline real s_step(real x, real y) { return x > y ? 1 : x < y ? 0 : x == y ? (real) 0.5 : (real) NAN; }

/* The inverse of the error function: Winitzki's approximation, made exact by Newton's and Halley's steps. */
static real s_erfinv(real x) {
  double y, a, b;
  int i;
  if (!(fabs((double) x) < 1)) return x == 1 ? (real) INFINITY : x == -1 ? (real) -INFINITY : (real) NAN;
  a = log1p(-(double) x * (double) x);
  b = 4.330746750799873 + a / 2;
  y = copysign(sqrt(sqrt(b * b - a / 0.147) - b), (double) x);
  for (i = 0; i < 3; ++i) {
    double error = (x < 0 ? erfc(-y) - (1 + (double) x) : (1 - (double) x) - erfc(y)), slope = 1.1283791670955126 * exp(-y * y);
    double step = error / slope;
    y -= step / (1 + y * step);
  }
  return (real) y;
}

#define SCALAR_1(name) \
  static inline real s_##name(real x) { return MATH(name)(x); }
#define SCALAR_2(name) \
  static inline real s_##name(real x, real y) { return MATH(name)(x, y); }
#define FUNCTIONS_1(DO) \
  DO(exp) DO(log) DO(sin) DO(cos) DO(tan) DO(asin) DO(acos) DO(atan) DO(sinh) DO(cosh) DO(tanh) DO(asinh) DO(acosh) \
  DO(atanh) DO(erf) DO(log1p) DO(expm1)
#define FUNCTIONS_2(DO) DO(pow) DO(atan2) DO(hypot)
#define OTHERS_1(DO) DO(sqrt) DO(floor) DO(ceil) DO(fabs)
#define OTHERS_2(DO) DO(fmod) DO(remainder) DO(copysign)
FUNCTIONS_1(SCALAR_1)
FUNCTIONS_2(SCALAR_2)
OTHERS_1(SCALAR_1)
OTHERS_2(SCALAR_2)

/* Vectors: number by number, or by the C library's vector functions where it has them. */
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
OTHERS_2(EACH_2)
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

/* Arrays whose numbers are rows of B lanes; B = 1 for plain ones. */
static inline void zero(real *z, long count) { memset(z, 0, (size_t) count * sizeof(real)); }
static void copy(real *z, const real *x, long count, long step, long B) {
  long i;
  if (step == 1)
    memcpy(z, x, (size_t) (count * B) * sizeof(real));
  else if (B == 1)
    for (i = 0; i < count; ++i) z[i] = x[i * step];
  else
    for (i = 0; i < count; ++i) memcpy(z + i * B, x + i * step * B, (size_t) B * sizeof(real));
}
static void spread(real *z, const real *x, long count, long step, long B) {
  long i, l;
  for (i = 0; i < count; ++i)
    for (l = 0; l < B; ++l) z[i * B + l] = x[i * step];
}
/* Tables hold pairs (place in z, place in x). */
static void copy_some(real *z, const real *x, const int *table, long count, long B) {
  long i;
  for (i = 0; i < count; ++i, table += 2) memcpy(z + table[0] * B, x + table[1] * B, (size_t) B * sizeof(real));
}
static void spread_some(real *z, const real *x, const int *table, long count, long B) {
  long i, l;
  for (i = 0; i < count; ++i, table += 2)
    for (l = 0; l < B; ++l) z[table[0] * B + l] = x[table[1]];
}
static void transpose(real *z, const real *x, long rows, long columns, long B) {
  long i, j, l;
  for (i = 0; i < rows; ++i)
    for (j = 0; j < columns; ++j)
      for (l = 0; l < B; ++l) z[(j + i * columns) * B + l] = x[(i + j * rows) * B + l];
}
/* z[t] += x[i], with a table of (t, i); xw numbers of x for each of its own, B or 1. */
static void add_some(real *z, const int *table, long count, const real *x, long xw, long B) {
  long n, l;
  for (n = 0; n < count; ++n, table += 2)
    for (l = 0; l < B; ++l) z[table[0] * B + l] += x[table[1] * xw + (xw > 1 ? l : 0)];
}
/* z[t] += x[i] y[j], with a table of (t, i, j). */
static void add_products(real *z, const int *table, long count, const real *x, long xw, const real *y, long yw, long B) {
  long n, l;
  for (n = 0; n < count; ++n, table += 3) {
    const real *const p = x + table[1] * xw, *const q = y + table[2] * yw;
    real *const r = z + table[0] * B;
    if (xw == B && yw == B)
      for (l = 0; l < B; ++l) r[l] += p[l] * q[l];
    else
      for (l = 0; l < B; ++l) r[l] += p[xw > 1 ? l : 0] * q[yw > 1 ? l : 0];
  }
}
/* One lane for CasADi's own code, and back, in doubles that begin where one may. */
static inline double *doubles(real *w) { return (double *) (((size_t) w + sizeof(double) - 1) / sizeof(double) * sizeof(double)); }
static inline void take(const real *x, long xw, long lane, double *z, long count) {
  long i;
  for (i = 0; i < count; ++i) z[i] = (double) x[i * xw + (xw > 1 ? lane : 0)];
}
static inline void put(real *z, long zw, long lane, const double *x, long count, int failed) {
  long i;
  for (i = 0; i < count; ++i) z[i * zw + (zw > 1 ? lane : 0)] = failed ? (real) NAN : (real) x[i];
}
