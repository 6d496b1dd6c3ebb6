"""solve: from an objective and a state to a plan, with any optimizer."""

import casadi as ca
import numpy as np
import pytest
from small_tasks import assert_close, fork, objective_of, over_box, refuses

import symgraph as sg

OPTIMIZERS = [sg.Lbfgs(), sg.Adadelta(), sg.Adadelta.paper(), sg.Ipopt()]
NAMES = ["Lbfgs", "Adadelta", "Adadelta.paper", "Ipopt"]
# The paper's queue may drop a start point before its turn, and its last iterate counts, not the best.
every_optimizer_but_the_papers = pytest.mark.parametrize(
    "optimizer", [OPTIMIZERS[i] for i in (0, 1, 3)], ids=NAMES[:2] + NAMES[3:]
)
every_optimizer = pytest.mark.parametrize("optimizer", OPTIMIZERS, ids=NAMES)

SLOTS = {
    "x": sg.State(unit="m"),
    "y": sg.State(),
    "angle": sg.Action(low=-2, high=2, unit="rad"),
    "push": sg.Action(2, low=[0, -1], high=[1, 1]),
    "tool": sg.Selection(["tip", "shake"]),
}


def task(compiled=False):
    """Tipping is worth 1 at angle = x and push = (0.5, 0.25), shaking 2 at angle = -x."""
    g = sg.Graph(SLOTS, "start")
    g.choose(
        "start",
        "tool",
        {
            "tip": ("end", lambda x, angle: {"y": 1 - (angle - x) ** 2}),
            "shake": ("end", lambda x, angle: {"y": 2 - (angle + x) ** 2}),
        },
    )
    g.reward("end", lambda y, push: y - (push[0] - 0.5) ** 2 - (push[1] - 0.25) ** 2)
    return objective_of(g, compiled)


STATE = {"x": 1.0}


@pytest.fixture(scope="module")
def objective():
    return task()


def given(**options):
    return lambda o: sg.solve(o, STATE, **options)


REFUSED = {
    "no objective": (lambda o: sg.solve(o.tree, STATE), ["takes an Objective, got Tree", "Objective(unroll(graph))"]),
    "optimizer's class": (given(optimizer=sg.Lbfgs), ["optimizer is", "Lbfgs()", "parentheses"]),
    "optimizer's name": (given(optimizer="ipopt"), ["optimizer is 'ipopt'"]),
    "state": (lambda o: sg.solve(o, {}), ["state 'x' is missing"]),
    "seed": (given(seed=-1), ["seed = -1", "at least 0"]),
    "seed of words": (given(seed="today"), ["seed = 'today'"]),
    "seed of a fraction": (given(seed=1.5), ["seed = 1.5", "whole number"]),
    "seed of truth": (given(seed=True), ["seed = True"]),
    # fixed
    "fixed": (given(fixed=["angle"]), ["fixed is ['angle']", "{label: value}"]),
    "fixed misspelt": (
        given(fixed={"angel": 1}),
        ["fixed: 'angel' is no action or selection", "did you mean 'angle'?", "'angle', 'push', 'tool'"],
    ),
    "fixed state": (given(fixed={"x": 1}), ["fixed: 'x' is a state", "give it in the state"]),
    "fixed choice": (
        given(fixed={"tool": "shaek"}),
        ["selection 'tool'", "'shaek' is not a choice", "did you mean 'shake'?", "Choices: 'tip', 'shake'"],
    ),
    "fixed one-hot": (given(fixed={"tool": np.array([1, 0])}), ["selection 'tool'", "is not a choice"]),
    "fixed size": (given(fixed={"push": 1}), ["fixed action 'push' has 1 elements", "has 2"]),
    "fixed nan": (given(fixed={"angle": float("nan")}), ["fixed action 'angle' = nan is not finite"]),
    "fixed words": (given(fixed={"angle": "left"}), ["fixed action 'angle' = 'left' is not a number"]),
    # guess
    "guess": (given(guess="left"), ["guess is 'left'", "a plan, {label: value}, or a list"]),
    "guesses": (given(guess=[{"angle": 1}, 3]), ["guess is [{'angle': 1}, 3]"]),
    "guess misspelt": (given(guess={"angel": 1}), ["guess: 'angel' is no action", "did you mean 'angle'?"]),
    "guess in a list": (given(guess=[{}, {"tol": "tip"}]), ["guess: 'tol'", "did you mean 'tool'?"]),
    "guess state": (given(guess={"x": 1}), ["guess: 'x' is a state"]),
    "guess choice": (given(guess={"tool": "tipp"}), ["selection 'tool'", "'tipp'", "did you mean 'tip'?"]),
    "guess size": (given(guess={"push": [1, 2, 3]}), ["guess for action 'push' has 3 elements"]),
    "guess nan": (given(guess={"angle": float("nan")}), ["guess for action 'angle' = nan is not finite"]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(objective, case):
    call, words = REFUSED[case]
    refuses(lambda: call(objective), sg.InputError, *words)


@every_optimizer
def test_the_best_selection_and_actions(objective, optimizer):
    plan = sg.solve(objective, STATE, optimizer)
    tolerance = 0.05 if optimizer == sg.Adadelta.paper() else 1e-6
    assert plan.selections == {"tool": "shake"}
    assert plan.actions["angle"] == pytest.approx(-1, abs=tolerance)
    np.testing.assert_allclose(plan.actions["push"], [0.5, 0.25], atol=tolerance)
    assert type(plan.actions["angle"]) is float
    assert plan.actions["push"].shape == (2,)
    assert plan.value == objective.value(STATE, plan.actions, plan.selections)
    assert plan.optimizer == type(optimizer).__name__


def test_compiled_and_interpreted_find_the_same(objective):
    plans = [sg.solve(o, STATE) for o in (objective, task(compiled=True))]
    assert plans[0].selections == plans[1].selections
    assert plans[0].value == pytest.approx(plans[1].value, abs=1e-9)


@every_optimizer
def test_same_seed_same_plan(objective, optimizer):
    first, second, other = [sg.solve(objective, STATE, optimizer, seed=seed).to_dict() for seed in (7, 7, 8)]
    assert first | {"seconds": 0} == second | {"seconds": 0}
    assert first["runs"] != other["runs"]


def test_seeds_may_be_numpys_and_random_numbers_elsewhere_do_not_count(objective):
    np.random.seed(0)  # noqa: NPY002  # on purpose
    first = sg.solve(objective, STATE, seed=np.int64(3))
    np.random.seed(1)  # noqa: NPY002
    second = sg.solve(objective, STATE, seed=3)
    assert first.seed == second.seed == 3
    assert first.value == second.value


@every_optimizer
def test_fixed_actions_and_selections_are_held(objective, optimizer):
    plan = sg.solve(objective, STATE, optimizer, fixed={"tool": "tip", "push": [1.0, 0.0]})
    assert plan.selections == {"tool": "tip"}
    assert_close(plan.actions["push"], [1.0, 0.0])
    assert plan.actions["angle"] == pytest.approx(1, abs=0.05)
    assert {run.selections["tool"] for run in plan.runs} == {"tip"}
    assert all(tuple(run.start["push"]) == (1, 0) for run in plan.runs)


@every_optimizer
def test_everything_may_be_fixed(objective, optimizer):
    fixed = {"tool": "tip", "push": [1.0, 0.0], "angle": 0.5}
    plan = sg.solve(objective, STATE, optimizer, fixed=fixed)
    assert plan.value == objective.value(STATE, {"push": [1.0, 0.0], "angle": 0.5}, {"tool": "tip"})
    assert {run.outcome for run in plan.runs} == {"converged"}


def test_a_fixed_value_outside_the_bounds_is_taken_as_it_is(objective):
    assert sg.solve(objective, STATE, fixed={"angle": 9.0}).actions["angle"] == 9.0


@every_optimizer_but_the_papers
def test_guess_as_a_mapping_a_plan_and_a_list(objective, optimizer):
    start = {"angle": 0.3, "push": [0.2, 0.1], "tool": "tip"}
    plan = sg.solve(objective, STATE, optimizer, guess=start)
    for guess in (start, plan, [start, plan], (plan,)):
        again = sg.solve(objective, STATE, optimizer, guess=guess)
        first = start if guess is start or isinstance(guess, list) else {**plan.actions, **plan.selections}
        matching = [
            run
            for run in again.runs
            if run.start["angle"] == first["angle"] and run.selections["tool"] == first["tool"]
        ]
        assert matching
        assert_close(matching[0].start["push"], first["push"])


@every_optimizer_but_the_papers
def test_a_guess_may_leave_things_out(objective, optimizer):
    plan = sg.solve(objective, STATE, optimizer, guess={"angle": 0.3})
    assert any(run.start["angle"] == 0.3 for run in plan.runs)
    assert np.isfinite(plan.value)
    assert np.isfinite(sg.solve(objective, STATE, optimizer, guess={}).value)
    assert np.isfinite(sg.solve(objective, STATE, optimizer, guess=[]).value)


@every_optimizer_but_the_papers
def test_a_guess_outside_the_bounds_is_moved_inside(objective, optimizer):
    plan = sg.solve(objective, STATE, optimizer, guess={"angle": 99.0, "push": [-9, 9], "tool": "shake"})
    assert any(run.start["angle"] == 2 and tuple(run.start["push"]) == (0, 1) for run in plan.runs)


@every_optimizer
def test_fixed_comes_before_a_guess(objective, optimizer):
    guess = {"angle": 0.3, "push": [0.2, 0.1], "tool": "tip"}
    plan = sg.solve(objective, STATE, optimizer, guess=guess, fixed={"tool": "shake", "angle": -0.5})
    assert plan.selections == {"tool": "shake"}
    assert plan.actions["angle"] == -0.5


@every_optimizer_but_the_papers
def test_a_good_guess_is_not_lost(optimizer):
    """A needle that no sample finds."""
    needle = over_box(lambda u: ca.exp(-(((u - 0.123456) / 1e-5) ** 2)), 0.0, 1.0)
    plan = sg.solve(needle, {}, optimizer, guess={"u": 0.123456})
    assert plan.value == pytest.approx(1.0)


# Shapes of tasks


@every_optimizer
def test_without_actions(optimizer):
    g = sg.Graph({"way": sg.Selection(["a", "b", "c"])}, "n")
    g.reward("n", lambda way: 3 * way[1] + 2 * way[2])
    plan = sg.solve(objective_of(g), {}, optimizer)
    assert (plan.actions, plan.selections, plan.value) == ({}, {"way": "b"}, 3.0)


@every_optimizer
def test_without_selections_and_actions(optimizer):
    g = sg.Graph({"x": sg.State()}, "n")
    g.reward("n", lambda x: x**2)
    plan = sg.solve(objective_of(g), {"x": sg.Gaussian(2, 1)}, optimizer)
    assert (plan.actions, plan.selections, plan.value) == ({}, {}, 5.0)


@every_optimizer
def test_without_slots_and_rewards(optimizer):
    g = sg.Graph({}, "n")
    g.edge("n", "m")
    assert sg.solve(objective_of(g), {}, optimizer).value == 0.0


@every_optimizer
def test_low_equals_high(optimizer):
    plan = sg.solve(over_box(lambda u: -ca.sumsqr(u - 3), [2, -5], [2, 5]), {}, optimizer)
    np.testing.assert_allclose(plan.actions["u"], [2, 3], atol=1e-3)
    assert plan.actions["u"][0] == 2


@every_optimizer
def test_more_combinations_of_selections_than_starts(optimizer):
    slots = {f"s{i}": sg.Selection(["a", "b", "c"]) for i in range(40)}  # 1.2e19 combinations
    g = sg.Graph({**slots, "u": sg.Action(low=-1, high=1)}, "n")
    for label in slots:
        g.reward("n", sg.Model(lambda s, u: s[1] - (u - 0.5) ** 2, rename={"s": label}))
    plan = sg.solve(objective_of(g), {}, optimizer)
    chosen = list(plan.selections.values()).count("b")
    assert chosen >= 10
    assert plan.value == pytest.approx(chosen, abs=0.1)


@every_optimizer
def test_optimum_at_a_bound(optimizer):
    plan = sg.solve(over_box(lambda u: u[0] - ca.exp(u[1]), [-1, -2], [3, 4]), {}, optimizer)
    np.testing.assert_allclose(plan.actions["u"], [3, -2], atol=1e-6)
    assert (plan.actions["u"] <= [3, 4]).all()
    assert (plan.actions["u"] >= [-1, -2]).all()


@every_optimizer
def test_kinks(optimizer):
    plan = sg.solve(over_box(lambda u: -ca.fabs(u[0] - 1) - ca.fabs(u[1] + 0.5), [-3, -2], [2, 4]), {}, optimizer)
    rough = optimizer in (sg.Adadelta.paper(), sg.Ipopt())  # neither is made for kinks
    np.testing.assert_allclose(plan.actions["u"], [1, -0.5], atol=0.1 if rough else 1e-5)


@pytest.mark.parametrize("optimizer", OPTIMIZERS[:3], ids=NAMES[:3])  # IPOPT is for smooth functions
def test_unequal_kinks(optimizer):
    """A steep ridge across a gentle one stops methods for smooth functions before the top: within 2 % of the range."""
    objective = over_box(lambda u: -ca.fabs(u[0] - 1) - 2 * ca.fmax(u[1] + 0.5, -3 * (u[1] + 0.5)), [-3, -2], [2, 4])
    for seed in range(5):
        assert sg.solve(objective, {}, optimizer, seed=seed).value > -0.02 * 13


@every_optimizer
def test_regions_without_a_finite_value(optimizer):
    """Finite only where u0 > 1, three fifths of the box are not; the optimum is (4, 2)."""
    objective = over_box(lambda u: ca.log(u[0] - 1) - (u[0] - 1) / 3 - (u[1] - 2) ** 2, [-5, -5], [5, 5])
    plan = sg.solve(objective, {}, optimizer)
    np.testing.assert_allclose(plan.actions["u"], [4, 2], atol=0.05)
    assert np.isfinite(plan.value)


@every_optimizer
def test_an_optimum_at_the_edge_of_what_is_finite(optimizer):
    """-u sqrt(u) is NaN below 0 and largest at 0, which is never passed unharmed."""
    objective = over_box(lambda u: -u * ca.sqrt(u), -1.0, 1.0)
    plan = sg.solve(objective, {}, optimizer)
    assert np.isfinite(plan.value)
    assert plan.value == objective.value({}, plan.actions)


@pytest.mark.parametrize("compiled", [False, True], ids=["interpreted", "compiled"])
def test_the_climb_does_not_stop_before_what_is_not_finite(compiled):
    """-(sqrt(u) - 0.1)^2, NaN below 0: the top at 0.01 stands close to it."""
    objective = over_box(lambda u: -((ca.sqrt(u) - 0.1) ** 2), -1.0, 1.0, compiled=compiled)
    for seed in range(5):
        plan = sg.solve(objective, {}, seed=seed)
        assert plan.actions["u"] == pytest.approx(0.01, abs=1e-5)


# Nothing finite


@every_optimizer
def test_nothing_finite_names_path_slot_and_point(optimizer):
    objective = fork(lambda u: {"y": ca.sqrt(u - 5)}, lambda u: {"y": ca.log(u - 6)})
    refuses(
        lambda: sg.solve(objective, {}, optimizer),
        sg.SolveError,
        "no start point has a finite value",
        "'y' is Gaussian(nan",
        "on the path 'fork/end[",
        "actions {'u': ",
        "selections {'way': ",
    )


@every_optimizer
@pytest.mark.parametrize(
    ("reward", "number"),
    [(lambda u: ca.sqrt(u - 5), "nan"), (lambda u: -ca.exp(1e4 + u), "-inf"), (lambda u: ca.exp(1e4 + u), "inf")],
    ids=["nan", "-inf", "inf"],
)
def test_a_reward_that_is_never_finite(optimizer, reward, number):
    refuses(
        lambda: sg.solve(over_box(reward, -1.0, 1.0), {}, optimizer),
        sg.SolveError,
        f"the reward is {number} on the path 'here'",
        "actions {'u': ",
    )


def test_an_infinite_covariance_is_named():
    g = sg.Graph({"x": sg.State(), "u": sg.Action(low=0, high=1)}, "n")
    g.edge("n", "m", lambda x, u: {"x": x * ca.exp(800 + u)})
    g.reward("m", lambda x: -(x**2))
    refuses(lambda: sg.solve(objective_of(g), {"x": sg.Gaussian(0, 1)}), sg.SolveError, "'x' is", "'n/m'")


@every_optimizer
def test_a_gradient_that_is_never_finite(optimizer):
    """sqrt(max(0, u - 5)) is 0 over the whole box, but its slope there is 0 / 0: IPOPT alone keeps the start."""
    objective = over_box(lambda u: ca.sqrt(ca.fmax(0, u - 5)) + 1, -1.0, 1.0)
    assert np.isnan(objective.gradient({}, {"u": 0.5})["u"])
    if isinstance(optimizer, sg.Ipopt):
        assert sg.solve(objective, {}, optimizer).value == 1
    else:
        words = "no start point has a finite value or gradient", "actions {'u': ", "square roots and divisions at 0"
        refuses(lambda: sg.solve(objective, {}, optimizer), sg.SolveError, *words)


# Progress


@pytest.mark.parametrize("progress", [True, False])
def test_nothing_is_printed_where_nobody_looks(capfd, progress):
    sg.solve(task(), STATE, progress=progress)
    assert capfd.readouterr() == ("", "")


# Time


@pytest.mark.parametrize(
    "optimizer",
    [sg.Lbfgs(starts=10**4), sg.Adadelta(starts=10**4), sg.Ipopt(), sg.Enumerate(sg.Lbfgs(starts=10**4)), sg.Bonmin()],
    ids=lambda optimizer: type(optimizer).__name__,
)
def test_no_time_is_enough_for_a_plan(objective, optimizer):
    plan = sg.solve(objective, STATE, optimizer, time_limit=0)
    assert np.isfinite(plan.value)
    assert 1 <= len(plan.runs) < 10**4
    assert plan.value == pytest.approx(objective.value(STATE, plan.actions, plan.selections))


def test_when_time_is_over_the_best_so_far_is_returned(objective):
    full = sg.solve(objective, STATE)
    plan = sg.solve(objective, STATE, sg.Lbfgs(starts=10**6, samples=1), time_limit=0.3)
    assert plan.status.startswith("time limit: best of ")
    assert plan.value <= full.value + 1e-9
    assert sg.solve(objective, STATE, time_limit=60).status == full.status
    for wrong in (-1, float("nan"), "1", True):
        refuses(
            lambda wrong=wrong: sg.solve(objective, STATE, time_limit=wrong), sg.InputError, f"time_limit = {wrong!r}"
        )


def test_combinations_that_time_did_not_allow_are_told():
    slots = {"u": sg.Action(low=0, high=1)} | {f"s{k}": sg.Selection(["a", "b"]) for k in range(12)}
    graph = sg.Graph(slots, start="here")
    graph.reward("here", lambda u: -((u - 0.5) ** 2))
    plan = sg.solve(objective_of(graph), {}, sg.Enumerate(), time_limit=0)
    assert "of 4096 combinations of selections" in plan.status
