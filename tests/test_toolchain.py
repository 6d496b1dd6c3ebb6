"""The compiler and its cache: compiled once, made anew when damaged, and what is done where it cannot be."""

import os
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from small_tasks import over_box

import symgraph as sg
from symgraph.compile import rules, toolchain
from symgraph.compile.compiled import CompiledKernel

ROOT = Path(__file__).parents[1]


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A cache folder for this test alone, and a fresh look for compilers."""
    monkeypatch.setattr(toolchain.platformdirs, "user_cache_dir", lambda name: str(tmp_path / name))
    toolchain.find_compiler.cache_clear()
    yield tmp_path / "symgraph" / "kernels"
    toolchain.find_compiler.cache_clear()


@pytest.fixture
def compilations(monkeypatch):
    made, original = [], toolchain._compile

    def counted(*arguments):
        made.append(arguments)
        return original(*arguments)

    monkeypatch.setattr(toolchain, "_compile", counted)
    return made


def plan(offset=0.5):
    objective = over_box(lambda u, x: -((u - x) ** 2), 0.0, 1.0, compiled=True, states={"x": sg.State()})
    return sg.solve(objective, {"x": offset})


def test_compiled_once_for_all_objectives_alike(cache, compilations):
    for offset in (0.5, 0.25, 0.75):
        assert plan(offset).actions["u"] == pytest.approx(offset)
    assert len(compilations) == 1
    assert len(list(cache.glob("*.so"))) == 1
    assert [path.suffix for path in cache.iterdir()] == [".so"]  # nothing else is left behind


def heavy(rows):
    """A function of a kernel with a matrix of weights (rows, 20)."""
    u, chosen, w = ca.MX.sym("u", 20), ca.MX.sym("chosen", 0), ca.MX.sym("w", rows, 20)
    return ca.Function("f", [u, chosen, w], [ca.sumsqr(ca.tanh(ca.mtimes(w, u)))])


def test_single_points_have_code_of_their_own_where_there_are_many_weights(cache, compilations):
    """Compiled when it is first needed."""
    rng = np.random.default_rng(0)
    for rows, libraries in ((30, 2), (3, 1)):
        compilations.clear()
        kernel = CompiledKernel(heavy(rows), toolchain.find_compiler())
        bound = kernel.bind([rng.normal(size=20 * rows)], -np.ones(20), np.ones(20))
        points, chosen = rng.uniform(-1, 1, (2, 20)), np.zeros((2, 0))
        together = bound.evaluate(points, chosen)
        assert len(compilations) == 1
        alone = bound.evaluate(points[:1], chosen[:1])
        assert len(compilations) == libraries
        for some, one in zip(together, alone, strict=True):
            np.testing.assert_allclose(one[0], some[0], rtol=1e-12, atol=1e-13)
        ends = [list(bound.climb(points[:k], chosen[:k], 100, np.full(k, 1e-9))) for k in (1, 2)]
        assert [len(end) for end in ends] == [1, 2]
        assert ends[0][0][1].value == pytest.approx(dict(ends[1])[0].value, rel=1e-9)
        assert len(compilations) == libraries


def test_another_task_is_compiled_anew(cache, compilations):
    plan()
    sg.solve(over_box(lambda u: -(u**2), 0.0, 1.0, compiled=True), {})
    assert len(compilations) == 2


def test_a_rule_decides_what_is_compiled_where_its_function_is_called(cache, compilations, monkeypatch):
    """And nowhere else: networks give rules to functions of theirs."""
    monkeypatch.setattr(rules, "_ADJOINTS", dict(rules._ADJOINTS))
    x, y, dy = (ca.SX.sym(name) for name in ("x", "y", "dy"))
    square = ca.Function("square", [x], [x**2])
    u, chosen = ca.MX.sym("u"), ca.MX.sym("chosen", 0)
    calls, alone = (ca.Function("f", [u, chosen], [value]) for value in (square(u), ca.sin(u)))
    slopes = []
    for factor in (3, 5):
        rules.set_adjoint(square, ca.Function("adjoint", [x, y, dy], [factor * dy]))
        for function in (calls, alone):
            bound = CompiledKernel(function, toolchain.find_compiler()).bind([], -np.ones(1), np.ones(1))
            slopes.append(float(bound.evaluate(np.array([[0.5]]), np.zeros((1, 0)))[1][0, 0]))
    assert slopes == pytest.approx([3, np.cos(0.5), 5, np.cos(0.5)])
    assert len(compilations) == 3


def test_another_compiler_or_version_is_compiled_anew(cache, compilations, monkeypatch):
    plan()
    monkeypatch.setattr(toolchain, "_identity", lambda compiler: (compiler, "another version", "", ""))
    plan()
    assert len(compilations) == 2


def test_the_interpreter_compiles_nothing(cache, compilations):
    sg.solve(over_box(lambda u: -(u**2), 0.0, 1.0), {})
    assert not compilations
    assert not cache.exists()


SCRIPT = """
import sys
sys.path[:0] = [{root!r}, {root!r} + "/tests"]
from test_toolchain import plan
print(plan().actions["u"])
"""


def another_process(cache_home):
    environment = os.environ | {"XDG_CACHE_HOME": str(cache_home), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-W", "error", "-c", SCRIPT.format(root=str(ROOT))]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


DAMAGE = {
    "empty": lambda whole: b"",
    "half": lambda whole: whole[: len(whole) // 2],
    "all but a byte": lambda whole: whole[:-1],
    "zeros": lambda whole: bytes(len(whole)),
    "second half zeros": lambda whole: whole[: len(whole) // 2] + bytes(len(whole) - len(whole) // 2),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_library_is_made_anew(cache, damage):
    """In a process of its own: loading such a file may kill it."""
    plan()
    (made,) = cache.glob("*.so")
    whole = made.read_bytes()
    made.unlink()  # this process goes on with its own
    made.write_bytes(DAMAGE[damage](whole))
    process = another_process(cache.parents[1])
    out, err = process.communicate()
    assert process.returncode == 0, err
    assert float(out) == pytest.approx(0.5)
    (anew,) = cache.glob("*.so")
    assert anew.stat().st_size == len(whole)


def test_processes_may_compile_at_once(tmp_path):
    processes = [another_process(tmp_path) for _ in range(2)]
    for process in processes:
        out, err = process.communicate()
        assert process.returncode == 0, err
        assert float(out) == pytest.approx(0.5)
    assert [path.suffix for path in (tmp_path / "symgraph/kernels").iterdir()] == [".so"]


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o707], ids=oct)
def test_a_cache_that_others_can_write_to_is_not_used(cache, mode):
    cache.mkdir(parents=True)
    cache.chmod(mode)
    assert plan().actions["u"] == pytest.approx(0.5)
    assert not list(cache.iterdir())


def test_a_cache_that_cannot_be_made_is_done_without(cache):
    cache.parent.parent.mkdir(exist_ok=True)
    cache.parent.touch()  # a file where the folder should be
    assert plan().actions["u"] == pytest.approx(0.5)


def test_the_cache_is_private(cache):
    plan()
    assert cache.stat().st_mode & 0o077 == 0


def test_without_a_compiler_one_warning_and_the_interpreter(cache, monkeypatch):
    monkeypatch.setattr(toolchain.shutil, "which", lambda name: None)
    with pytest.warns(UserWarning, match=r"no C compiler found .*interpreter.*install") as caught:
        first = plan()
    assert len(caught) == 1
    assert first.actions["u"] == pytest.approx(0.5)
    assert plan(0.25).actions["u"] == pytest.approx(0.25)  # a second warning would be an error
    assert not cache.exists()


BROKEN = {
    "refuses": "#!/bin/sh\necho 'kernel.c:1: no room' >&2; exit 1\n",
    "writes nothing": "#!/bin/sh\nexit 0\n",
    "writes junk": """#!/bin/sh
        while [ $# -gt 1 ] && [ "$1" != -o ]; do shift; done
        if [ $# -gt 1 ]; then echo junk > "$2"; fi
    """,
    "is no program": "junk\n",
    "has no interpreter": "#!/nowhere/sh\n",
}


@pytest.mark.parametrize("how", BROKEN)
def test_a_broken_compiler_gives_a_warning_and_the_interpreter(cache, tmp_path, monkeypatch, how):
    compiler = tmp_path / "broken-cc"
    compiler.write_text(BROKEN[how])
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", str(compiler))
    toolchain._identity.cache_clear()
    with pytest.warns(UserWarning, match="interpreter") as caught:
        made = plan()
    assert made.actions["u"] == pytest.approx(0.5)
    (warning,) = caught
    assert "broken-cc" in str(warning.message)
    if how == "refuses":
        assert "no room" in str(warning.message)
    assert not list(cache.glob("*.so"))
