"""Products of dense matrices in C: against the interpreter, and alone under the compiler's sanitizers."""

import subprocess
from importlib import resources

import casadi as ca
import numpy as np
import pytest

import symgraph as sg
from symgraph.compile import compiled as compiled_module
from symgraph.compile import toolchain
from symgraph.compile.compiled import CompiledKernel
from symgraph.compile.interpreted import InterpretedKernel

# Around the blocks of 8 × 4, 16 × 1 and, for transposed products, 8 in depth.
SHAPES = [
    (1, 1, 1),
    (3, 2, 5),
    (7, 7, 4),
    (8, 1, 4),
    (8, 8, 3),
    (9, 9, 5),
    (15, 16, 8),
    (16, 17, 1),
    (17, 5, 9),
    (23, 20, 6),
    (24, 3, 10),
    (31, 12, 2),
    (32, 15, 1),
    (35, 20, 7),
]


def product_kernel(rows, depth, columns):
    """The function of a kernel: of weights W (rows, depth) and V (depth, rows), a curved sum of W X(u) and VᵀX(u).

    Its gradient holds the products with the other factor transposed.
    """
    rng = np.random.default_rng(0)
    u, selections = ca.MX.sym("u", 3), ca.MX.sym("selections", 0)
    w, v = ca.MX.sym("w", rows, depth), ca.MX.sym("v", depth, rows)
    x = ca.reshape(ca.tanh(ca.mtimes(ca.DM(rng.normal(size=(depth * columns, 3))), u)), depth, columns)
    y = ca.tanh(ca.mtimes(w, x) / depth) + ca.sin(ca.mtimes(v.T, x) / depth)
    value = ca.sum1(ca.sum2(ca.DM(rng.normal(size=(rows, columns))) * y))
    return ca.Function("kernel_of_products", [u, selections, w, v], [value, ca.gradient(value, u)])


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_values_and_gradients_agree(shape):
    """To 1e-13 of the largest: sums in another order differ by the roundings of their terms."""
    rng = np.random.default_rng(sum(shape))
    function = product_kernel(*shape)
    made = InterpretedKernel(function), CompiledKernel(function, toolchain.find_compiler())
    if min(shape[:2]) > 1:  # others CasADi may write as products of columns
        assert "symgraph_multiply" in made[1]._source
    shared = [rng.normal(size=shape[0] * shape[1]) for _ in range(2)]
    points = rng.uniform(-1, 1, (4, 3))
    bound = [kernel.bind(shared, -np.ones(3), np.ones(3)) for kernel in made]
    (values, gradients), (c_values, c_gradients) = [k.evaluate(points, np.zeros((4, 0))) for k in bound]
    assert np.ptp(values) > 0
    np.testing.assert_allclose(c_values, values, rtol=0, atol=1e-13 * np.abs(values).max())
    np.testing.assert_allclose(c_gradients, gradients, rtol=0, atol=1e-13 * np.abs(gradients).max())


# matrices.c alone

LIBRARY = """
#include <string.h>
typedef double casadi_real;
typedef long long casadi_int;
"""

MAIN = """
#include <stdio.h>
#include <stdlib.h>
#include <math.h>

/* Numbers whose sums are exact, so that any order gives the same. */
static double draw(void) {
  static unsigned long long state = 1;
  state = state * 6364136223846793005ULL + 1442695040888963407ULL;
  return (double)(int)((state >> 40) % 2001) - 1000;
}

/* Each matrix ends where its memory ends, with its start as little aligned as a double may be. */
static double *matrix(int size) {
  double *made = malloc(size * sizeof(double));
  int i;
  for (i = 0; i < size; ++i) made[i] = draw();
  return made;
}

static int wrong(int rows, int depth, int columns, int tr) {
  double *x = matrix(rows * depth), *y = matrix(depth * columns), *z = matrix(rows * columns);
  double *expected = malloc(rows * columns * sizeof(double));
  int i, j, k, bad = 0;
  for (i = 0; i < rows; ++i)
    for (j = 0; j < columns; ++j) {
      double sum = z[i + j * rows];
      for (k = 0; k < depth; ++k) sum += (tr ? x[k + i * depth] : x[i + k * rows]) * y[k + j * depth];
      expected[i + j * rows] = sum;
    }
  if (tr) casadi_mtimes_dense(x, depth, rows, y, columns, z, 1);
  else casadi_mtimes_dense(x, rows, depth, y, columns, z, 0);
  for (i = 0; i < rows * columns; ++i) bad |= z[i] != expected[i];
  free(x), free(y), free(z), free(expected);
  if (bad) printf("wrong: %d x %d x %d, transposed %d\\n", rows, depth, columns, tr);
  return bad;
}

int main(void) {
  int rows, depth, columns, bad = 0;
  for (rows = 1; rows <= 35; ++rows)
    for (depth = 1; depth <= 20; ++depth)
      for (columns = 1; columns <= 10; ++columns)
        bad |= wrong(rows, depth, columns, 0) | wrong(rows, depth, columns, 1);
  return bad;
}
"""


def build(folder, *flags, source=None):
    """Compile matrices.c with the loops that judge it; return the executable."""
    matrices = (resources.files("symgraph.compile") / "matrices.c").read_text()
    file = folder / "products.c"
    file.write_text(source or LIBRARY + matrices + MAIN)
    made = folder / "products"
    command = [toolchain.find_compiler(), *flags, str(file), "-o", str(made), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return made


SANITIZED = ("-O1", "-g", "-std=c99", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-ffp-contract=fast")


@pytest.mark.parametrize("native", [(), ("-march=native",)], ids=["any processor", "this processor"])
def test_products_stay_within_their_matrices(tmp_path, native):
    """Every shape around the blocks against three plain loops, with memory and arithmetic watched."""
    done = subprocess.run([build(tmp_path, *SANITIZED, *native)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_sanitizers_would_notice(tmp_path):
    """One number beyond the end, to see that the test above can fail."""
    matrices = (resources.files("symgraph.compile") / "matrices.c").read_text()
    too_far = matrices.replace("for (; k < depth; ++k) sum", "for (; k <= depth; ++k) sum")
    assert too_far != matrices
    executable = build(tmp_path, *SANITIZED, source=LIBRARY + too_far + MAIN)
    done = subprocess.run([executable], capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "heap-buffer-overflow" in done.stderr


def test_products_as_kernels_are_compiled(tmp_path):
    done = subprocess.run([build(tmp_path, *toolchain.FLAGS)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


# CasADi's text


def test_code_without_products_is_left_alone():
    assert compiled_module._with_fast_products("int main(void) { return 0; }\n") == "int main(void) { return 0; }\n"


def generated():
    w, x = ca.MX.sym("w", 5, 4), ca.MX.sym("x", 4, 3)
    generator = ca.CodeGenerator("kernel", {"with_header": False})
    generator.add(ca.Function("f", [w, x], [ca.mtimes(w, x)]))
    return generator.dump()


def test_one_function_of_casadi_is_replaced():
    source = generated()
    replaced = compiled_module._with_fast_products(source)
    assert source.count("casadi_mtimes_dense(") == replaced.count("casadi_mtimes_dense(") >= 2
    assert replaced.count("void casadi_mtimes_dense(") == 1
    assert "symgraph_block_8x4" in replaced


@pytest.mark.parametrize(
    ("known", "other"),
    [("void casadi_mtimes_dense(", "int casadi_mtimes_dense("), ("\n}\n", "\n }\n")],
    ids=["another signature", "another layout"],
)
def test_a_casadi_that_writes_otherwise_is_refused(known, other):
    """Rather than compiled with half of each."""
    source = generated()
    assert known in source
    with pytest.raises(sg.CompileError, match="in another form than is known"):
        compiled_module._with_fast_products(source.replace(known, other))


def test_two_of_them_are_refused():
    with pytest.raises(sg.CompileError, match="in another form than is known"):
        compiled_module._with_fast_products(generated() * 2)
