"""Searches that are stopped, interrupted or left: they end soon, keep what they have, and do no harm."""

import os
import pickle
import signal
import threading
import time

import casadi as ca
import numpy as np
import pytest
from small_tasks import over_box
from wrapped_kernels import ctrl_c_after

from symgraph.compile import toolchain
from symgraph.compile.compiled import CompiledKernel
from symgraph.compile.crew import Crew
from symgraph.compile.interpreted import InterpretedKernel
from symgraph.compile.kernel import AdadeltaSteps, Stop

KINDS = ["interpreted", "compiled", "compiled for two threads"]
STEPS = AdadeltaSteps(decay=0.9, epsilon=1e-4, tolerance=0.0, oscillation=10, scaled=True, keep_best=True)
MANY = 60_000


def rosenbrock(u):
    return -((1 - u[0]) ** 2) - 100 * (u[1] - u[0] ** 2) ** 2 - u[2] ** 2


def bound(kind, function=rosenbrock, size=3):
    """A kernel with a stop, and that stop."""
    objective = over_box(function, np.full(size, -2), np.full(size, 2))
    build, stop = objective.situation({}).build, Stop()
    if kind == "interpreted":
        kernel = InterpretedKernel(build.function)
    else:
        kernel = CompiledKernel(build.expectation.value_function(), toolchain.find_compiler())
    shared = objective.situation({}).shared
    return kernel.bind(shared, *objective.bounds, stop, 2 if "two" in kind else 1), stop


def searches(kernel, starts, limit):
    hot, count = np.zeros((len(starts), 0)), len(starts)
    yield kernel.climb(starts, hot, limit, np.zeros(count))
    yield kernel.ascend(starts, hot, limit - 1, STEPS, np.ones(count))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [1, 3, 150])
def test_a_stop_ends_everything_after_one_gradient(kind, count):
    kernel, stop = bound(kind)
    starts = np.tile([-1.2, 1.0, 0.7], (count, 1))
    assert all(len(end.history) > 10 for found in searches(kernel, starts, 50) for _, end in found)
    stop.set()
    for found in searches(kernel, starts, 50):
        found = list(found)
        assert 1 <= len(found) <= count
        for index, ended in found:
            assert ended.outcome == "time limit"
            assert len(ended.history) == 1
            assert ended.value == ended.history[0]
            np.testing.assert_allclose(ended.point, starts[index], atol=1e-15)
    values, gradients = kernel.evaluate(starts, np.zeros((count, 0)))
    np.testing.assert_array_equal(np.isfinite(gradients).all(axis=1), np.isfinite(values))
    assert np.isfinite(values[0])
    if count == 150:
        assert np.isnan(values[-1])
    elsewhere = pickle.loads(pickle.dumps(kernel))  # another process has its own
    assert all(len(end.history) > 10 for found in searches(elsewhere, starts[:1], 50) for _, end in found)


def slow(u):
    return ca.sumsqr(ca.sin(ca.DM(range(1000)) * ca.sum1(u)))


def is_complete(ended):
    """Its value is one that it met."""
    return np.abs(ended.history - ended.value).min() <= 1e-12 * abs(ended.value)


@pytest.fixture(scope="module")
def starts():
    return np.random.default_rng(0).uniform(-2, 2, (MANY, 3))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("which", [0, 1], ids=["climb", "ascend"])
def test_a_stop_from_another_thread_ends_a_search_soon(kind, which, starts):
    kernel, stop = bound(kind, slow)
    timer = threading.Timer(0.3, stop.set)
    timer.start()
    begin = time.perf_counter()
    found = list([*searches(kernel, starts, 500)][which])
    timer.join()
    assert time.perf_counter() - begin < 3.0
    assert 1 <= len(found) < MANY
    assert kind == "interpreted" or "time limit" in {end.outcome for _, end in found}
    assert all(is_complete(end) for _, end in found)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("which", [0, 1], ids=["climb", "ascend"])
def test_ctrl_c_leaves_what_was_handed_out_and_a_kernel_that_works(kind, which, starts):
    kernel, _ = bound(kind, slow)
    expected = kernel.evaluate(starts[:500], np.zeros((500, 0)))
    kept = {}
    with pytest.raises(KeyboardInterrupt), ctrl_c_after(0.4):
        kept.update([*searches(kernel, starts, 500)][which])
    assert 1 <= len(kept) < MANY
    for index, ended in kept.items():
        assert ended.outcome != "time limit"
        assert is_complete(ended)
        if index < 500:
            assert ended.history[0] == pytest.approx(expected[0][index], rel=1e-9)
    for got, value in zip(kernel.evaluate(starts[:500], np.zeros((500, 0))), expected, strict=True):
        np.testing.assert_array_equal(got, value)


@pytest.mark.parametrize("kind", KINDS)
def test_a_search_may_be_left(kind, starts):
    kernel, _ = bound(kind, slow)
    for found in searches(kernel, starts, 500):
        next(found)
        found.close()
    again = [next(found) for found in searches(kernel, starts, 500)]
    assert all(is_complete(ended) for _, ended in again)


def test_ctrl_c_waits_for_the_other_threads():
    """They write to arrays that would be gone."""
    done = []

    def work(member, seconds):
        time.sleep(seconds)
        done.append(seconds)

    with pytest.raises(KeyboardInterrupt), ctrl_c_after(0.2):
        Crew(3, 1).work(work, [(0.0,), (1.0,), (1.1,)])
    assert done == [0.0, 1.0, 1.1]


def test_what_a_thread_raises_is_raised():
    def work(member, number):
        if number:
            raise ValueError(number)

    for place in range(3):
        with pytest.raises(ValueError, match="7"):
            Crew(3, 1).work(work, [(7 * (i == place),) for i in range(3)])


def test_a_forked_process_has_threads_of_its_own():
    """Those of its parent are not there."""
    kernel, _ = bound("compiled for two threads")
    points = np.random.default_rng(0).uniform(-2, 2, (100, 3))
    values, _ = kernel.evaluate(points, np.zeros((100, 0)))
    child = os.fork()
    if child == 0:
        signal.alarm(20)  # where it hangs
        again, _ = kernel.evaluate(points, np.zeros((100, 0)))
        os._exit(0 if (again == values).all() else 1)
    _, status = os.waitpid(child, 0)
    assert status == 0
