"""The oracle against differences, closed forms and Monte Carlo; what the generator of tasks covers."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from oracle import Branch, Chance, Choose, Edge, Model, Reward, Slot, Task, propagate, value
from random_tasks import break_unselected, broken_matters, models_of, paths, problems, random_problem
from smooth_models import SHAPES, Smooth, Softmax

SEEDS = range(200)  # as in test_objective_random.py
SCALAR = Slot("state")
STEP = Slot("action", 1, np.array([-1.0]), np.array([1.0]))


def affine(matrix, offset=0.0, reads=None, writes=None) -> Smooth:
    matrix = np.atleast_2d(matrix).astype(float)
    m, n = matrix.shape
    offset = np.broadcast_to(offset, m).astype(float)
    return Smooth(reads or {"x": n}, writes or {"x": m}, ("affine",) * m, matrix, offset, np.zeros((m, n, n)))


def quadratic(matrix, slope=None, reads=None) -> Smooth:
    """The reward x'Qx + w.x."""
    matrix = np.atleast_2d(matrix).astype(float)
    n = len(matrix)
    weights = np.zeros((1, n)) if slope is None else np.atleast_2d(slope).astype(float)
    return Smooth(reads or {"x": n}, {"reward": 1}, ("affine",), weights, np.zeros(1), matrix[None])


def differences(function, x, step=1e-3):
    """Central differences, the direction last, with the h^2 term of their error extrapolated away."""

    def central(h):
        return np.stack([(function(x + h * e) - function(x - h * e)) / (2 * h) for e in np.eye(len(x))], axis=-1)

    return (4 * central(step / 2) - central(step)) / 3


@pytest.mark.parametrize("shape", [*SHAPES, "softmax"])
def test_hand_written_derivatives_equal_differences(shape):
    rng = np.random.default_rng(sum(map(ord, shape)))
    m, n = 3, 4
    weights, offsets = rng.normal(size=(m, n)), rng.normal(size=m)
    half = rng.normal(size=(m, n, n))
    if shape == "softmax":
        function = Softmax({"x": n}, {"a": 1, "b": 1, "c": 1}, weights, offsets)
    else:
        quadratics = half + half.transpose(0, 2, 1)
        function = Smooth({"x": n}, {"y": m}, (shape,) * m, weights, offsets, quadratics)
    x = 0.5 * rng.normal(size=n)
    _, jacobian, hessians = function.derivatives(x)
    # Rounding over the step is about 1e-12, what the extrapolation leaves of order h^4 is smaller.
    np.testing.assert_allclose(jacobian, differences(lambda x: function.derivatives(x)[0], x), atol=1e-10)
    np.testing.assert_allclose(hessians, differences(lambda x: function.derivatives(x)[1], x), atol=1e-10)


def test_softmax_sums_to_one_and_its_derivatives_to_zero():
    rng = np.random.default_rng(1)
    names = {"a": 1, "b": 1, "c": 1}
    p, jacobian, hessians = Softmax({"x": 2}, names, rng.normal(size=(3, 2)), rng.normal(size=3)).derivatives(
        rng.normal(size=2)
    )
    assert p.sum() == pytest.approx(1, abs=1e-15)
    np.testing.assert_allclose(jacobian.sum(axis=0), 0, atol=1e-15)
    np.testing.assert_allclose(hessians.sum(axis=0), 0, atol=1e-15)


# Propagation


@pytest.mark.parametrize(
    ("rule", "mean", "variance"),
    [
        ("mean", np.sin(0.4), 0.0),
        ("linear", np.sin(0.4), np.cos(0.4) ** 2 * 0.09),
        ("second-order", np.sin(0.4) - 0.5 * np.sin(0.4) * 0.09, np.cos(0.4) ** 2 * 0.09),
    ],
)
def test_each_rule_on_a_sine(rule, mean, variance):
    sine = Smooth({"x": 1}, {"x": 1}, ("sin",), np.eye(1), np.zeros(1), np.zeros((1, 1, 1)))
    model = Model(sine, propagation=rule, noise={"x": 0.01})
    ((got_mean, got_covariance),) = propagate(model, {"x": (np.array([0.4]), np.array([[0.09]]))}, "linear").values()
    np.testing.assert_allclose(got_mean, [mean], rtol=1e-15)
    np.testing.assert_allclose(got_covariance, [[variance + 0.01]], rtol=1e-15)


def test_slots_are_independent_and_two_names_of_one_slot_are_not():
    difference = quadratic([[1, -1], [-1, 1]], reads={"x": 1, "y": 1})  # (x - y)^2
    beliefs = {"a": (np.array([2.0]), np.array([[0.25]])), "b": (np.array([2.0]), np.array([[0.25]]))}

    def expectation(rename):
        ((mean, _),) = propagate(Model(difference, rename), beliefs, "second-order").values()
        return mean.item()

    assert expectation({"x": "a", "y": "b"}) == pytest.approx(0.5)
    assert expectation({"x": "a", "y": "a"}) == 0.0


def test_written_slots_keep_only_the_blocks_of_their_own():
    split = affine([[1, 0], [1, 0], [0, 1]], writes={"u": 2, "v": 1})
    covariance = np.array([[0.5, 0.2], [0.2, 0.3]])
    written = propagate(Model(split, {"v": "w"}), {"x": (np.array([1.0, 2.0]), covariance)}, "linear")
    assert written.keys() == {"u", "w"}
    np.testing.assert_array_equal(written["u"][1], np.full((2, 2), 0.5))
    np.testing.assert_array_equal(written["w"][1], [[0.3]])


# Recursion


@pytest.mark.parametrize("max_visits", [1, 2, 3, 7])
def test_a_loop_pays_at_each_visit_and_is_then_cut(max_visits):
    pay = Reward(Model(affine(1.0, reads={"x": 1}, writes={"reward": 1})))
    task = Task({"x": SCALAR}, {"here": (pay, Edge(Branch("here")))}, "here", max_visits, cut_value=-0.5)
    assert value(task, {"x": 2.0}, {}, {}) == pytest.approx(2.0 * max_visits - 0.5, rel=1e-15)


def test_visits_count_on_one_path_not_over_the_whole_tree():
    pay = Reward(Model(affine(1.0, reads={"x": 1}, writes={"reward": 1})))
    twice = (Edge(Branch("leaf")), Edge(Branch("leaf")))
    task = Task({"x": SCALAR}, {"root": twice, "leaf": (pay,)}, "root", max_visits=1, cut_value=100.0)
    assert value(task, {"x": 2.0}, {}, {}) == 4.0


def test_linear_gaussian_chain_equals_the_closed_form():
    """E[-x'Qx] = -m'Qm - tr(QS) with m <- Am + b and S <- ASA' + W."""
    rng = np.random.default_rng(3)
    a, b = 0.6 * rng.normal(size=(3, 3)), rng.normal(size=3)
    root = rng.normal(size=(4, 3, 3))
    q, w, s, _ = root @ root.transpose(0, 2, 1)
    m = rng.normal(size=3)
    step = Edge(Branch("here", Model(affine(a, b), noise={"x": w})))
    task = Task({"x": Slot("state", 3)}, {"here": (Reward(Model(quadratic(-q))), step)}, "here", max_visits=5)
    got = value(task, {"x": (m, s)}, {}, {})
    expected = 0.0
    for _ in range(5):
        expected -= m @ q @ m + np.trace(q @ s)
        m, s = a @ m + b, a @ s @ a.T + w
    assert got == pytest.approx(expected, rel=1e-13)


def test_monte_carlo_agrees_where_the_rules_are_exact():
    """With affine edges, quadratic rewards and probabilities of exact slots nothing is approximate."""
    rng = np.random.default_rng(11)
    a, b = np.array([[0.9, 0.3], [-0.2, 0.7]]), np.array([0.4, -0.3])
    w, s = np.array([[0.05, 0.02], [0.02, 0.08]]), np.array([[0.3, 0.1], [0.1, 0.2]])
    m, q, slope, c = (
        np.array([0.5, -1.0]),
        np.array([[1.0, 0.4], [0.4, 0.5]]),
        np.array([0.2, -0.7]),
        [1.5, -0.5],
    )
    action, cut_value, bonus = 0.6, 1.3, 0.8

    walk = Model(affine(np.c_[a, b], reads={"x": 2, "u": 1}), noise={"x": w})
    measure = Model(affine(c, reads={"x": 2}, writes={"z": 1}), noise={"z": 0.1})
    again = Model(Softmax({"u": 1}, {"again": 1, "stop": 1}, np.array([[1.0], [0.0]]), np.zeros(2)))
    groups = {
        "go": (
            Reward(Model(quadratic(-q, slope))),
            Chance({"again": Branch("go", walk), "stop": Branch("look", measure)}, again),
        ),
        "look": (
            Choose("pay", {"no": Branch("end"), "yes": Branch("paid")}),
            Chance({"good": Branch("paid"), "bad": Branch("end")}, {"good": 0.3, "bad": 0.7}),
        ),
        "paid": (Reward(Model(quadratic([[bonus]], reads={"z": 1}))),),
    }
    slots = {
        "x": Slot("state", 2),
        "z": SCALAR,
        "u": STEP,
        "pay": Slot("selection", 2, choices=("no", "yes")),
    }
    task = Task(slots, groups, "go", max_visits=3, cut_value=cut_value)
    got = value(task, {"x": (m, s)}, {"u": action}, {"pay": "yes"})

    count = 400_000
    x = rng.multivariate_normal(m, s, count)
    total, running = np.zeros(count), np.full(count, True)
    for visit in (1, 2, 3):
        total += running * (x @ slope - np.einsum("ni,ij,nj->n", x, q, x))
        stops = running & (rng.random(count) > 1 / (1 + np.exp(-action)))
        z = x @ c + np.sqrt(0.1) * rng.normal(size=count)
        total += stops * bonus * z**2 * (1 + (rng.random(count) < 0.3))
        running &= ~stops
        total += running * cut_value * (visit == 3)
        x = x @ a.T + b * action + rng.multivariate_normal([0, 0], w, count)
    assert abs(got - total.mean()) < 4 * total.std() / np.sqrt(count)
    assert total.std() / np.sqrt(count) < 0.01


@settings(max_examples=40)
@given(problems())
def test_an_identity_edge_before_the_start_changes_nothing(problem):
    task = problem.task
    groups = {**task.groups, "gate": (Edge(Branch(task.start)),)}
    gated = replace(problem, task=replace(task, groups=groups, start="gate"))
    assert gated.value_at(problem.point) == problem.value_at(problem.point)


@settings(max_examples=40)
@given(problems())
def test_the_cut_value_enters_linearly(problem):
    """J(c) = J(0) + c P, where P is the weight of the cut branches."""
    tasks = [replace(problem.task, cut_value=cut_value) for cut_value in (0.0, 1.0, 2.0)]
    values = [replace(problem, task=task).value_at(problem.point) for task in tasks]
    weight = values[1] - values[0]
    assert values[2] - values[1] == pytest.approx(weight, abs=1e-10)
    if not any(cut for _, _, cut in paths(problem.task)):
        assert weight == 0.0


# The generator


@settings(max_examples=20)
@given(problems(choice_matters=True))
def test_broken_models_in_unselected_branches_are_not_seen(problem):
    broken = break_unselected(problem)
    assert broken.value_at(problem.point) == problem.value_at(problem.point)
    assert broken_matters(broken)


def test_the_same_seed_gives_the_same_problem():
    first, second = random_problem(7), random_problem(7)
    assert first.task.groups.keys() == second.task.groups.keys()
    assert first.value_at(first.point) == second.value_at(second.point)


def test_the_seeds_cover_what_a_graph_can_be():
    seen = Counter(feature for seed in SEEDS for feature in features(random_problem(seed)))
    rare = {feature: count for feature, count in seen.items() if count < 15}
    assert not rare
    assert seen.keys() == FEATURES


FEATURES = {
    "cut branch",
    "node visited twice on a path",
    "side by side groups",
    "identity edge",
    "constant probability",
    "modelled probability",
    "choice of two",
    "choice of three",
    "label chosen at several nodes",
    "model reads a selection",
    "function used on several edges",
    "renamed read",
    "renamed write",
    "default propagation",
    "mean propagation",
    "linear propagation",
    "second-order propagation",
    "noise",
    "full covariance of a vector",
    "variance of a scalar",
    "exact state",
    "slot that first appears on an edge",
    "action nothing reads",
    "plan from a later node",
    "value for a cut",
}


def features(problem) -> set[str]:
    task, found = problem.task, set()
    everywhere = list(paths(task))
    nodes = {node for node, _, cut in everywhere if not cut}
    groups = [group for node in nodes for group in task.groups.get(node, ())]
    models = [model for group in groups for model in models_of(group)]
    edges = [
        branch
        for group in groups
        for branch in ([group.branch] if isinstance(group, Edge) else getattr(group, "branches", {}).values())
    ]
    chosen = [group.selection for group in groups if isinstance(group, Choose)]
    uses = Counter(id(branch.model.function) for branch in edges if branch.model)
    read = {model.label(name) for model in models for name in model.function.reads}
    states = {label for label, slot in task.slots.items() if slot.kind == "state"}

    def note(feature, holds):
        if holds:
            found.add(feature)

    note("cut branch", any(cut for _, _, cut in everywhere))
    uncut = replace(task, max_visits=task.max_visits - 1)
    note("node visited twice on a path", task.max_visits > 1 and any(cut for _, _, cut in paths(uncut)))
    note("side by side groups", any(len(task.groups.get(node, ())) > 1 for node in nodes))
    note("identity edge", any(branch.model is None for branch in edges))
    chances = [group.probability for group in groups if isinstance(group, Chance)]
    note("constant probability", any(isinstance(probability, dict) for probability in chances))
    note("modelled probability", any(isinstance(probability, Model) for probability in chances))
    note("choice of two", any(task.slots[label].size == 2 for label in chosen))
    note("choice of three", any(task.slots[label].size == 3 for label in chosen))
    note("label chosen at several nodes", len(chosen) > len(set(chosen)))
    note("model reads a selection", any(task.slots[label].kind == "selection" for label in read))
    note("function used on several edges", any(count > 1 for count in uses.values()))
    note("renamed read", any(model.label(name) != name for model in models for name in model.function.reads))
    note("renamed write", any(model.label(name) != name for model in models for name in model.function.writes))
    found |= {f"{model.propagation or 'default'} propagation" for model in models}
    note("noise", any(np.any(noise) for model in models for noise in model.noise.values()))
    given = [value for value in problem.state.values() if isinstance(value, tuple)]
    note("full covariance of a vector", any(np.size(mean) > 1 and np.any(s) for mean, s in given))
    note("variance of a scalar", any(np.size(mean) == 1 and np.any(s) for mean, s in given))
    note("exact state", len(given) < len(problem.state))
    note("slot that first appears on an edge", (read & states) - problem.state.keys())
    note("action nothing reads", problem.actions.keys() - read)
    note("plan from a later node", task.start != problem.graph_start)
    note("value for a cut", task.cut_value)
    return found
