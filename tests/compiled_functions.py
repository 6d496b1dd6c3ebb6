"""Functions of actions u, selections s and bound inputs p, compiled and in CasADi, for the tests of the engine."""

from contextlib import contextmanager
from functools import cached_property
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from symgraph.compile import toolchain
from symgraph.compile.compiled import CompiledKernel, Library


class Narrow(CompiledKernel):
    """All points one at a time, in code without lanes."""

    @cached_property
    def wide(self):
        return Library(self.function, self._compiler, lanes=False, single=self.single)


BUILDS = {"lanes": CompiledKernel, "narrow": Narrow}

# Flags for processors with vectors of other lengths, which this one can stand in for.
PROCESSORS = {"this processor": ("-march=native",), "any processor": ()}
if Path("/proc/cpuinfo").exists() and " avx2 " in Path("/proc/cpuinfo").read_text():
    PROCESSORS["with AVX2"] = ("-mavx2", "-mfma")


@contextmanager
def code_for(processor):
    """Compile for a processor; for any one, without the C library's functions of vectors."""
    with pytest.MonkeyPatch.context() as patch:
        others = tuple(flag for flag in toolchain.FLAGS if flag != "-march=native")
        patch.setattr(toolchain, "FLAGS", (*others, *PROCESSORS[processor]))
        if processor == "any processor":
            patch.setattr(toolchain, "vector_library", lambda: ((), ("-lm",)))
        yield


def function_of(body, n, m=0, shapes=()):
    """The function u (n), s (m), p₁ … → body, a number."""
    u, s = ca.MX.sym("u", n), ca.MX.sym("s", m)
    p = [ca.MX.sym(f"p{i}", *shape) for i, shape in enumerate(shapes)]
    return ca.Function("f", [u, s, *p], [ca.densify(body(u, s, *p))])


def compiled(function, build="lanes", single=False):
    return BUILDS[build](function, toolchain.find_compiler(), single)


def bound(kernel, shared=(), threads=1):
    n = kernel.n_actions
    columns = [np.asarray(ca.DM(x).full()).ravel(order="F") for x in shared]
    return kernel.bind(columns, np.full(n, -10.0), np.full(n, 10.0), threads=threads)


def in_casadi(function):
    """The function u, s, p₁ … → value, gradient by u, as CasADi derives it."""
    inputs = function.mx_in()
    (value,) = function.call(inputs, True, False)
    return ca.Function("reference", inputs, [value, ca.densify(ca.gradient(value, inputs[0]))])


def expected(function, points, selections, shared=()):
    """Values (P,) and gradients (P, n) in CasADi."""
    reference = in_casadi(function)
    results = [reference(u, s, *shared) for u, s in zip(points, selections, strict=True)]
    return np.array([float(value) for value, _ in results]), np.array([g.full().ravel() for _, g in results])


def assert_agrees(got, wanted, tolerance=1e-12):
    """To the tolerance of the largest number of its kind."""
    for one, other in zip(got, wanted, strict=True):
        assert np.isfinite(other).all()
        np.testing.assert_allclose(one, other, rtol=0, atol=tolerance * (1 + np.abs(other).max(initial=0.0)))
