/* Products of matrices in column-major order.

   A matrix of weights serves all gradients of a search, so it is packed once: panels of PANEL rows, in each the columns one
   after the other. A tile of the result, PANEL rows of one panel and up to three vectors, stays in registers while panel and
   right factor are read once, and the next panel is fetched from where weights lie that do not fit the near caches. */
#define PANEL 8
#if defined(__AVX512F__)
#define TILE_ROWS 8 /* of 32 registers 24 hold a tile */
#else
#define TILE_ROWS 4 /* of 16 registers 12 do */
#endif

typedef real row_vec __attribute__((vector_size(PANEL * sizeof(real)), aligned(sizeof(real)), may_alias));

/* z (panels of PANEL rows) = the matrix (m, k) whose numbers lie `row` and `column` apart; rows beyond m are zero. */
static void pack(const real *x, real *z, long m, long k, long row, long column) {
  long i, p, r;
  for (i = 0; i < m; i += PANEL, x += PANEL * row)
    if (m - i >= PANEL)
      for (p = 0; p < k; ++p, z += PANEL)
        for (r = 0; r < PANEL; ++r) z[r] = x[r * row + p * column];
    else
      for (p = 0; p < k; ++p, z += PANEL)
        for (r = 0; r < PANEL; ++r) z[r] = r < m - i ? x[r * row + p * column] : 0;
}

#define EACH_ROW_8(DO) DO(0) DO(1) DO(2) DO(3) DO(4) DO(5) DO(6) DO(7)
#define EACH_ROW_4(DO) DO(0) DO(1) DO(2) DO(3)
#if TILE_ROWS == 8
#define EACH_ROW EACH_ROW_8
#else
#define EACH_ROW EACH_ROW_4
#endif

/* `rows` rows of z, a vector each at z0, z1, z2 = panel (…, k) times the vectors at x0, x1, x2; rows lie B apart. */
#define ZERO_3(r) vec a##r = {0}, b##r = {0}, c##r = {0};
#define ADD_3(r) a##r += w[r] * u; b##r += w[r] * v; c##r += w[r] * s;
#define PUT_3(r) if (r < rows) { store(z0 + r * B, a##r); store(z1 + r * B, b##r); store(z2 + r * B, c##r); }
static void tile_3(const real *w, long k, const real *x0, const real *x1, const real *x2, real *z0, real *z1, real *z2,
                   long rows, long B) {
  long p;
  EACH_ROW(ZERO_3)
  for (p = 0; p < k; ++p, w += PANEL, x0 += B, x1 += B, x2 += B) {
    const vec u = load(x0), v = load(x1), s = load(x2);
    __builtin_prefetch(w + PANEL * k);
    EACH_ROW(ADD_3)
  }
  EACH_ROW(PUT_3)
}
#define ZERO_2(r) vec a##r = {0}, b##r = {0};
#define ADD_2(r) a##r += w[r] * u; b##r += w[r] * v;
#define PUT_2(r) if (r < rows) { store(z0 + r * B, a##r); store(z1 + r * B, b##r); }
static void tile_2(const real *w, long k, const real *x0, const real *x1, real *z0, real *z1, long rows, long B) {
  long p;
  EACH_ROW(ZERO_2)
  for (p = 0; p < k; ++p, w += PANEL, x0 += B, x1 += B) {
    const vec u = load(x0), v = load(x1);
    __builtin_prefetch(w + PANEL * k);
    EACH_ROW(ADD_2)
  }
  EACH_ROW(PUT_2)
}
#define ZERO_1(r) vec a##r = {0};
#define ADD_1(r) a##r += w[r] * u;
#define PUT_1(r) if (r < rows) store(z0 + r * B, a##r);
static void tile_1(const real *w, long k, const real *x0, real *z0, long rows, long B) {
  long p;
  EACH_ROW(ZERO_1)
  for (p = 0; p < k; ++p, w += PANEL, x0 += B) {
    const vec u = load(x0);
    __builtin_prefetch(w + PANEL * k);
    EACH_ROW(ADD_1)
  }
  EACH_ROW(PUT_1)
}

/* Where the vector with number v of a matrix with rows of B lanes begins: column by column, lanes within a column. */
#define VECTOR(p, rows, v) ((p) + (v) / per_column * (rows) * B + (v) % per_column * VL)

/* z (m, n) = w (m, k) x (k, n), w packed, x and z with B lanes. */
static void multiply_packed_lanes(const real *w, const real *x, real *z, long m, long k, long n, long B) {
  const long per_column = B / VL, vectors = n * per_column;
  long i, r, v;
  for (i = 0; i < m; i += PANEL, w += PANEL * k)
    for (r = 0; r < PANEL && i + r < m; r += TILE_ROWS) {
      const long rows = m - i - r < TILE_ROWS ? m - i - r : TILE_ROWS;
      real *const y = z + (i + r) * B;
      for (v = 0; v < vectors;) {
        const long left = vectors - v;
        if (left == 1) {
          tile_1(w + r, k, VECTOR(x, k, v), VECTOR(y, m, v), rows, B);
          v += 1;
        } else if (left == 2 || left == 4) {
          tile_2(w + r, k, VECTOR(x, k, v), VECTOR(x, k, v + 1), VECTOR(y, m, v), VECTOR(y, m, v + 1), rows, B);
          v += 2;
        } else {
          tile_3(w + r, k, VECTOR(x, k, v), VECTOR(x, k, v + 1), VECTOR(x, k, v + 2), VECTOR(y, m, v),
                 VECTOR(y, m, v + 1), VECTOR(y, m, v + 2), rows, B);
          v += 3;
        }
      }
    }
}

static inline void put_rows(real *z, row_vec x, long rows) {
  if (rows >= PANEL)
    *(row_vec *) z = x;
  else
    memcpy(z, &x, (size_t) rows * sizeof(real));
}

/* z (m, n) = w (m, k) x (k, n), w packed, or with the squares of w; bound by how fast w can be read, so four panels at once,
   or one for four columns. Unlike above, squares are better made anew than read. */
#define MULTIPLY_PACKED(name, NUMBER) \
  static void name(const real *w, const real *x, real *z, long m, long k, long n) { \
    long i, j, p; \
    for (j = 0; j + 4 <= n; j += 4, x += 4 * k, z += 4 * m) { \
      const real *panel = w, *const x1 = x + k, *const x2 = x + 2 * k, *const x3 = x + 3 * k; \
      for (i = 0; i < m; i += PANEL) { \
        row_vec a = {0}, b = {0}, c = {0}, d = {0}; \
        for (p = 0; p < k; ++p, panel += PANEL) { \
          const row_vec row = NUMBER(panel); \
          a += row * x[p]; \
          b += row * x1[p]; \
          c += row * x2[p]; \
          d += row * x3[p]; \
        } \
        put_rows(z + i, a, m - i); \
        put_rows(z + m + i, b, m - i); \
        put_rows(z + 2 * m + i, c, m - i); \
        put_rows(z + 3 * m + i, d, m - i); \
      } \
    } \
    for (; j < n; ++j, x += k, z += m) { \
      const real *panel = w; \
      const long size = PANEL * k; \
      for (i = 0; i + 3 * PANEL < m; i += 4 * PANEL, panel += 4 * size) { \
        row_vec a = {0}, b = {0}, c = {0}, d = {0}; \
        const real *row = panel; \
        for (p = 0; p < k; ++p, row += PANEL) { \
          a += NUMBER(row) * x[p]; \
          b += NUMBER(row + size) * x[p]; \
          c += NUMBER(row + 2 * size) * x[p]; \
          d += NUMBER(row + 3 * size) * x[p]; \
        } \
        put_rows(z + i, a, m - i); \
        put_rows(z + i + PANEL, b, m - i - PANEL); \
        put_rows(z + i + 2 * PANEL, c, m - i - 2 * PANEL); \
        put_rows(z + i + 3 * PANEL, d, m - i - 3 * PANEL); \
      } \
      for (; i < m; i += PANEL, panel += size) { \
        row_vec a = {0}; \
        for (p = 0; p < k; ++p) a += NUMBER(panel + p * PANEL) * x[p]; \
        put_rows(z + i, a, m - i); \
      } \
    } \
  }
#define ROW(p) (*(const row_vec *) (p))
#define SQUARED_ROW(p) (ROW(p) * ROW(p))
MULTIPLY_PACKED(multiply_packed, ROW)
MULTIPLY_PACKED(multiply_squares, SQUARED_ROW)

/* z = w x, and y = the squares of w times v, w (m, k) packed, each of one column; two panels at once. */
static void multiply_pair(const real *w, const real *x, const real *v, real *z, real *y, long m, long k) {
  const long size = PANEL * k;
  long i, p;
  for (i = 0; i < m; i += 2 * PANEL, w += 2 * size) {
    row_vec a = {0}, b = {0}, c = {0}, d = {0};
    const real *row = w;
    if (i + PANEL < m) {
      for (p = 0; p < k; ++p, row += PANEL) {
        a += ROW(row) * x[p];
        b += SQUARED_ROW(row) * v[p];
        c += ROW(row + size) * x[p];
        d += SQUARED_ROW(row + size) * v[p];
      }
      put_rows(z + i + PANEL, c, m - i - PANEL);
      put_rows(y + i + PANEL, d, m - i - PANEL);
    } else {
      for (p = 0; p < k; ++p, row += PANEL) {
        a += ROW(row) * x[p];
        b += SQUARED_ROW(row) * v[p];
      }
    }
    put_rows(z + i, a, m - i);
    put_rows(y + i, b, m - i);
  }
}

/* z (m, n) = x (m, k) y (k, n). */
static void multiply(const real *x, const real *y, real *z, long m, long k, long n) {
  long i, j, p;
  zero(z, m * n);
  for (j = 0; j < n; ++j)
    for (p = 0; p < k; ++p) {
      const real f = y[p + j * k];
      const real *const column = x + p * m;
      real *const sums = z + j * m;
      for (i = 0; i < m; ++i) sums[i] += column[i] * f;
    }
}

/* The same with B lanes; xw, yw numbers of a factor for each of its own, B or 1. */
static void multiply_lanes(const real *x, const real *y, real *z, long m, long k, long n, long xw, long yw, long B) {
  long i, j, p, l;
  for (j = 0; j < n; ++j)
    for (i = 0; i < m; ++i)
      for (l = 0; l < B; l += VL) {
        vec sum = {0};
        for (p = 0; p < k; ++p) {
          const real *const left = x + (i + p * m) * xw, *const right = y + (p + j * k) * yw;
          sum += (xw > 1 ? load(left + l) : all(*left)) * (yw > 1 ? load(right + l) : all(*right));
        }
        store(z + (i + j * m) * B + l, sum);
      }
}
