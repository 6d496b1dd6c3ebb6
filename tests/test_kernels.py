"""Kernels in C and in the interpreter: that they agree, and that the C ones are there when they can be."""

import os
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from random_tasks import random_problem, to_symgraph
from small_tasks import assert_close, fork, over_box

import symgraph as sg
from symgraph.compile import toolchain
from symgraph.compile.compiled import CompiledKernel
from symgraph.compile.interpreted import InterpretedKernel
from symgraph.compile.kernel import AdadeltaSteps, Stop

ROOT = Path(__file__).parents[1]


def wavy(u):
    """Curved, with several maxima."""
    return ca.sin(3 * u[0]) * ca.cos(2 * u[1]) - 0.1 * (u[0] - u[1]) ** 2 - 0.05 * u[2] ** 4


def rosenbrock(u):
    return -((1 - u[0]) ** 2) - 100 * (u[1] - u[0] ** 2) ** 2 - u[2] ** 2


def kernels(objective, state=None, low=None, high=None):
    """The same kernel, interpreted and compiled, bound to a state."""
    situation = objective.situation(state or {})
    bounds = objective.bounds
    low, high = bounds[0] if low is None else low, bounds[1] if high is None else high
    function = situation.build.function
    made = InterpretedKernel(function), CompiledKernel(function, toolchain.find_compiler())
    return [kernel.bind(situation.shared, np.array(low), np.array(high)) for kernel in made]


def steps_of(epsilon=1e-4, tolerance=0.0, scale=1.0, oscillation=10, scaled=True, keep_best=True):
    return AdadeltaSteps(
        decay=0.9,
        epsilon=epsilon,
        tolerance=tolerance,
        scale=scale,
        oscillation=oscillation,
        scaled=scaled,
        keep_best=keep_best,
    )


@pytest.fixture(scope="module")
def wavy_kernels():
    return kernels(over_box(wavy, [-2, -2, -2], [2, 1, 2]))


NONE = np.zeros(0)


@pytest.mark.parametrize("seed", [3, 40, 120])
def test_values_and_gradients_agree(seed):
    problem = random_problem(seed)
    graph, options, (state, _, selections) = to_symgraph(problem)
    objective = sg.Objective(sg.unroll(graph, **options))
    points = problem.point + 0.1 * np.random.default_rng(seed).normal(size=(9, problem.point.size))
    hot = np.tile(objective.one_hot(selections), (9, 1))
    (values, gradients), (c_values, c_gradients) = [k.evaluate(points, hot) for k in kernels(objective, state)]
    assert_close(c_values, values)
    assert_close(c_gradients, gradients)


def test_a_selection_per_point():
    objective = fork(lambda u: {"y": u}, lambda u: {"y": ca.sqrt(u - 5)})
    hot = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]])
    for kernel in kernels(objective):
        values, gradients = kernel.evaluate(np.array([[0.1], [0.2], [0.3]]), hot)
        assert_close(values[[0, 2]], [0.1, 0.3])
        assert_close(gradients[[0, 2], 0], [1, 1])
        assert np.isnan(values[1])


def test_arrays_of_any_layout(wavy_kernels):
    points = np.random.default_rng(0).uniform(-1, 1, (6, 6))
    for view in (points[:, ::2], np.asfortranarray(points[:, :3]), points[::2, :3].astype(np.float32)):
        expected = [float(ca.DM(ca.evalf(wavy(ca.DM(p.astype(float)))))) for p in view]
        for kernel in wavy_kernels:
            assert_close(kernel.evaluate(view, np.zeros((len(view), 0)))[0], expected)


@pytest.mark.parametrize("point", [[0.3, -0.4, 0.5], [-1.9, 0.9, 1.5], [1.2, 0.2, -1.0]], ids=str)
@pytest.mark.parametrize("scaled", [True, False], ids=["scaled", "raw"])
@pytest.mark.parametrize("keep_best", [True, False], ids=["best", "last"])
@pytest.mark.parametrize("scale", [1.0, 7.0])
def test_adadelta_takes_the_same_steps(wavy_kernels, point, scaled, keep_best, scale):
    steps = steps_of(1e-2, 1e-14, scale, 5, scaled, keep_best)
    interpreted, compiled = [k.ascend(np.array(point), NONE, 80, steps) for k in wavy_kernels]
    assert compiled.outcome == interpreted.outcome
    # Rounding differs, and up and down the waves every step multiplies what differs.
    assert_close(compiled.history, interpreted.history, 1e-10)
    assert_close(compiled.point, interpreted.point, 1e-10)
    assert_close(compiled.value, interpreted.value, 1e-10)


def test_climbing_leads_to_the_same_optimum(wavy_kernels):
    for point in np.random.default_rng(1).uniform([-2, -2, -2], [2, 1, 2], (10, 3)):
        ends = [kernel.climb(point, NONE, 500, 1e-10) for kernel in wavy_kernels]
        for end in ends:  # each at a local maximum of the box: no way up remains
            _, gradient = wavy_kernels[0].evaluate(end.point[None], np.zeros((1, 0)))
            free = ((end.point < [2, 1, 2]) | (gradient[0] < 0)) & ((end.point > [-2, -2, -2]) | (gradient[0] > 0))
            assert np.abs(gradient[0] * free).max() < 1e-5
            assert_close(end.value, end.history.max(), 1e-14)
            assert end.outcome == "converged"
    for kernel in kernels(over_box(rosenbrock, [-2, -2, -2], [2, 2, 2])):
        end = kernel.climb(np.array([-1.2, 1.0, 0.7]), NONE, 500, 1e-10)
        np.testing.assert_allclose(end.point, [1, 1, 0], atol=1e-6)


def test_both_climb_to_bounds_and_hold_what_is_held():
    objective = over_box(lambda u: u[0] - u[1] - (u[2] - 3) ** 2, [-1, -1, -1], [2, 1, 1])
    for kernel in kernels(objective, low=[-1, -1, 0.5], high=[2, 1, 0.5]):
        end = kernel.climb(np.array([0.0, 0.0, 0.5]), NONE, 100, 1e-10)
        assert_close(end.point, [2, -1, 0.5])
        end = kernel.ascend(np.array([0.0, 0.0, 0.5]), NONE, 500, steps_of(epsilon=1e-2))
        assert_close(end.point, [2, -1, 0.5])


def test_both_stay_below_the_limit():
    for kernel in kernels(over_box(rosenbrock, [-2, -2, -2], [2, 2, 2])):
        for limit in (1, 2, 7):
            end = kernel.climb(np.array([-1.2, 1.0, 0.7]), NONE, limit, 1e-10)
            assert len(end.history) <= limit
            assert end.outcome == "iteration limit"
            end = kernel.ascend(np.array([-1.2, 1.0, 0.7]), NONE, limit, steps_of(oscillation=99))
            assert len(end.history) == limit + 1


def test_both_stop_where_nothing_is_finite():
    for kernel in kernels(over_box(lambda u: ca.sqrt(u), -1.0, 1.0)):
        for end in (
            kernel.climb(np.array([-0.5]), NONE, 100, 1e-10),
            kernel.ascend(np.array([-0.5]), NONE, 100, steps_of()),
        ):
            assert (end.value, end.outcome) == (-np.inf, "not finite")
            assert_close(end.point, [-0.5])


def test_both_keep_what_was_finite():
    """Maximise -sqrt(u - 0.1): the slope leads to where nothing is finite."""
    for kernel in kernels(over_box(lambda u: -ca.sqrt(u - 0.1), 0.0, 1.0)):
        end = kernel.climb(np.array([0.6]), NONE, 200, 1e-10)
        assert -np.sqrt(0.5) < end.value <= 0
        assert_close(end.value, -np.sqrt(end.point[0] - 0.1), 1e-9)
        steps = steps_of(epsilon=1e-2)
        end = kernel.ascend(np.array([0.6]), NONE, 2000, steps)
        assert end.outcome == "not finite"
        assert end.history[-1] == -np.inf
        assert end.value == max(end.history) > -np.sqrt(0.5)


def test_without_actions():
    graph = sg.Graph({"way": sg.Selection(["left", "right"])}, "n")
    graph.reward("n", lambda way: way[1])
    for kernel in kernels(sg.Objective(sg.unroll(graph))):
        values, gradients = kernel.evaluate(np.zeros((2, 0)), np.array([[1.0, 0], [0, 1]]))
        assert_close(values, [0, 1])
        assert gradients.shape == (2, 0)
        assert kernel.climb(NONE, np.array([0.0, 1]), 10, 1e-9).outcome == "converged"


def test_a_kernel_can_be_sent_to_another_process(wavy_kernels):
    points = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    for kernel in wavy_kernels:
        there = pickle.loads(pickle.dumps(kernel))
        for got, expected in zip(
            there.evaluate(points, np.zeros((5, 0))), kernel.evaluate(points, np.zeros((5, 0))), strict=True
        ):
            np.testing.assert_array_equal(got, expected)
        a, b = there.climb(points[0], NONE, 100, 1e-9), kernel.climb(points[0], NONE, 100, 1e-9)
        np.testing.assert_array_equal(a.point, b.point)


@pytest.mark.parametrize("compiled", [False, True], ids=["interpreted", "compiled"])
def test_threads_do_not_disturb_each_other(compiled):
    points = np.random.default_rng(0).uniform(-2, 1, (400, 3))
    objective = over_box(wavy, [-2, -2, -2], [2, 1, 2], compiled=compiled)
    expected = [objective.value({}, {"u": point}) for point in points]
    with ThreadPoolExecutor(8) as pool:
        singly = list(pool.map(lambda point: objective.value({}, {"u": point}), points))
        blocks = list(pool.map(lambda block: objective.evaluate({}, block.T)[0], np.split(points, 20)))
    np.testing.assert_array_equal(singly, expected)
    assert_close(np.concatenate(blocks), expected)


# The compiler and its cache


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


def test_another_task_is_compiled_anew(cache, compilations):
    plan()
    sg.solve(over_box(lambda u: -(u**2), 0.0, 1.0, compiled=True), {})
    assert len(compilations) == 2


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
from test_kernels import plan
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


def test_a_stop_ends_everything_after_one_gradient():
    objective = over_box(rosenbrock, [-2, -2, -2], [2, 2, 2])
    situation = objective.situation({})
    function = situation.build.function
    start = np.array([-1.2, 1.0, 0.7])
    for kernel in (InterpretedKernel(function), CompiledKernel(function, toolchain.find_compiler())):
        stop = Stop()
        bound = kernel.bind(situation.shared, *objective.bounds, stop)
        assert len(bound.climb(start, NONE, 500, 1e-10).history) > 10
        stop.set()
        for ended in (bound.climb(start, NONE, 500, 1e-10), bound.ascend(start, NONE, 500, steps_of())):
            assert ended.outcome == "time limit"
            assert len(ended.history) == 1
            np.testing.assert_allclose(ended.point, start, atol=1e-15)
        values, gradients = bound.evaluate(np.array([start] * 3), np.zeros((3, 0)))
        assert np.isfinite(values).tolist() == [True, False, False]
        assert np.isfinite(gradients[0]).all()
        elsewhere = pickle.loads(pickle.dumps(bound))  # another process has its own
        assert len(elsewhere.climb(start, NONE, 500, 1e-10).history) > 10
