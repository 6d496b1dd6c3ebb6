"""Sources that are cut into several translation units are the same kernels."""

import shutil
import subprocess

import casadi as ca
import numpy as np
import pytest
from compiled_functions import assert_agrees, bound, compiled, expected, function_of
from random_functions import SHAPES, random_value

from symgraph.compile import units
from symgraph.compile.source import kernel_source

N, CHOICES = 4, 3


def functions():
    yield "random", function_of(lambda u, s, p, q: ca.sin(random_value(5, u, s, p, q)), N, CHOICES, SHAPES)

    def chained(u, s, p, q):
        """Calls of functions that call others, with tables of their own."""
        x = ca.MX.sym("x", N)
        inner = ca.Function("inner", [x], [ca.tanh(ca.DM(np.random.default_rng(1).normal(size=(N, N))) @ x) * x[::-1]])
        for _ in range(7):
            inner = ca.Function("inner", [x], [inner(ca.sin(x)) + 0.3 * inner(x[[2, 0, 3, 1]])])
        return ca.sumsqr(inner(u)) + random_value(8, u, s, p, q)

    yield "calls", function_of(chained, N, CHOICES, SHAPES)


FUNCTIONS = dict(functions())


@pytest.fixture
def short_units(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(units, "LONGEST", 30)


@pytest.mark.parametrize("build", ["lanes", "narrow"])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_units_are_the_same_kernel(short_units, name, build):
    function, rng = FUNCTIONS[name], np.random.default_rng(0)
    assert len(kernel_source(function, build == "lanes", single=False)) > 2
    shared = [rng.normal(size=shape) for shape in SHAPES]
    points, selections = rng.uniform(-1, 1, (9, N)), np.eye(CHOICES)[rng.integers(0, CHOICES, 9)]
    got = bound(compiled(function, build), shared).evaluate(points, selections)
    assert_agrees(got, expected(function, points, selections, shared))


def test_nothing_of_them_is_seen_by_other_libraries(short_units, tmp_path):
    compiled(FUNCTIONS["calls"])
    (library,) = tmp_path.rglob("*.so")
    assert b"symgraph_evaluate" in library.read_bytes()
    names = [symbol.split()[-1] for symbol in _symbols(library)]
    assert {name for name in names if not name.startswith("_")} == {
        f"symgraph_{name}" for name in ("sizes", "bind", "evaluate", "begin", "advance")
    }


def _symbols(library):
    if shutil.which("nm") is None:
        pytest.skip("no nm here")
    listed = subprocess.run(["nm", "-D", "--defined-only", str(library)], capture_output=True, text=True, check=True)
    return listed.stdout.splitlines()


def test_a_short_source_is_one_unit():
    assert len(kernel_source(FUNCTIONS["random"], lanes=True, single=False)) == 1
