"""Kernels in C and in the interpreter: that they agree, and that points side by side do not matter to each other."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import casadi as ca
import numpy as np
import pytest
from random_tasks import random_problem, to_symgraph
from small_tasks import assert_close, fork, over_box

import symgraph as sg
from symgraph.compile import toolchain
from symgraph.compile.compiled import CompiledKernel
from symgraph.compile.interpreted import InterpretedKernel
from symgraph.compile.kernel import AdadeltaSteps


def wavy(u):
    """Curved, with several maxima."""
    return ca.sin(3 * u[0]) * ca.cos(2 * u[1]) - 0.1 * (u[0] - u[1]) ** 2 - 0.05 * u[2] ** 4


def rosenbrock(u):
    return -((1 - u[0]) ** 2) - 100 * (u[1] - u[0] ** 2) ** 2 - u[2] ** 2


def made(situation):
    """The same kernel, interpreted and compiled."""
    build = situation.build
    compiled = CompiledKernel(build.expectation.value_function(), toolchain.find_compiler())
    return InterpretedKernel(build.function), compiled


def kernels(objective, state=None, low=None, high=None, **options):
    """The same kernel, interpreted and compiled, bound to a state."""
    situation = objective.situation(state or {})
    bounds = objective.bounds
    low, high = bounds[0] if low is None else low, bounds[1] if high is None else high
    return [kernel.bind(situation.shared, np.array(low), np.array(high), **options) for kernel in made(situation)]


def steps_of(epsilon=1e-4, tolerance=0.0, oscillation=10, scaled=True, keep_best=True):
    return AdadeltaSteps(
        decay=0.9,
        epsilon=epsilon,
        tolerance=tolerance,
        oscillation=oscillation,
        scaled=scaled,
        keep_best=keep_best,
    )


NONE = np.zeros(0)


def climb(kernel, start, iterations, tolerance=1e-10, selection=NONE):
    """Where the climb from one start ended."""
    ((index, ended),) = kernel.climb(np.array([start]), selection[None], iterations, np.array([tolerance]))
    assert index == 0
    return ended


def ascend(kernel, start, limit, steps, scale=1.0):
    ((index, ended),) = kernel.ascend(np.array([start]), NONE[None], limit, steps, np.array([scale]))
    assert index == 0
    return ended


@pytest.fixture(scope="module")
def wavy_kernels():
    return kernels(over_box(wavy, [-2, -2, -2], [2, 1, 2]))


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


@pytest.mark.parametrize("threads", [1, 2])
def test_no_points(threads):
    objective = fork(lambda u: {"y": u}, lambda u: {"y": -u})
    for kernel in kernels(objective, threads=threads):
        values, gradients = kernel.evaluate(np.zeros((0, 1)), np.zeros((0, 2)))
        assert (values.shape, gradients.shape) == ((0,), (0, 1))
        assert not list(kernel.climb(np.zeros((0, 1)), np.zeros((0, 2)), 10, np.zeros(0)))
        assert not list(kernel.ascend(np.zeros((0, 1)), np.zeros((0, 2)), 10, steps_of(), np.zeros(0)))


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
    steps = steps_of(1e-2, 1e-14, 5, scaled, keep_best)
    interpreted, compiled = [ascend(k, point, 80, steps, scale) for k in wavy_kernels]
    assert compiled.outcome == interpreted.outcome
    # Rounding differs, and up and down the waves every step multiplies what differs.
    assert_close(compiled.history, interpreted.history, 1e-10)
    assert_close(compiled.point, interpreted.point, 1e-10)
    assert_close(compiled.value, interpreted.value, 1e-10)


def test_climbing_leads_to_the_same_optimum(wavy_kernels):
    for point in np.random.default_rng(1).uniform([-2, -2, -2], [2, 1, 2], (10, 3)):
        ends = [climb(kernel, point, 500) for kernel in wavy_kernels]
        for end in ends:  # each at a local maximum of the box: no way up remains
            _, gradient = wavy_kernels[0].evaluate(end.point[None], np.zeros((1, 0)))
            free = ((end.point < [2, 1, 2]) | (gradient[0] < 0)) & ((end.point > [-2, -2, -2]) | (gradient[0] > 0))
            assert np.abs(gradient[0] * free).max() < 1e-5
            assert_close(end.value, end.history.max(), 1e-14)
            assert end.outcome == "converged"
    for kernel in kernels(over_box(rosenbrock, [-2, -2, -2], [2, 2, 2])):
        end = climb(kernel, [-1.2, 1.0, 0.7], 500)
        np.testing.assert_allclose(end.point, [1, 1, 0], atol=1e-6)


def test_both_climb_to_bounds_and_hold_what_is_held():
    objective = over_box(lambda u: u[0] - u[1] - (u[2] - 3) ** 2, [-1, -1, -1], [2, 1, 1])
    for kernel in kernels(objective, low=[-1, -1, 0.5], high=[2, 1, 0.5]):
        end = climb(kernel, [0.0, 0.0, 0.5], 100)
        assert_close(end.point, [2, -1, 0.5])
        end = ascend(kernel, [0.0, 0.0, 0.5], 500, steps_of(epsilon=1e-2))
        assert_close(end.point, [2, -1, 0.5])


def test_both_stay_below_the_limit():
    for kernel in kernels(over_box(rosenbrock, [-2, -2, -2], [2, 2, 2])):
        for limit in (1, 2, 7):
            end = climb(kernel, [-1.2, 1.0, 0.7], limit)
            assert len(end.history) <= limit
            assert end.outcome == "iteration limit"
            end = ascend(kernel, [-1.2, 1.0, 0.7], limit, steps_of(oscillation=99))
            assert len(end.history) == limit + 1


def test_both_stop_where_nothing_is_finite():
    for kernel in kernels(over_box(lambda u: ca.sqrt(u), -1.0, 1.0)):
        for end in (climb(kernel, [-0.5], 100), ascend(kernel, [-0.5], 100, steps_of())):
            assert (end.value, end.outcome) == (-np.inf, "not finite")
            assert_close(end.point, [-0.5])
            assert end.history.tolist() == [-np.inf]


def test_both_keep_what_was_finite():
    """Maximise -sqrt(u - 0.1): the slope leads to where nothing is finite."""
    for kernel in kernels(over_box(lambda u: -ca.sqrt(u - 0.1), 0.0, 1.0)):
        end = climb(kernel, [0.6], 200)
        assert -np.sqrt(0.5) < end.value <= 0
        assert_close(end.value, -np.sqrt(end.point[0] - 0.1), 1e-9)
        end = ascend(kernel, [0.6], 2000, steps_of(epsilon=1e-2))
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
        assert climb(kernel, NONE, 10, selection=np.array([0.0, 1])).outcome == "converged"


def test_numbers_that_change_are_seen():
    """In other arrays, or in the same ones."""
    objective = over_box(lambda u, x: ca.sin(x[0]) * u, -1.0, 1.0, states={"x": sg.State(3)})
    situation = objective.situation({"x": np.zeros(3)})
    for kernel in made(situation):
        mean = np.array([0.1, 0.2, 0.3])
        shared = [mean, *situation.shared[1:]]
        for number in (0.1, 0.5, 0.9):
            mean[:] = number
            values, _ = kernel.bind(shared, *objective.bounds).evaluate(np.ones((2, 1)), np.zeros((2, 0)))
            assert_close(values, np.sin([number] * 2))


def test_a_kernel_can_be_sent_to_another_process(wavy_kernels):
    points = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    for kernel in wavy_kernels:
        there = pickle.loads(pickle.dumps(kernel))
        for got, expected in zip(
            there.evaluate(points, np.zeros((5, 0))), kernel.evaluate(points, np.zeros((5, 0))), strict=True
        ):
            np.testing.assert_array_equal(got, expected)
        a, b = climb(there, points[0], 100), climb(kernel, points[0], 100)
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


# Starts side by side


def ends_of(found):
    """{start: what became of it}, each handed out once."""
    found = list(found)
    ends = dict(found)
    assert len(ends) == len(found)
    return ends


def assert_same_ends(got, expected):
    assert sorted(got) == sorted(expected)
    for index, end in got.items():
        assert (end.value, end.outcome) == (expected[index].value, expected[index].outcome)
        np.testing.assert_array_equal(end.point, expected[index].point)
        np.testing.assert_array_equal(end.history, expected[index].history)


def bumps(u):
    return ca.sin(9 * u) - 0.1 * u**2


@pytest.fixture(scope="module", params=[1, 2], ids=["one thread", "two threads"])
def forked(request):
    """Interpreted and compiled kernels of two ways, one NaN in places, with 150 starts on both."""
    objective = fork(lambda u: {"y": bumps(u)}, lambda u: {"y": ca.log(u + 0.5) + ca.cos(7 * u)})
    rng = np.random.default_rng(0)
    hot = np.eye(2)[rng.integers(0, 2, 150)]
    return kernels(objective, threads=request.param), rng.uniform(-1, 1, (150, 1)), hot


def searches(kernel, starts, hot):
    tolerances = np.geomspace(1e-3, 1e-9, 150)[: len(starts)]
    yield ends_of(kernel.climb(starts, hot, 40, tolerances))
    for keep_best in (True, False):
        steps = steps_of(1e-2, 1e-6, keep_best=keep_best)
        yield ends_of(kernel.ascend(starts, hot, 30, steps, 1 + np.arange(len(starts)) % 3))


def test_each_start_has_its_own_end(forked):
    """150 starts side by side come to what each comes to alone, in both kernels."""
    (interpreted, compiled), starts, hot = forked
    for ends in searches(interpreted, starts, hot):
        assert sorted(ends) == list(range(150))
    for ends, alone in zip(searches(compiled, starts, hot), searches(interpreted, starts, hot), strict=True):
        assert sorted(ends) == list(range(150))
        same = [ends[p].outcome == alone[p].outcome and len(ends[p].history) == len(alone[p].history) for p in ends]
        assert np.mean(same) > 0.9  # rounding may move a last step
        for p in np.flatnonzero(same):
            assert_close(ends[p].value, alone[p].value, 1e-6)
        assert {end.outcome for end in ends.values()} >= {"converged", "not finite"}


@pytest.mark.parametrize("count", [1, 2, 3, 7, 8, 9, 63, 64, 65, 149])
def test_how_many_starts_there_are_does_not_matter(forked, count):
    (_, compiled), starts, hot = forked
    some, every = searches(compiled, starts[:count], hot[:count]), searches(compiled, starts, hot)
    for got, expected in zip(some, every, strict=True):
        assert_same_ends(got, {p: expected[p] for p in range(count)})


def test_threads_change_nothing(forked):
    (_, compiled), starts, hot = forked
    objective = fork(lambda u: {"y": bumps(u)}, lambda u: {"y": ca.log(u + 0.5) + ca.cos(7 * u)})
    _, other = kernels(objective, threads=3)
    for got, expected in zip(searches(other, starts, hot), searches(compiled, starts, hot), strict=True):
        assert_same_ends(got, expected)
    for got, expected in zip(other.evaluate(starts, hot), compiled.evaluate(starts, hot), strict=True):
        np.testing.assert_array_equal(got, expected)


def test_the_numbers_of_starts_are_those_given():
    """Whatever the order in which they are worked on: here of selections."""
    objective = fork(lambda u: {"y": -((u - 0.2) ** 2)}, lambda u: {"y": -((u + 0.4) ** 2)})
    hot = np.eye(2)[[1, 0, 1, 0, 0, 1]]
    starts = np.linspace(-1, 1, 6)[:, None]
    for kernel in kernels(objective):
        ends = ends_of(kernel.climb(starts, hot, 50, np.full(6, 1e-10)))
        np.testing.assert_allclose([ends[p].point[0] for p in range(6)], [-0.4, 0.2, -0.4, 0.2, 0.2, -0.4], atol=1e-6)
        for p in range(6):
            value, _ = kernel.evaluate(starts[p : p + 1], hot[p : p + 1])
            assert_close(ends[p].history[0], value[0])


def test_slow_starts_do_not_keep_others_waiting():
    """As soon as a place is free, another start takes it; what has ended is handed out while others go on."""
    _, compiled = kernels(over_box(lambda u: -(u**2), -1.0, 1.0))
    scales = np.full(200, 1e6)  # large tolerances: one step, but for the first start
    scales[0] = 1e-4
    found = list(compiled.ascend(np.full((200, 1), 0.5), np.zeros((200, 0)), 10**5, steps_of(1e-9, 1e-4), scales))
    assert sorted(p for p, _ in found) == list(range(200))
    index, slow = found[-1]
    assert index == 0
    assert len(slow.history) > 500
    assert {len(end.history) for p, end in found if p} == {2}


# Where rounding hides what is gained


@pytest.mark.parametrize("offset", [0.0, 1e6, 1e8])
@pytest.mark.parametrize("kind", ["kink", "smooth", "quadratic"])
@pytest.mark.parametrize("compiled", [True, False])
def test_a_climb_ends_at_the_best_that_it_met(compiled, kind, offset):
    """Steps whose gain rounding hides may lead down a little; what is handed out is the best, right to rounding."""
    c = np.array([0.3, -0.7, 0.1])
    shapes = {
        "kink": lambda u: -ca.sum1(ca.fabs(u - c)),
        "smooth": lambda u: -ca.sum1(ca.sqrt((u - c) ** 2 + 1e-6)),
        "quadratic": lambda u: -ca.sumsqr((u - c) * [1, 5, 20]),
    }
    objective = over_box(lambda u: offset + shapes[kind](u), np.full(3, -1), np.full(3, 1))
    kernel = kernels(objective)[compiled]
    starts = np.random.default_rng(2).uniform(-1, 1, (12, 3))
    best = objective.value({}, {"u": c})
    for _, ended in kernel.climb(starts, np.zeros((12, 0)), 500, np.full(12, 1e-9)):
        assert ended.value >= ended.history.max() - 4 * np.spacing(abs(offset) + 1)
        assert objective.value({}, {"u": ended.point}) >= best - 1e-8 - 30 * np.spacing(offset)
