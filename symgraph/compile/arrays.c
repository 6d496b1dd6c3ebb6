/* Arrays whose numbers are rows of B lanes, B = 1 for plain ones, in standard C. */
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
static void widen(real *z, const real *x, long count, long step, long B) {
  long i, l;
  for (i = 0; i < count; ++i)
    for (l = 0; l < B; ++l) z[i * B + l] = x[i * step];
}
/* Tables hold pairs (place in z, place in x). */
static void copy_some(real *z, const real *x, const int *table, long count, long B) {
  long i;
  for (i = 0; i < count; ++i, table += 2) memcpy(z + table[0] * B, x + table[1] * B, (size_t) B * sizeof(real));
}
static void widen_some(real *z, const real *x, const int *table, long count, long B) {
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
