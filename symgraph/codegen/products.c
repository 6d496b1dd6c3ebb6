/* Products of matrices in column-major order, in standard C that compilers turn into vectors: matrices of weights stand as they
   are, and are read once for two columns. */

#define SUMS 8 /* of one column, side by side, since the order of one sum must not be changed */
#define PLAIN(w) (w)

/* gcc 12 makes wrong code of small products where it writes them out in their caller with vectors of 64 bytes. */
#if defined(__GNUC__) && !defined(__clang__)
#define APART __attribute__((noinline, noclone))
#else
#define APART
#endif
#define SQUARE(w) ((w) * (w))

/* z (m, n) = NUMBER(w (m, k)) x (k, n): four columns of w at once, for two columns of x. */
#define MULTIPLY(name, NUMBER) \
  static APART void name(const real *w, const real *x, real *z, int m, int k, int n) { \
    int i, j, p; \
    for (i = 0; i < m * n; ++i) z[i] = 0; \
    for (j = 0; j + 2 <= n; j += 2, x += 2 * k, z += 2 * m) { \
      const real *a = w, *const y = x + k; \
      real *const v = z + m; \
      for (p = 0; p + 4 <= k; p += 4, a += 4 * m) { \
        const real x0 = x[p], x1 = x[p + 1], x2 = x[p + 2], x3 = x[p + 3]; \
        const real y0 = y[p], y1 = y[p + 1], y2 = y[p + 2], y3 = y[p + 3]; \
        const real *const b = a + m, *const c = b + m, *const d = c + m; \
        for (i = 0; i < m; ++i) { \
          const real e = NUMBER(a[i]), f = NUMBER(b[i]), g = NUMBER(c[i]), h = NUMBER(d[i]); \
          const real sum = z[i] + (e * x0 + f * x1) + (g * x2 + h * x3); \
          v[i] += (e * y0 + f * y1) + (g * y2 + h * y3); \
          z[i] = sum; \
        } \
      } \
      for (; p < k; ++p, a += m) \
        for (i = 0; i < m; ++i) { \
          const real sum = z[i] + NUMBER(a[i]) * x[p]; \
          v[i] += NUMBER(a[i]) * y[p]; \
          z[i] = sum; \
        } \
    } \
    if (j < n) { \
      const real *a = w; \
      for (p = 0; p + 4 <= k; p += 4, a += 4 * m) { \
        const real x0 = x[p], x1 = x[p + 1], x2 = x[p + 2], x3 = x[p + 3]; \
        const real *const b = a + m, *const c = b + m, *const d = c + m; \
        for (i = 0; i < m; ++i) \
          z[i] += (NUMBER(a[i]) * x0 + NUMBER(b[i]) * x1) + (NUMBER(c[i]) * x2 + NUMBER(d[i]) * x3); \
      } \
      for (; p < k; ++p, a += m) \
        for (i = 0; i < m; ++i) z[i] += NUMBER(a[i]) * x[p]; \
    } \
  }
MULTIPLY(multiply, PLAIN)
MULTIPLY(multiply_squares, SQUARE)

/* z (m, n) = NUMBER(w (k, m))^T x (k, n). */
#define MULTIPLY_TRANSPOSED(name, NUMBER) \
  static APART void name(const real *w, const real *x, real *z, int m, int k, int n) { \
    int i, j, p, s; \
    for (j = 0; j < n; ++j, x += k, z += m) { \
      const real *a = w; \
      for (i = 0; i < m; ++i, a += k) { \
        real sums[SUMS] = {0}, sum = 0; \
        for (p = 0; p + SUMS <= k; p += SUMS) \
          for (s = 0; s < SUMS; ++s) sums[s] += NUMBER(a[p + s]) * x[p + s]; \
        for (; p < k; ++p) sum += NUMBER(a[p]) * x[p]; \
        for (s = 0; s < SUMS; ++s) sum += sums[s]; \
        z[i] = sum; \
      } \
    } \
  }
MULTIPLY_TRANSPOSED(multiply_transposed, PLAIN)
MULTIPLY_TRANSPOSED(multiply_transposed_squares, SQUARE)
