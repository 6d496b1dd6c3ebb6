/* Products of dense matrices in column-major order, in place of CasADi's, which walk the left factor across its columns.

   Blocks of 8 rows and 4 columns of the result stay in registers while the factors are read once. The vectors are GNU C's,
   which gcc and clang know; what does not fill a block is done number by number. */
typedef casadi_real symgraph_vector __attribute__((vector_size(4 * sizeof(casadi_real)), aligned(sizeof(casadi_real)), may_alias));
#define LOAD(p) (*(const symgraph_vector *)(p))
#define ADD(p, v) (*(symgraph_vector *)(p) += (v))

/* z (8, 4) += x (8, depth) y (depth, 4); x and z have `rows` rows, y has `depth`. */
static void symgraph_block_8x4(const casadi_real *x, casadi_int rows, casadi_int depth, const casadi_real *y,
                               casadi_real *z) {
  const casadi_real *y0 = y, *y1 = y + depth, *y2 = y + 2 * depth, *y3 = y + 3 * depth;
  symgraph_vector a0 = {0}, a1 = {0}, a2 = {0}, a3 = {0}, b0 = {0}, b1 = {0}, b2 = {0}, b3 = {0};
  casadi_int k;
  for (k = 0; k < depth; ++k, x += rows) {
    symgraph_vector top = LOAD(x), bottom = LOAD(x + 4);
    a0 += top * y0[k];
    b0 += bottom * y0[k];
    a1 += top * y1[k];
    b1 += bottom * y1[k];
    a2 += top * y2[k];
    b2 += bottom * y2[k];
    a3 += top * y3[k];
    b3 += bottom * y3[k];
  }
  ADD(z, a0);
  ADD(z + 4, b0);
  ADD(z + rows, a1);
  ADD(z + rows + 4, b1);
  ADD(z + 2 * rows, a2);
  ADD(z + 2 * rows + 4, b2);
  ADD(z + 3 * rows, a3);
  ADD(z + 3 * rows + 4, b3);
}

/* z (16) += x (16, depth) y (depth): a single column is bound by how fast x can be read. */
static void symgraph_block_16x1(const casadi_real *x, casadi_int rows, casadi_int depth, const casadi_real *y,
                                casadi_real *z) {
  symgraph_vector a = {0}, b = {0}, c = {0}, d = {0};
  casadi_int k;
  for (k = 0; k < depth; ++k, x += rows) {
    a += LOAD(x) * y[k];
    b += LOAD(x + 4) * y[k];
    c += LOAD(x + 8) * y[k];
    d += LOAD(x + 12) * y[k];
  }
  ADD(z, a);
  ADD(z + 4, b);
  ADD(z + 8, c);
  ADD(z + 12, d);
}

/* z (count) += x (count, depth) y (depth) number by number. */
static void symgraph_rest(const casadi_real *x, casadi_int rows, casadi_int depth, casadi_int count,
                          const casadi_real *y, casadi_real *z) {
  casadi_int i, k;
  for (i = 0; i < count; ++i) {
    casadi_real sum = 0;
    for (k = 0; k < depth; ++k) sum += x[i + k * rows] * y[k];
    z[i] += sum;
  }
}

/* z (rows, columns) += x (rows, depth) y (depth, columns). */
static void symgraph_multiply(const casadi_real *x, casadi_int rows, casadi_int depth, const casadi_real *y,
                              casadi_int columns, casadi_real *z) {
  casadi_int i, j;
  const casadi_int fours = columns - columns % 4, eights = rows - rows % 8;
  for (i = 0; i < eights; i += 8)
    for (j = 0; j < fours; j += 4) symgraph_block_8x4(x + i, rows, depth, y + j * depth, z + i + j * rows);
  for (j = 0; j < columns; ++j) {
    i = j < fours ? eights : 0;
    for (; i + 16 <= rows; i += 16) symgraph_block_16x1(x + i, rows, depth, y + j * depth, z + i + j * rows);
    symgraph_rest(x + i, rows, depth, rows - i, y + j * depth, z + i + j * rows);
  }
}

/* z (columns of x, columns) += xT y, each number a product of two columns. */
static void symgraph_multiply_transposed(const casadi_real *x, casadi_int depth, casadi_int rows, const casadi_real *y,
                                         casadi_int columns, casadi_real *z) {
  casadi_int i, j, k;
  for (j = 0; j < columns; ++j)
    for (i = 0; i < rows; ++i) {
      const casadi_real *left = x + i * depth, *right = y + j * depth;
      symgraph_vector a = {0}, b = {0};
      casadi_real sum;
      for (k = 0; k + 8 <= depth; k += 8) {
        a += LOAD(left + k) * LOAD(right + k);
        b += LOAD(left + k + 4) * LOAD(right + k + 4);
      }
      a += b;
      sum = (a[0] + a[1]) + (a[2] + a[3]);
      for (; k < depth; ++k) sum += left[k] * right[k];
      z[i + j * rows] += sum;
    }
}

void casadi_mtimes_dense(const casadi_real *x, casadi_int nrow_x, casadi_int ncol_x, const casadi_real *y,
                         casadi_int ncol_y, casadi_real *z, casadi_int tr) {
  if (tr)
    symgraph_multiply_transposed(x, nrow_x, ncol_x, y, ncol_y, z);
  else
    symgraph_multiply(x, nrow_x, ncol_x, y, ncol_y, z);
}
