"""Products of dense matrices in C: alone under the compiler's sanitizers, and in kernels against the interpreter."""

import subprocess
from importlib import resources

import casadi as ca
import numpy as np
import pytest
from compiled_functions import PROCESSORS, assert_agrees, bound, compiled, expected, function_of

from symgraph.compile import toolchain
from symgraph.compile.source import PRECISION

MAIN = """
#include <stdio.h>
#include <stdlib.h>

/* Numbers whose sums are exact in any order, in single precision too, and so are those of their squares. */
static real draw(void) {
  static unsigned long long state = 1;
  state = state * 6364136223846793005ULL + 1442695040888963407ULL;
  return (real) ((int) ((state >> 40) % 61) - 30);
}

/* Each matrix ends where its memory ends, as little aligned as a number may be. */
static real *memory(long size) {
  real *made = malloc((size_t) size * sizeof(real));
  if (!made) exit(9);
  return made;
}
static real *matrix(long size) {
  real *made = memory(size);
  long i;
  for (i = 0; i < size; ++i) made[i] = draw();
  return made;
}

/* z = x y: x (m, k) with xw numbers for each of its own, y (k, n) with yw, z with B. */
static real *plain(const real *x, const real *y, long m, long k, long n, long xw, long yw, long B, int squared) {
  real *z = memory(m * n * B);
  long i, j, p, l;
  for (i = 0; i < m; ++i)
    for (j = 0; j < n; ++j)
      for (l = 0; l < B; ++l) {
        real sum = 0;
        for (p = 0; p < k; ++p) {
          const real f = x[(i + p * m) * xw + (xw > 1 ? l : 0)];
          sum += (squared ? f * f : f) * y[(p + j * k) * yw + (yw > 1 ? l : 0)];
        }
        z[(i + j * m) * B + l] = sum;
      }
  return z;
}

static int differs(const char *name, real *got, real *wanted, long m, long k, long n, long B) {
  const int wrong = memcmp(got, wanted, (size_t) (m * n * B) * sizeof(real)) != 0;
  long i, unequal = 0;
  if (wrong) /* but 0 and -0 are equal */
    for (i = 0; i < m * n * B; ++i) unequal += got[i] != wanted[i];
  if (unequal) printf("%s is wrong: %ld x %ld x %ld, %ld lanes\\n", name, m, k, n, B);
  free(got), free(wanted);
  return unequal != 0;
}

static int wrong(long m, long k, long n, long B) {
  real *x = matrix(m * k), *y = matrix(k * n), *xt = memory(m * k), *z;
  real *packed = memory((m + PANEL - 1) / PANEL * PANEL * k);
  long i, p;
  int bad = 0;
  for (i = 0; i < m; ++i)
    for (p = 0; p < k; ++p) xt[p + i * k] = x[i + p * m];
  if (B == 1) {
    pack(x, packed, m, k, 1, m);
    z = memory(m * n);
    multiply_packed(packed, y, z, m, k, n);
    bad |= differs("multiply_packed", z, plain(x, y, m, k, n, 1, 1, 1, 0), m, k, n, 1);
    z = memory(m * n);
    multiply_squares(packed, y, z, m, k, n);
    bad |= differs("multiply_squares", z, plain(x, y, m, k, n, 1, 1, 1, 1), m, k, n, 1);
    z = memory(m * n);
    multiply(x, y, z, m, k, n);
    bad |= differs("multiply", z, plain(x, y, m, k, n, 1, 1, 1, 0), m, k, n, 1);
  } else {
    real *xl = matrix(m * k * B), *yl = matrix(k * n * B);
    pack(xt, packed, m, k, k, 1); /* as the transpose of a matrix (k, m) */
    z = memory(m * n * B);
    multiply_packed_lanes(packed, yl, z, m, k, n, B);
    bad |= differs("multiply_packed_lanes", z, plain(x, yl, m, k, n, 1, B, B, 0), m, k, n, B);
    z = memory(m * n * B);
    multiply_lanes(xl, yl, z, m, k, n, B, B, B);
    bad |= differs("multiply_lanes", z, plain(xl, yl, m, k, n, B, B, B, 0), m, k, n, B);
    z = memory(m * n * B);
    multiply_lanes(xl, y, z, m, k, n, B, 1, B);
    bad |= differs("multiply_lanes, left", z, plain(xl, y, m, k, n, B, 1, B, 0), m, k, n, B);
    z = memory(m * n * B);
    multiply_lanes(x, yl, z, m, k, n, 1, B, B);
    bad |= differs("multiply_lanes, right", z, plain(x, yl, m, k, n, 1, B, B, 0), m, k, n, B);
    free(xl), free(yl);
  }
  free(x), free(y), free(packed), free(xt);
  return bad;
}

int main(void) {
  const long depths[] = {1, 2, 3, 7, 8, 9, 16, 20};
  long m, d, n, v;
  int bad = 0;
  for (m = 1; m <= 35; ++m)
    for (d = 0; d < 8; ++d)
      for (n = 1; n <= 10; ++n) {
        bad |= wrong(m, depths[d], n, 1);
        if (m <= 17 && n <= 5)
          for (v = 1; v <= 5; ++v) bad |= wrong(m, depths[d], n, v * VL);
      }
  return bad;
}
"""


def source(single, products=None):
    folder = resources.files("symgraph.compile")
    products = products or (folder / "products.c").read_text()
    before = [(folder / name).read_text() for name in ("scalars.c", "arrays.c", "lanes.c")]
    return "\n".join([PRECISION[single], *before, products, MAIN])


def run(folder, flags, text):
    file, made = folder / "products.c", folder / "products"
    file.write_text(text)
    command = [toolchain.find_compiler(), *flags, str(file), "-o", str(made), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return subprocess.run([made], capture_output=True, text=True, check=False)


SANITIZED = ("-O1", "-g", "-std=c99", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-ffp-contract=fast")
both_precisions = pytest.mark.parametrize("single", [False, True], ids=["double", "single"])


@both_precisions
@pytest.mark.parametrize("processor", PROCESSORS)
def test_products_stay_within_their_matrices(tmp_path, processor, single):
    """Every shape around the blocks against three plain loops, with memory and arithmetic watched."""
    done = run(tmp_path, (*SANITIZED, *PROCESSORS[processor]), source(single))
    assert done.returncode == 0, done.stdout + done.stderr


@both_precisions
def test_products_as_kernels_are_compiled(tmp_path, single):
    done = run(tmp_path, toolchain.FLAGS, source(single))
    assert done.returncode == 0, done.stdout + done.stderr


FAULTS = {
    "past the end of what is packed": ("for (; i < m; i += PANEL, panel", "for (; i < m + PANEL; i += PANEL, panel"),
    "past the end of the result": ("if (rows >= PANEL)", "if (rows)"),
    "past the last lane": ("if (left == 1) {", "if (left == 0) {"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_the_sanitizers_would_notice(tmp_path, fault):
    """To see that the tests above can fail."""
    products = (resources.files("symgraph.compile") / "products.c").read_text()
    too_far = products.replace(*FAULTS[fault])
    assert too_far != products
    done = run(tmp_path, SANITIZED, source(False, too_far))
    assert done.returncode != 0
    assert "heap-buffer-overflow" in done.stderr


def test_wrong_numbers_would_be_noticed(tmp_path):
    products = (resources.files("symgraph.compile") / "products.c").read_text()
    done = run(tmp_path, SANITIZED, source(False, products.replace("b##r += w[r] * v;", "b##r += w[r] * u;")))
    assert done.returncode == 1
    assert "multiply_packed_lanes is wrong" in done.stdout


# In kernels

SHAPES = [(1, 1, 1), (3, 2, 5), (8, 8, 3), (9, 9, 5), (16, 17, 1), (24, 3, 10), (35, 20, 7)]


def products(rows, depth, columns):
    """A curved sum of W X(u), VᵀX(u) and W² X(u)², with weights W (rows, depth) and V (depth, rows).

    Its gradient holds the products with the other factor transposed.
    """
    rng = np.random.default_rng(0)

    def body(u, s, w, v):
        x = ca.reshape(ca.tanh(ca.mtimes(ca.DM(rng.normal(size=(depth * columns, 3))), u)), depth, columns)
        y = ca.tanh(w @ x / depth) + ca.sin(v.T @ x / depth) + ca.cos(w**2 @ x**2 / depth)
        return ca.sum1(ca.sum2(ca.DM(rng.normal(size=(rows, columns))) * y))

    return function_of(body, 3, 0, [(rows, depth), (depth, rows)])


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_values_and_gradients_agree(shape):
    """To 1e-13 of the largest: sums in another order differ by the roundings of their terms."""
    rng = np.random.default_rng(sum(shape))
    function = products(*shape)
    shared = [rng.normal(size=shape[:2]), rng.normal(size=shape[1::-1])]
    points, none = rng.uniform(-1, 1, (4, 3)), np.zeros((4, 0))
    wanted = expected(function, points, none, shared)
    assert np.ptp(wanted[0]) > 0
    for build in ("lanes", "narrow"):
        assert_agrees(bound(compiled(function, build), shared).evaluate(points, none), wanted, 1e-13)
