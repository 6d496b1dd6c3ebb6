"""ADADELTA from a queue of start points: section II-D of Yamaguchi & Atkeson, Humanoids 2016, and what goes wrong."""

import dataclasses
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from small_tasks import assert_close, fork, over_box, refuses
from wrapped_kernels import InterruptedLater, Interrupting, wrap_kernels

import symgraph as sg
from symgraph.compile import compiled as compiled_module
from symgraph.compile.compiled import CompiledKernel
from symgraph.compile.interpreted import InterpretedKernel
from symgraph.compile.kernel import BoundKernel, Ended
from symgraph.optimizers.problem import Problem

NAN, INF = float("nan"), float("inf")


def bowl(u):
    return -ca.sumsqr(u - 0.3)


# Settings


@pytest.mark.parametrize("name", ["starts", "run_iterations", "oscillation", "total_iterations", "finished"])
@pytest.mark.parametrize("value", [0, -1, 1.5, "3", True], ids=repr)
def test_counts_are_positive_whole_numbers(name, value):
    refuses(lambda: sg.Adadelta(**{name: value}), sg.InputError, f"Adadelta: {name} = {value!r}", "positive whole")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[("decay", value) for value in (1.0, -0.1, NAN, "high", None)],
        *[("epsilon", value) for value in (0.0, -1e-6, NAN, INF, "small", None)],
        *[("tolerance", value) for value in (-1e-6, NAN, INF, "small", None)],
        *[("sampling", value) for value in ("sobol", None, ["spread"])],
    ],
    ids=str,
)
def test_numbers_are_within_their_limits(name, value):
    refuses(lambda: sg.Adadelta(**{name: value}), sg.InputError, f"Adadelta: {name} = {value!r}", "give")


def test_settings_of_the_paper():
    paper = sg.Adadelta.paper()
    assert (paper.starts, paper.start_per_selection) == (20, True)
    assert (paper.finished, paper.total_iterations, paper.run_iterations) == (20, 2000, 50)
    assert (paper.tolerance, paper.oscillation) == (1e-6, 10)
    assert (paper.decay, paper.epsilon, paper.scaled) == (0.98, 1e-6, False)
    assert (paper.sampling, paper.evenly) == ("uniform", False)
    assert (paper.requeue, paper.keep_best, paper.polish) == (True, False, False)


def test_paper_adds_a_start_for_each_selection():
    objective = fork(lambda u: {"y": u}, lambda u: {"y": -u})
    settings = dataclasses.replace(sg.Adadelta.paper(), requeue=False, finished=1000)
    assert sg.solve(objective, {}, settings).status == "best of 21 starts"


# One run


BARE = sg.Adadelta(starts=1, scaled=False, keep_best=False, polish=False, tolerance=0.0, sampling="uniform")


def only_run(objective, guess, **settings):
    """The run from a guess, which stands before all drawn starts."""
    plan = sg.solve(objective, {}, dataclasses.replace(BARE, **settings), guess={"u": guess})
    return plan.runs[0]


def by_hand(gradient, x, low, high, decay, epsilon, steps):
    """Zeiler's algorithm 1, written down once more; the sign is that of ascent."""
    x = np.array(x, dtype=float)
    squares, updates, path = np.zeros_like(x), np.zeros_like(x), [x.copy()]
    for _ in range(steps):
        g = gradient(x)
        squares = decay * squares + (1 - decay) * g**2
        delta = np.sqrt(updates + epsilon) / np.sqrt(squares + epsilon) * g
        updates = decay * updates + (1 - decay) * delta**2
        x = np.clip(x + delta, low, high)
        path.append(x.copy())
    return np.array(path)


@pytest.mark.parametrize(("decay", "epsilon"), [(0.98, 1e-6), (0.9, 1e-4), (0.5, 1e-2)])
def test_steps_are_zeilers(decay, epsilon):
    low, high, start = np.array([-1, -2.0]), np.array([1, 2.0]), [0.9, -1.5]
    objective = over_box(lambda u: -((u[0] - 0.3) ** 2) - 3 * u[1] ** 4, low, high)
    path = by_hand(lambda x: np.array([-2 * (x[0] - 0.3), -12 * x[1] ** 3]), start, low, high, decay, epsilon, 60)
    run = only_run(objective, start, decay=decay, epsilon=epsilon, run_iterations=60, oscillation=99)
    assert_close(run.history, [-((x - 0.3) ** 2) - 3 * y**4 for x, y in path])
    assert_close(run.actions["u"], path[-1])


def test_first_step_with_the_settings_of_the_paper_is_0_007_in_raw_units():
    """sqrt(epsilon / (1 - decay)), whatever the slope."""
    for slope in (3.0, -200.0):
        run = only_run(over_box(lambda u, k=slope: k * u, -5.0, 5.0), 1.0, decay=0.98, epsilon=1e-6, run_iterations=1)
        assert run.actions["u"] - 1 == pytest.approx(np.sign(slope) * np.sqrt(1e-6 / 0.02), rel=1e-3)


def test_scaled_steps_do_not_depend_on_the_unit():
    def path(unit):
        objective = over_box(lambda u: -((u / unit - 0.3) ** 2), -unit, unit)
        return only_run(objective, 0.8 * unit, scaled=True, run_iterations=30).history

    assert_close(path(1e-3), path(1.0), 1e-9)
    assert_close(path(1e3), path(1.0), 1e-9)


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_the_size_of_the_rewards_does_not_matter(factor):
    def path(k):
        return sg.solve(over_box(lambda u: -k * (u - 0.3) ** 2, -1.0, 1.0), {}, sg.Adadelta(polish=False)).runs[0]

    np.testing.assert_allclose(np.array(path(factor).history) / factor, path(1.0).history, rtol=1e-6, atol=1e-12)


def test_case_1_converged_where_a_step_gains_less_than_the_tolerance():
    run = only_run(over_box(bowl, 0.0, 1.0), 0.9, tolerance=1e-6, run_iterations=10_000)
    gains = np.diff(run.history)
    assert run.outcome == "converged"
    assert 0 <= gains[-1] < 1e-6
    assert not any(0 <= gain < 1e-6 for gain in gains[:-1])


def test_a_falling_step_is_not_converged():
    """Steps across a kink fall and rise by turns, however little."""
    run = only_run(over_box(lambda u: -ca.fabs(u), -1.0, 1.0), 1e-9, tolerance=1e-12, oscillation=7, epsilon=1e-4)
    assert run.outcome == "oscillation"


def test_case_2_iteration_limit():
    run = only_run(over_box(bowl, 0.0, 1.0), 0.9, run_iterations=17)
    assert (run.outcome, run.gradients) == ("iteration limit", 18)


@pytest.mark.parametrize("oscillation", [1, 4, 10])
def test_case_3_oscillation_counts_falling_steps_in_total(oscillation):
    objective = over_box(lambda u: -ca.fabs(u - 0.1), -1.0, 1.0)
    run = only_run(objective, 0.9, oscillation=oscillation, run_iterations=10_000, epsilon=1e-3)
    falls = np.diff(run.history) < 0
    assert run.outcome == "oscillation"
    assert falls.sum() == oscillation
    assert falls[-1]


def test_best_iterate_or_the_last():
    objective = over_box(lambda u: -ca.fabs(u - 0.1), -1.0, 1.0)
    for keep_best in (True, False):
        run = only_run(objective, 0.9, keep_best=keep_best, oscillation=3, run_iterations=10_000, epsilon=1e-3)
        assert run.value == (max(run.history) if keep_best else run.history[-1])
        assert run.value == objective.value({}, run.actions)
    assert run.value < max(run.history)


def test_points_are_clipped_to_the_bounds_after_each_step():
    objective = over_box(lambda u: 5 * u[0] - 3 * u[1], [-1, 0.25], [1, 0.75])
    run = only_run(objective, [0.99, 0.26], run_iterations=20, epsilon=1e-2, oscillation=99)
    assert_close(run.actions["u"], [1, 0.25])
    assert max(run.history) == run.history[-1] == 5 - 0.75


def test_nan_half_way_ends_the_run_and_keeps_what_was_found():
    """-sqrt(u - 0.1) rises towards 0.1, beyond which it is NaN."""
    objective = over_box(lambda u: -ca.sqrt(u - 0.1), 0.0, 1.0)
    settings = {"run_iterations": 5000, "epsilon": 1e-2}
    run = only_run(objective, 0.9, keep_best=True, **settings)
    assert run.outcome == "not finite"
    assert run.history[-1] == -np.inf
    assert run.value == max(run.history) == objective.value({}, run.actions)


def test_nan_half_way_with_the_papers_settings():
    """Where the last iterate is not finite, the last finite one counts."""
    objective = over_box(lambda u: -ca.sqrt(u - 0.1), 0.0, 1.0)
    plan = sg.solve(
        objective, {}, dataclasses.replace(sg.Adadelta.paper(), run_iterations=5000, total_iterations=10**6)
    )
    assert np.isfinite(plan.value)
    assert "not finite" in {run.outcome for run in plan.runs}


# The queue


class Scripted(BoundKernel):
    """Ends each run as the script says, and remembers where each began."""

    def __init__(self, script, steps=10):
        self.script, self.steps, self.began, self.limits = list(script), steps, [], []

    def evaluate(self, actions, selections):
        return actions[:, 0].copy(), np.ones_like(actions)

    def climb(self, *arguments):
        raise AssertionError("no polish was asked for")

    def ascend(self, starts, selections, limit, steps, scales):
        for p, start in enumerate(starts):
            self.began.append(start.copy())
            self.limits.append(limit)
            outcome, value = self.script.pop(0) if self.script else ("converged", 0.0)
            yield p, Ended(start + 0.001, value, outcome, np.zeros(min(limit, self.steps) + 1))


class Draws:
    """Random numbers of which the single ones in [0, 1) are given; others are real."""

    def __init__(self, single=(), seed=0):
        self._rng, self._single = np.random.default_rng(seed), list(single)

    def random(self, size=None):
        return self._rng.random(size) if size is not None else self._single.pop(0) if self._single else 0.0

    def __getattr__(self, name):
        return getattr(self._rng, name)


def problem_of(kernel, n=1, low=0.0, high=1.0, allowed=(), guesses=()):
    sizes = tuple(len(choices) for choices in allowed)
    return Problem(
        kernel, SimpleNamespace(), np.full(n, low), np.full(n, high), sizes, tuple(allowed), None, tuple(guesses)
    )


def search(kernel, draws=(), guesses=(), n=1, **settings):
    settings = {"starts": 3, "polish": False, **settings}
    given = [(np.atleast_1d(np.array(g, dtype=float)), np.zeros(0, dtype=np.int64)) for g in guesses]
    return sg.Adadelta(**settings).run(problem_of(kernel, n, guesses=given), Draws(draws))


def test_end_a_enough_finished_points():
    kernel = Scripted([("converged", 1.0)] * 9)
    assert len(search(kernel, starts=9, finished=4).runs) == 4


def test_end_b_the_queue_is_empty():
    kernel = Scripted([("converged", 1.0)] * 5)
    assert len(search(kernel, starts=5, finished=50).runs) == 5


def test_end_c_the_total_number_of_iterations():
    kernel = Scripted([("iteration limit", -1.0)] * 99)
    found = search(kernel, starts=5, requeue=True, run_iterations=10, total_iterations=35, finished=50)
    assert kernel.limits == [10, 10, 10, 5]
    assert sum(len(run.history) - 1 for run in found.runs) == 35


def test_cases_2_and_3_are_finished_only_when_better_than_the_best():
    """Counted by how many runs it takes to finish three."""
    for outcome in ("iteration limit", "oscillation"):
        script = [
            (outcome, 1.0),
            (outcome, 0.5),
            (outcome, 1.0),
            (outcome, 2.0),
            ("converged", 0.0),
            ("converged", 0.0),
        ]
        assert len(search(Scripted(script), starts=6, finished=3).runs) == 5


def test_dead_and_not_finite_points_are_neither_finished_nor_requeued():
    script = [("not finite", 5.0)] * 3
    found = search(Scripted(script), starts=3, requeue=True, finished=1)
    assert len(found.runs) == 3


def test_without_requeue_points_wait_in_turn_guesses_first():
    kernel = Scripted([("converged", 1.0)] * 5)
    found = search(kernel, starts=3, guesses=[0.7, 0.2])
    assert_close(np.ravel(kernel.began)[:2], [0.7, 0.2])
    assert len(kernel.began) == 5
    assert found.status == "best of 5 starts"


@pytest.mark.parametrize("outcome", ["converged", "iteration limit", "oscillation"])
def test_with_requeue_a_point_goes_on_from_where_it_ended(outcome):
    kernel = Scripted([(outcome, 1.0)] * 3)
    found = search(kernel, draws=[0.1] * 3, starts=1, requeue=True, finished=99, total_iterations=30)
    assert_close(np.diff(np.ravel(kernel.began)), [0.001, 0.001])
    assert all(run.start == found.runs[0].start for run in found.runs)


def test_the_best_waiting_point_comes_first_with_probability_0_4():
    kernel = Scripted([("converged", -1.0)] * 3)
    search(kernel, draws=[0.39, 0.0, 0.2], guesses=[0.2, 0.9, 0.5], starts=1, requeue=True, finished=3)
    assert kernel.began[0] >= 0.9  # unless the start that was drawn is better still


def test_a_random_waiting_point_comes_with_probability_0_3():
    """Which ones come first over many seeds: each about as often."""
    first = []
    for seed in range(200):
        kernel = Scripted([("converged", 1.0)])
        given = [(np.array([g]), np.zeros(0, dtype=np.int64)) for g in (0.2, 0.9, 0.5)]
        rng = Draws([0.5, np.random.default_rng(seed).random()])
        sg.Adadelta(starts=1, polish=False, requeue=True, finished=1).run(problem_of(kernel, guesses=given), rng)
        first.append(float(kernel.began[0][0]))
    counts = [first.count(g) for g in (0.2, 0.9, 0.5)]
    assert all(30 <= count <= 70 for count in counts)  # 50 each, within 3 sd


def test_else_the_worst_is_dropped_for_a_perturbed_copy_of_the_best_finished():
    """Restart noise: sd 0.001 of the range per dimension, clipped to the bounds."""
    n = 2000
    kernel = Scripted([("converged", 7.0), ("converged", 8.0)])
    guesses = [np.full(n, 0.9), np.full(n, 0.2), np.full(n, 0.4)]
    given = [(g, np.zeros(0, dtype=np.int64)) for g in guesses]
    found = sg.Adadelta(starts=1, polish=False, requeue=True, finished=3, total_iterations=30).run(
        dataclasses.replace(problem_of(kernel, n, guesses=given), low=np.full(n, 0.0), high=np.full(n, 2.0)),
        Draws([0.1, 0.8, 0.99]),
    )
    assert len(found.runs) == 3
    best = found.runs[0].point
    noise = kernel.began[1] - best
    assert abs(noise.mean()) < 4 * 0.002 / np.sqrt(n)
    assert noise.std() == pytest.approx(0.002, rel=0.1)
    assert np.abs(kernel.began[2] - found.runs[1].point).max() < 0.002 * 5  # around the new best


def test_restart_noise_is_clipped_to_the_bounds():
    class Upwards(Scripted):
        def ascend(self, starts, *rest):
            return ((p, dataclasses.replace(ended, point=np.ones(50))) for p, ended in super().ascend(starts, *rest))

    kernel = Upwards([("converged", 7.0), ("converged", 7.0)])
    given = [(np.full(50, 0.5), np.zeros(0, dtype=np.int64))]
    optimizer = sg.Adadelta(starts=2, polish=False, requeue=True, finished=2)
    optimizer.run(problem_of(kernel, 50, guesses=given), Draws([0.1, 0.8]))
    assert kernel.began[1].max() == 1.0
    assert kernel.began[1].min() < 1.0


def test_before_anything_is_finished_a_random_point_comes_instead():
    kernel = Scripted([("converged", 1.0)])
    found = search(kernel, draws=[0.99], starts=3, requeue=True, finished=1)
    assert len(found.runs) == 1


def test_selections_do_not_change_during_a_run_and_are_spread_evenly():
    objective = fork(lambda u: {"y": -((u - 0.2) ** 2)}, lambda u: {"y": 1 - (u + 0.4) ** 2})
    plan = sg.solve(objective, {}, sg.Adadelta(starts=10, polish=False))
    ways = [run.selections["way"] for run in plan.runs]
    assert (ways.count("left"), ways.count("right")) == (5, 5)
    assert plan.selections == {"way": "right"}
    assert plan.actions["u"] == pytest.approx(-0.4, abs=1e-3)


@pytest.mark.parametrize("sampling", ["spread", "uniform", "gaussian"])
def test_starts_lie_within_the_bounds(sampling):
    objective = over_box(bowl, [-1, 10], [1, 30])
    plan = sg.solve(objective, {}, sg.Adadelta(starts=200, sampling=sampling, run_iterations=1, polish=False))
    starts = np.array([run.start["u"] for run in plan.runs])
    unit = (starts - [-1, 10]) / [2, 20]
    assert unit.min() >= 0
    assert unit.max() <= 1
    expected_sd = 0.25 if sampling == "gaussian" else 1 / np.sqrt(12)
    np.testing.assert_allclose(unit.std(axis=0), expected_sd, rtol=0.15)
    if sampling == "spread":  # one in each two-hundredth
        assert (np.sort(np.floor(unit * 200), axis=0) == np.arange(200)[:, None]).all()


def test_polish_leads_to_the_top():
    objective = over_box(bowl, [0, 0], [1, 1])
    rough = sg.solve(objective, {}, sg.Adadelta(starts=4, run_iterations=5, polish=False))
    fine = sg.solve(objective, {}, sg.Adadelta(starts=4, run_iterations=5))
    assert rough.value < -1e-6
    assert fine.value > -1e-15
    assert len(fine.runs) == 4 + 2


# Seeds and threads

WAVES = (lambda u: {"y": ca.sin(5 * u)}, lambda u: {"y": 1.5 * ca.cos(3 * u + 1)})
SETTINGS = {"default": sg.Adadelta(starts=150), "paper": sg.Adadelta.paper()}


@pytest.mark.parametrize("settings", SETTINGS)
def test_threads_give_the_same_plan(settings):
    objective = fork(*WAVES, compiled=True)
    one, two = (sg.solve(objective, {}, SETTINGS[settings], seed=3, threads=k).to_dict() for k in (1, 2))
    assert one | {"seconds": 0} == two | {"seconds": 0}


@pytest.mark.parametrize("settings", SETTINGS)
def test_the_same_seed_gives_the_same_plan_however_fast_the_machine_is(settings, monkeypatch):
    """Compiled searches hand out what has ended in slices of time, whatever that is."""
    objective = fork(*WAVES, compiled=True)
    plans = []
    for seconds in (1e-7, 1e-4, 10.0):
        monkeypatch.setattr(compiled_module, "SLICE", seconds)
        plans.append(sg.solve(objective, {}, SETTINGS[settings], seed=5).to_dict() | {"seconds": 0})
    assert plans[0] == plans[1] == plans[2]
    assert plans[0]["value"] == pytest.approx(1.5, abs=1e-3)


# Ctrl-C


@pytest.mark.parametrize("settings", [{}, {"polish": False}, {"requeue": True}], ids=str)
def test_ctrl_c_keeps_the_finished_runs(monkeypatch, settings):
    wrap_kernels(monkeypatch, InterpretedKernel, lambda kernel: Interrupting(kernel, "ascend", 6))
    objective = over_box(bowl, 0.0, 1.0)
    plan = sg.solve(objective, {}, sg.Adadelta(**settings))
    assert len(plan.runs) == 5
    assert plan.status.startswith("interrupted")
    assert plan.value == pytest.approx(max(run.value for run in plan.runs), rel=1e-12)  # the first of equals


def test_ctrl_c_in_the_polish_keeps_all_runs(monkeypatch):
    wrap_kernels(monkeypatch, InterpretedKernel, lambda kernel: Interrupting(kernel, "climb", 2))
    plan = sg.solve(over_box(bowl, 0.0, 1.0), {}, sg.Adadelta(starts=5))
    assert len(plan.runs) == 5 + 1
    assert plan.status.startswith("interrupted")


def test_ctrl_c_before_anything_is_finished_is_ctrl_c(monkeypatch):
    wrap_kernels(monkeypatch, InterpretedKernel, lambda kernel: Interrupting(kernel, "ascend", 1))
    with pytest.raises(KeyboardInterrupt):
        sg.solve(over_box(bowl, 0.0, 1.0), {}, sg.Adadelta())


@pytest.mark.parametrize("threads", [1, 2])
def test_ctrl_c_in_compiled_code_keeps_the_finished_runs(monkeypatch, threads):
    wrap_kernels(monkeypatch, CompiledKernel, lambda kernel: InterruptedLater(kernel, "ascend", 0.3))
    objective = over_box(lambda u: -sum(ca.fabs(u - 0.001 * k) for k in range(1000)), -1.0, 1.0, compiled=True)
    optimizer = sg.Adadelta(starts=6000, run_iterations=500, oscillation=500, tolerance=0.0, sampling="uniform")
    plan = sg.solve(objective, {}, optimizer, threads=threads)
    assert 1 <= len(plan.runs) < 6000
    assert plan.status.startswith("interrupted")
    assert plan.value == pytest.approx(max(run.value for run in plan.runs), rel=1e-12)  # the first of equals


def test_everything_not_finite_with_selections():
    objective = fork(lambda u: {"y": ca.sqrt(u - 5)}, lambda u: {"y": ca.sqrt(u - 6)})
    for optimizer in (sg.Adadelta(), sg.Adadelta(polish=False), sg.Adadelta.paper()):
        refuses(lambda o=optimizer: sg.solve(objective, {}, o), sg.SolveError, "'y'", "'fork/end[")
