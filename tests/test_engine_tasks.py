"""Compiled gradients of whole tasks: against the interpreter and differences, and side by side with others."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from compiled_functions import assert_agrees, bound, compiled, function_of
from planning_tasks import MAKERS, points_of, task

ROOT = Path(__file__).parents[1]
every_task = pytest.mark.parametrize("name", MAKERS)
LONG = ("push", "pouring")  # they compile longer
long_ones_slow = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in LONG else name for name in MAKERS]
)
MOST = 70  # points, more than are evaluated side by side


def kernel_of(name, build="lanes", single=False, threads=1):
    objective, state = task(name)
    situation = objective.situation(state)
    kernel = compiled(situation.build.expectation.value_function(), build, single)
    return kernel.bind(situation.shared, *objective.bounds, threads=threads)


def interpreted(name, points, selections):
    objective, state = task(name)
    situation = objective.situation(state)
    results = [situation.build.interpreted([u, s, *situation.shared]) for u, s in zip(points, selections, strict=True)]
    return np.array([float(value[0]) for value, _ in results]), np.array([gradient for _, gradient in results])


def assert_as_interpreted(name, build):
    points, selections = points_of(task(name)[0], 10)
    values, gradients = kernel_of(name, build).evaluate(points, selections)
    wanted = interpreted(name, points, selections)
    for value, gradient, one, other in zip(values, gradients, *wanted, strict=True):  # values differ by far
        assert_agrees((value, gradient), (one, other), 1e-11)


@every_task
def test_as_in_the_interpreter(name):
    assert_as_interpreted(name, "lanes")


@long_ones_slow
def test_as_in_the_interpreter_one_at_a_time(name):
    assert_as_interpreted(name, "narrow")


@long_ones_slow
def test_in_single_precision(name):
    """To what is lost where values are differences of larger numbers."""
    points, selections = points_of(task(name)[0], 10)
    points = points.astype(np.float32).astype(float)
    values, gradients = kernel_of(name, single=True).evaluate(points, selections)
    wanted = interpreted(name, points, selections)
    np.testing.assert_allclose(values, wanted[0], rtol=1e-3, atol=1e-3)
    sizes = np.linalg.norm(wanted[1], axis=1)
    assert (np.linalg.norm(gradients - wanted[1], axis=1) < 1e-2 * (1 + sizes)).mean() > 0.8


@every_task
def test_gradients_are_slopes(name):
    """Of compiled values, by central differences."""
    objective, _ = task(name)
    kernel = kernel_of(name)
    points, selections = points_of(objective, 6, seed=1)
    low, high = objective.bounds
    steps = 1e-6 * (high - low)
    values, gradients = kernel.evaluate(points, selections)
    for i, step in enumerate(steps):
        ahead, behind = (
            kernel.evaluate(points + move, selections)[0] for move in np.eye(len(steps))[i] * [[step], [-step]]
        )
        # What rounding and the third derivative leave; values of far misses are large.
        slack = 1e-5 * (1 + np.abs(gradients[:, i])) + 1e-14 * np.abs(values) / step
        assert (np.abs((ahead - behind) / (2 * step) - gradients[:, i]) < 10 * slack).mean() > 0.8


@every_task
def test_second_derivatives_are_slopes_of_compiled_gradients(name):
    objective, state = task(name)
    kernel = kernel_of(name)
    points, selections = points_of(objective, 3, seed=2)
    low, high = objective.bounds
    steps = 1e-6 * (high - low)
    situation = objective.situation(state)
    for u, s in zip(points, selections, strict=True):
        (hessian,) = situation.build.hessian([u, s, *situation.shared])
        hessian = hessian.reshape(len(u), len(u))
        moved = np.concatenate([u + np.diag(steps), u - np.diag(steps)])
        _, gradients = kernel.evaluate(moved, np.tile(s, (len(moved), 1)))
        slopes = (gradients[: len(u)] - gradients[len(u) :]) / (2 * steps[:, None])
        np.testing.assert_allclose(slopes, hessian, rtol=1e-4, atol=1e-4 * (1 + np.abs(hessian).max()))


# Points side by side


@every_task
def test_how_many_points_there_are_does_not_matter(name):
    kernel = kernel_of(name)
    points, selections = points_of(task(name)[0], MOST, seed=3)
    values, gradients = kernel.evaluate(points, selections)
    for count in range(2, MOST, 3):
        some, slopes = kernel.evaluate(points[:count], selections[:count])
        np.testing.assert_array_equal(some, values[:count])
        np.testing.assert_array_equal(slopes, gradients[:count])
        some, slopes = kernel.evaluate(points[-count:], selections[-count:])
        np.testing.assert_array_equal(some, values[-count:])
        np.testing.assert_array_equal(slopes, gradients[-count:])
    for i in (0, 40):
        one, slope = kernel.evaluate(points[i : i + 1], selections[i : i + 1])
        assert_agrees((one, slope), (values[i : i + 1], gradients[i : i + 1]), 1e-11)


@every_task
def test_order_does_not_matter(name):
    kernel = kernel_of(name)
    points, selections = points_of(task(name)[0], MOST, seed=4)
    values, gradients = kernel.evaluate(points, selections)
    order = np.random.default_rng(0).permutation(MOST)
    some, slopes = kernel.evaluate(points[order], selections[order])
    np.testing.assert_array_equal(some, values[order])
    np.testing.assert_array_equal(slopes, gradients[order])


@every_task
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
def test_a_point_that_is_not_finite_leaves_others_alone(name, bad):
    kernel = kernel_of(name)
    points, selections = points_of(task(name)[0], 20, seed=5)
    values, gradients = kernel.evaluate(points, selections)
    spoiled = points.copy()
    spoiled[[0, 7, 13], 0] = bad
    others = np.setdiff1d(np.arange(20), [0, 7, 13])
    some, slopes = kernel.evaluate(spoiled, selections)
    np.testing.assert_array_equal(some[others], values[others])
    np.testing.assert_array_equal(slopes[others], gradients[others])
    if np.isnan(bad):
        assert np.isnan(some[[0, 7, 13]]).all()


def test_products_and_sums_keep_what_is_not_finite_to_its_point():
    """In every operation that goes over several numbers of a point."""

    def body(u, s, w, q):
        x = ca.reshape(ca.vertcat(u, ca.sin(u), u**2), 4, 3)
        y = w @ x
        z = ca.mac(x, q[:3], ca.cumsum(ca.sum2(y)[:4]))
        return ca.dot(y, y) + ca.norm_2(x[1:, ::2]) + ca.sum1(z) + ca.logsumexp(u) + ca.mmax(u) + ca.sumsqr(w.T @ y)

    rng = np.random.default_rng(0)
    kernel = bound(compiled(function_of(body, 4, 0, [(40, 4), (5, 1)])), [rng.normal(size=(40, 4)), rng.normal(size=5)])
    points, none = rng.normal(size=(MOST, 4)), np.zeros((MOST, 0))
    values, gradients = kernel.evaluate(points, none)
    assert np.isfinite(gradients).all()
    for bad in (np.nan, np.inf, 1e300):
        for i in range(4):
            spoiled = points.copy()
            spoiled[3::5, i] = bad
            some, slopes = kernel.evaluate(spoiled, none)
            good = np.arange(MOST) % 5 != 3
            np.testing.assert_array_equal(some[good], values[good])
            np.testing.assert_array_equal(slopes[good], gradients[good])
            assert not np.isfinite(some[~good]).any()


# Threads


@pytest.mark.parametrize("name", ["push", "pouring", "random 120"])
def test_kernels_of_one_library_in_threads(name):
    """Each with inputs of its own, all at once."""
    objective, state = task(name)
    situation = objective.situation(state)
    kernel = compiled(situation.build.expectation.value_function())
    points, selections = points_of(objective, 300, seed=6)

    def work(k):
        shared = [column * (1 + 0.01 * k) for column in situation.shared]
        one = kernel.bind(shared, *objective.bounds)
        for _ in range(3):
            results = one.evaluate(points, selections)
        ends = dict(one.climb(points[:20], selections[:20], 30, np.full(20, 1e-9)))
        return [*results, *(ends[p].history for p in range(20))]

    alone = [work(k) for k in range(4)]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(work, range(4)))
    for got, wanted in zip(together, alone, strict=True):
        for a, b in zip(got, wanted, strict=True):
            np.testing.assert_array_equal(a, b)


@every_task
def test_threads_of_one_kernel(name):
    points, selections = points_of(task(name)[0], 101, seed=7)
    wanted = kernel_of(name).evaluate(points, selections)
    for threads in (2, 3):
        for got, one in zip(kernel_of(name, threads=threads).evaluate(points, selections), wanted, strict=True):
            np.testing.assert_array_equal(got, one)


# The process


MODE = """
import ctypes, sys
sys.path[:0] = [{root!r}, {root!r} + "/tests"]
import numpy as np

def mode():
    tiny = np.array([np.finfo(float).tiny, 5e-324])
    single = np.array([np.finfo(np.float32).tiny], dtype=np.float32)
    rounded = ctypes.CDLL(None).fegetround()
    return [x.tolist() for x in (tiny / 2 * 2, tiny / 4, single / 2, tiny[1:] * 1)], rounded

before = mode()
import test_engine_tasks
for threads in (1, 2):
    for build in ("lanes", "narrow"):
        kernel = test_engine_tasks.kernel_of("random 3", build, build == "lanes", threads)
        points, selections = test_engine_tasks.points_of(test_engine_tasks.task("random 3")[0], 100)
        kernel.evaluate(points, selections)
        list(kernel.climb(points, selections, 20, np.full(100, 1e-9)))
after = mode()
assert before == after, (before, after)
assert after[0][1][0] > 0 and after[0][2][0] > 0 and after[0][3] == [5e-324], after
"""


def test_arithmetic_of_the_process_stays_what_it_is():
    """Rounding, and numbers below the smallest normal one."""
    done = subprocess.run(
        [sys.executable, "-c", MODE.format(root=str(ROOT))], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
