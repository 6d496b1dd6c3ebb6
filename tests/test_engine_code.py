"""The C code of kernels: nothing beyond its arrays, nothing undefined, no warnings, for any processor."""

import subprocess

import casadi as ca
import numpy as np
import pytest
from compiled_functions import PROCESSORS, expected, function_of
from planning_tasks import points_of, task
from random_functions import SHAPES, random_value

from symgraph.compile import toolchain
from symgraph.compile.source import kernel_source

# Evaluates at 1, 2 and many points, climbs and ascends from them in one search and in two that share them, with every
# array as long as it must be and no longer; prints values and gradients.
MAIN = """
#include <stdio.h>
#include <stdlib.h>

static void *memory(long long count, size_t size) {
  void *made = malloc(count > 0 ? (size_t) count * size : 1);
  if (!made) exit(9);
  return made;
}
static double *copied(const double *from, long long count) {
  double *to = memory(count, sizeof(double));
  memcpy(to, from, (size_t) count * sizeof(double));
  return to;
}

static struct team team = {1};
static struct member me = {&team, 0, ~0u};

static void searched(int ascends, int limit, int parts, long long count, const double *points, const double *chosen,
                     const double *low, const double *high, const real *const *shared, const long long *sizes) {
  double *tolerances = memory(count, sizeof(double)), *scales = memory(count, sizeof(double));
  double *ends = memory(count * N_ACTIONS, sizeof(double)), *values = memory(count, sizeof(double));
  double *histories = memory(count * limit, sizeof(double));
  int *outcomes = memory(count, sizeof(int)), stop = 0;
  long long *spent = memory(count, sizeof(long long)), i;
  long next = 0;
  struct settings set = {low, high, limit, ascends, 0.9, 1e-4, 5, 1, 1, &stop};
  void *searches[2];
  real *work[2];
  int part, busy = 1;
  for (i = 0; i < count; ++i) tolerances[i] = ascends ? 0 : 1e-9, scales[i] = 1, outcomes[i] = -1;
  for (part = 0; part < parts; ++part) {
    searches[part] = memory(sizes[3], 1);
    work[part] = memory(sizes[2], sizeof(real));
    symgraph_begin(searches[part], &set, &next, parts, count, points, chosen, tolerances, scales, ends, values,
                   histories, outcomes, spent);
  }
  while (busy) {
    for (part = 0; part < parts; ++part) symgraph_advance(&me, searches[part], shared, work[part], 3);
    for (busy = 0, i = 0; i < count; ++i) busy |= outcomes[i] < 0;
  }
  for (i = 0; i < count; ++i) {
    int k;
    double last = 0;
    if (spent[i] < 1 || spent[i] > limit) exit(8);
    for (k = 0; k < spent[i]; ++k) last += histories[i * limit + k] > 0;
    for (k = 0; k < N_ACTIONS; ++k) last += ends[i * N_ACTIONS + k];
    if (values[i] + last > 1e300) printf("large\\n");
  }
  for (part = 0; part < parts; ++part) free(searches[part]), free(work[part]);
  free(tolerances), free(scales), free(ends), free(values), free(histories), free(outcomes), free(spent);
}

int main(void) {
  long long sizes[5], counts[] = {1, 2, COUNT}, i;
  int c, stop = 0, n;
  real *shared[N_SHARED + 1], *early, *work;
  double *low = copied(LOW, N_ACTIONS), *high = copied(HIGH, N_ACTIONS);
  symgraph_sizes(sizes);
  for (n = 0; n < N_SHARED; ++n) {
    shared[n] = memory(LENGTHS[n], sizeof(real));
    for (i = 0; i < LENGTHS[n]; ++i) shared[n][i] = (real) GIVEN[n][i];
  }
  shared[N_SHARED] = memory(sizes[0], sizeof(real));
  early = memory(sizes[1], sizeof(real));
  work = memory(sizes[2], sizeof(real));
  symgraph_bind(&me, (const real *const *) shared, shared[N_SHARED], early);
  free(early);
  for (c = 0; c < 3; ++c) {
    long long count = counts[c];
    double *points = copied(POINTS, count * N_ACTIONS), *chosen = copied(CHOSEN, count * N_SELECTIONS);
    double *values = memory(count, sizeof(double)), *gradients = memory(count * N_ACTIONS, sizeof(double));
    symgraph_evaluate(&me, count, points, chosen, (const real *const *) shared, &stop, values, gradients, work);
    if (c == 2) {
      for (i = 0; i < count; ++i) printf("%.17g\\n", values[i]);
      for (i = 0; i < count * N_ACTIONS; ++i) printf("%.17g\\n", gradients[i]);
    }
    searched(0, 12, 1, count, points, chosen, low, high, (const real *const *) shared, sizes);
    searched(1, 9, 1, count, points, chosen, low, high, (const real *const *) shared, sizes);
    searched(0, 5, 2, count, points, chosen, low, high, (const real *const *) shared, sizes);
    free(points), free(chosen), free(values), free(gradients);
  }
  for (n = 0; n <= N_SHARED; ++n) free(shared[n]);
  free(work), free(low), free(high);
  return 0;
}
"""


def numbers(name, values):
    text = ", ".join("NAN" if np.isnan(x) else repr(float(x)) for x in np.ravel(values)) or "0"
    return f"static const double {name}[] = {{{text}}};\n"


def source_of(*given):
    (source,) = kernel_source(*given)
    return source


def with_main(source, points, selections, shared, low, high):
    order = np.lexsort(selections.T) if selections.shape[1] else np.arange(len(points))
    columns = [np.ravel(column, order="F") for column in shared]
    data = [numbers(f"GIVEN_{i}", column) for i, column in enumerate(columns)]
    data.append(
        f"static const double *const GIVEN[] = {{{', '.join(f'GIVEN_{i}' for i in range(len(columns))) or '0'}}};\n"
    )
    data.append(f"static const long long LENGTHS[] = {{{', '.join(str(len(c)) for c in columns) or '0'}}};\n")
    data += [numbers("POINTS", points[order]), numbers("CHOSEN", selections[order])]
    data += [numbers("LOW", low), numbers("HIGH", high), f"#define COUNT {len(points)}\n"]
    return source + "".join(data) + MAIN, order


def run(folder, source, flags):
    """Compile and run; return what it prints."""
    file, made = folder / "kernel.c", folder / "kernel"
    file.write_text(source)
    command = [toolchain.find_compiler(), *flags, str(file), "-o", str(made), *toolchain.vector_library()[1]]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    done = subprocess.run([made], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-300:] + done.stderr[-3000:]
    return np.array([float(line) for line in done.stdout.split()])


SANITIZED = ("-O1", "-g", "-std=c99", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-ffp-contract=fast")


def of_task(name, count=70):
    """A task's function, points, selections, what is bound, and bounds."""
    objective, state = task(name)
    situation = objective.situation(state)
    points, selections = points_of(objective, count)
    return situation.build.expectation.value_function(), points, selections, situation.shared, *objective.bounds


def of_random_functions(seed, count=70):
    rng = np.random.default_rng(seed)

    def body(u, s, p, q):
        return random_value(2 * seed, u, s, p, q) + random_value(2 * seed + 1, u, s, p, q)

    shared = [rng.normal(size=shape) for shape in SHAPES]
    selections = np.eye(3)[rng.integers(0, 3, count)]
    return function_of(body, 4, 3, SHAPES), rng.uniform(-1, 1, (count, 4)), selections, shared, -np.ones(4), np.ones(4)


def of_externals(count=70):
    """What is left to CasADi's own code."""
    rng = np.random.default_rng(0)
    grid = np.linspace(-2, 2, 9)
    table = ca.interpolant("table", "bspline", [grid], np.sin(grid))

    def body(u, s, p, q):
        x = ca.reshape(ca.vertcat(u, p[:5]), 3, 3)
        solved = ca.solve(x + 3 * ca.MX.eye(3), u[1:])
        return table(u[0]) * ca.logsumexp(u) + ca.sumsqr(solved) + ca.det(x) + q.nz[s[0]] * u.nz[s[1]] + ca.mmax(u)

    shared = [rng.normal(size=shape) for shape in SHAPES]
    selections = rng.integers(0, 3, (count, 2)).astype(float)
    return function_of(body, 4, 2, SHAPES), rng.uniform(-1, 1, (count, 4)), selections, shared, -np.ones(4), np.ones(4)


KERNELS = {
    "cannon": lambda: of_task("cannon"),
    "push": lambda: of_task("push"),
    "pouring": lambda: of_task("pouring"),
    "random task 3": lambda: of_task("random 3"),
    "random task 120": lambda: of_task("random 120"),
    "random functions 1": lambda: of_random_functions(1),
    "random functions 2": lambda: of_random_functions(2),
    "externals": of_externals,
}
LONG = ("push", "pouring", "random functions 2")
some_slow = [pytest.param(name, marks=pytest.mark.slow) if name in LONG else name for name in KERNELS]


def assert_clean(folder, name, flags, lanes, single):
    function, points, selections, shared, low, high = KERNELS[name]()
    source, order = with_main(source_of(function, lanes, single), points, selections, shared, low, high)
    got = run(folder, source, flags)
    shaped = [ca.reshape(ca.DM(np.ravel(x, order="F")), *function.size_in(2 + i)) for i, x in enumerate(shared)]
    values, gradients = expected(function, points[order], selections[order], shaped)
    if single:
        assert np.isfinite(got).all()
        return
    np.testing.assert_allclose(got[: len(order)], values, rtol=1e-9, atol=1e-9)
    sizes = 1 + np.abs(gradients).max(axis=1, keepdims=True)
    np.testing.assert_allclose(got[len(order) :].reshape(gradients.shape) / sizes, gradients / sizes, rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", some_slow)
def test_it_stays_within_its_arrays(tmp_path, name):
    assert_clean(tmp_path, name, (*SANITIZED, "-march=native", *toolchain.vector_library()[0]), True, False)


@pytest.mark.slow
@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize("processor", PROCESSORS)
@pytest.mark.parametrize("lanes", [True, False], ids=["lanes", "narrow"])
@pytest.mark.parametrize("single", [False, True], ids=["double", "single"])
def test_everything_stays_within_its_arrays(tmp_path, name, processor, lanes, single):
    macros = () if processor == "any processor" else toolchain.vector_library()[0]
    assert_clean(tmp_path, name, (*SANITIZED, *PROCESSORS[processor], *macros), lanes, single)


def test_the_sanitizers_would_notice(tmp_path):
    """Too few numbers, to see that the tests above can fail."""
    function, points, selections, shared, low, high = KERNELS["random task 3"]()
    source, _ = with_main(source_of(function, True, False), points, selections, shared, low, high)
    few = source.replace("work[part] = memory(sizes[2], ", "work[part] = memory(sizes[2] / 8, ")
    assert few != source
    with pytest.raises(AssertionError, match="heap-buffer-overflow"):
        run(tmp_path, few, (*SANITIZED, "-march=native", *toolchain.vector_library()[0]))


@pytest.mark.parametrize("lanes", [True, False], ids=["lanes", "narrow"])
@pytest.mark.parametrize("name", ["cannon", "random task 120", "random functions 1"])
def test_it_compiles_without_warnings(tmp_path, name, lanes):
    function, *_ = KERNELS[name]()
    file = tmp_path / "kernel.c"
    for single in (False, True):
        file.write_text(source_of(function, lanes, single))
        warnings = ("-Wall", "-Wextra", "-Werror", "-Wno-unused-function", "-Wno-unused-parameter")
        macros, libraries = toolchain.vector_library()
        command = [toolchain.find_compiler(), "-shared", *toolchain.FLAGS, *macros, *warnings, str(file), "-o"]
        command += [str(tmp_path / "kernel.so"), *libraries]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-3000:]
