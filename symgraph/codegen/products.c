/* Products of matrices in column-major order, in standard C that compilers turn into vectors: matrices of weights stand as they
   are, and each of their numbers is read once. */

#define STRIDE 4 /* columns that are taken at once */
#define SUMS 8   /* of one column, side by side, since the order of one sum must not be changed */
#define PLAIN(w) (w)
#define SQUARE(w) ((w) * (w))

/* z (m, n) = NUMBER(w (m, k)) x (k, n). */
#define MULTIPLY(name, NUMBER) \
  static void name(const real *w, const real *x, real *z, int m, int k, int n) { \
    int i, j, p; \
    for (j = 0; j < n; ++j, x += k, z += m) { \
      const real *a = w; \
      for (i = 0; i < m; ++i) z[i] = 0; \
      for (p = 0; p + STRIDE <= k; p += STRIDE, a += STRIDE * m) { \
        const real f = x[p], g = x[p + 1], h = x[p + 2], l = x[p + 3]; \
        const real *const b = a + m, *const c = b + m, *const d = c + m; \
        for (i = 0; i < m; ++i) z[i] += NUMBER(a[i]) * f + NUMBER(b[i]) * g + NUMBER(c[i]) * h + NUMBER(d[i]) * l; \
      } \
      for (; p < k; ++p, a += m) \
        for (i = 0; i < m; ++i) z[i] += NUMBER(a[i]) * x[p]; \
    } \
  }
MULTIPLY(multiply, PLAIN)
MULTIPLY(multiply_squares, SQUARE)

/* z (m, n) = NUMBER(w (k, m))^T x (k, n). */
#define MULTIPLY_TRANSPOSED(name, NUMBER) \
  static void name(const real *w, const real *x, real *z, int m, int k, int n) { \
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
