/* Operations on single numbers, in standard C. Before this file stand `real`, MATH for the C library's names,
   and LEAST_EXPONENT, below which exponentials are no normal numbers. */
#include <math.h>
#include <string.h>

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

/* What is next to nothing takes libraries ten times as long: it is nothing. */
#define s_exp(x) ((x) < LEAST_EXPONENT ? 0 : MATH(exp)(x))
#define s_log(x) MATH(log)(x)
#define s_sin(x) MATH(sin)(x)
#define s_cos(x) MATH(cos)(x)
#define s_tan(x) MATH(tan)(x)
#define s_asin(x) MATH(asin)(x)
#define s_acos(x) MATH(acos)(x)
#define s_atan(x) MATH(atan)(x)
#define s_sinh(x) MATH(sinh)(x)
#define s_cosh(x) MATH(cosh)(x)
#define s_tanh(x) MATH(tanh)(x)
#define s_asinh(x) MATH(asinh)(x)
#define s_acosh(x) MATH(acosh)(x)
#define s_atanh(x) MATH(atanh)(x)
#define s_erf(x) MATH(erf)(x)
#define s_log1p(x) MATH(log1p)(x)
#define s_expm1(x) MATH(expm1)(x)
#define s_sqrt(x) MATH(sqrt)(x)
#define s_floor(x) MATH(floor)(x)
#define s_ceil(x) MATH(ceil)(x)
#define s_fabs(x) MATH(fabs)(x)
#define s_pow(x, y) MATH(pow)(x, y)
#define s_atan2(x, y) MATH(atan2)(x, y)
#define s_hypot(x, y) MATH(hypot)(x, y)
#define s_fmod(x, y) MATH(fmod)(x, y)
#define s_remainder(x, y) MATH(remainder)(x, y)
#define s_copysign(x, y) MATH(copysign)(x, y)
