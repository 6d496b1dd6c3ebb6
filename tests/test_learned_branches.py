"""BranchNetwork: probabilities of branches, learned from what happened, and what a graph makes of them."""

import pickle

import numpy as np
import pytest
from small_tasks import refuses

import symgraph as sg
from symgraph.learned import BranchNetwork
from symgraph.learned.gaussians import RULES


def true_probability(x):
    """Of "hit", given an action and a state."""
    return 1.0 / (1.0 + np.exp(-3.0 * (x[:, 0] - x[:, 1] ** 2 + 0.5)))


def happened(count, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.uniform(-2.0, 2.0, (count, 2))
    return x, np.where(rng.random(count) < true_probability(x), "hit", "miss").tolist()


@pytest.fixture(scope="module")
def fitted():
    network = BranchNetwork({"a": 1, "s": 1}, ["hit", "miss"], hidden=(50, 50), name="P_hit")
    network.fit(*happened(400))
    return network


def task(model):
    """The objective whose value is the probability of "hit"."""
    graph = sg.Graph({"a": sg.Action(low=-2.0, high=2.0), "s": sg.State()}, start="throw")
    graph.chance("throw", {"hit": ("in", None), "miss": ("out", None)}, model)
    graph.reward("in", lambda: 1.0)
    return sg.Objective(sg.unroll(graph))


def test_learns_the_probabilities(fitted):
    x, _ = happened(4000, seed=1)
    p = fitted.predict(x)
    assert np.sqrt(np.mean((p[:, 0] - true_probability(x)) ** 2)) < 0.08
    np.testing.assert_allclose(p.sum(axis=1), 1.0, rtol=1e-12)


def test_held_out_loss_foretells_that_of_new_samples():
    network = BranchNetwork({"a": 1, "s": 1}, ["hit", "miss"], hidden=(50, 50))
    report = network.fit(*happened(400))
    x, outcome = happened(4000, seed=1)
    p = network.predict(x)
    loss = -np.mean(np.log([row[network.writes.index(b)] for row, b in zip(p, outcome, strict=True)]))
    assert report.log_loss == pytest.approx(loss, rel=0.3)


def test_graph_computes_what_predict_says(fitted):
    objective = task(fitted)
    for a, s in [(0.3, -0.2), (-1.5, 1.0), (2.0, 0.0)]:
        assert objective.value({"s": s}, {"a": a}) == pytest.approx(fitted.predict(np.array([a, s]))[0], rel=1e-10)


@pytest.mark.parametrize("rule", RULES)
def test_probabilities_of_a_gaussian_are_near_the_average_over_draws(fitted, rule):
    """Within 0.01 of 100,000 draws where the rule splits, 0.06 where it keeps covariances, 0.15 elsewhere."""
    draws = np.column_stack([np.full(100_000, 0.2), 0.3 + 0.5 * np.random.default_rng(0).standard_normal(100_000)])
    expected = fitted.predict(draws)[:, 0].mean()
    plan_notes = sg.solve(task(sg.Model(fitted, propagation=rule)), {"s": sg.Gaussian(0.3, 0.25)}, fixed={"a": 0.2})
    assert not plan_notes.notes  # which would say that they do not sum to 1, or leave [0, 1]
    tolerance = {"auto": 0.01, "split": 0.01, "quadrature": 0.03, "low-rank": 0.06, "full": 0.06}.get(rule, 0.15)
    assert plan_notes.value == pytest.approx(expected, abs=tolerance)


def test_many_uncertain_directions_stay_probabilities():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((100, 9))
    network = BranchNetwork({"x": 9}, ["a", "b", "c"], hidden=(20,))
    network.fit(x, [("a", "b", "c")[int(k)] for k in np.argmax(x[:, :3], axis=1)])
    graph = sg.Graph({"x": sg.State(9)}, start="n")
    graph.chance("n", dict.fromkeys(("a", "b", "c"), ("end", None)), network)
    graph.reward("end", lambda x: x[0])
    nodes = sg.solve(sg.Objective(sg.unroll(graph)), {"x": sg.Gaussian(np.zeros(9), sd=0.3)}).nodes
    shares = [node.probability for node in nodes[1:]]
    assert sum(shares) == pytest.approx(1.0, abs=1e-12)
    draws = 0.3 * rng.standard_normal((50_000, 9))
    np.testing.assert_allclose(shares, network.predict(draws).mean(axis=0), atol=0.05)


@pytest.mark.parametrize("branches", [2, 3, 4, 6])
@pytest.mark.parametrize("directions", [2, 4])
def test_auto_is_near_the_average_over_draws_and_knows_no_order(branches, directions):
    """Within 0.05 of 20,000 draws, whatever the order of the branches."""
    rng = np.random.default_rng(branches)
    x = rng.uniform(-1.0, 1.0, (200, directions))
    towards = rng.standard_normal((directions, branches))
    outcome = np.argmax(3.0 * x @ towards + rng.gumbel(size=(200, branches)), axis=1)
    labels = [f"b{i}" for i in range(branches)]
    network = BranchNetwork({"x": directions}, labels, hidden=(20, 20))
    network.fit(x, [labels[k] for k in outcome])
    mean, sd = 0.2 * np.ones(directions), 0.3
    expected = network.predict(mean + sd * rng.standard_normal((20_000, directions))).mean(axis=0)
    for order in (labels, labels[::-1]):
        graph = sg.Graph({"x": sg.State(directions)}, start="n")
        graph.chance("n", dict.fromkeys(order, ("end", None)), network)
        graph.reward("end", lambda x: x[0])
        nodes = sg.Objective(sg.unroll(graph)).outcomes({"x": sg.Gaussian(mean, sd=sd)})
        shares = {node.path: node.probability for node in nodes[1:]}
        np.testing.assert_allclose([shares[f"n/end[{label}]"] for label in labels], expected, atol=0.05)


def test_gradient_is_that_of_finite_differences(fitted):
    objective, state, step = task(fitted), {"s": sg.Gaussian(0.3, 0.04)}, 1e-6
    for a in (-0.6, 0.4):
        ahead, behind = (objective.value(state, {"a": a + h}) for h in (step, -step))
        found = objective.gradient(state, {"a": a})["a"]
        assert found == pytest.approx((ahead - behind) / (2 * step), rel=1e-4, abs=1e-7)


def test_plans_with_new_weights_after_a_fit():
    network = BranchNetwork({"a": 1, "s": 1}, ["hit", "miss"], hidden=(20,))
    objective = task(network)
    assert sg.solve(objective, {"s": 0.0}).status == "exploring: model 'branches' has 0 of 3 samples"
    x, outcome = happened(200)
    network.fit(x, outcome)
    assert sg.solve(objective, {"s": 0.0}).actions["a"] > 1.0
    network.fit(x * [-1.0, 1.0], outcome)
    assert sg.solve(objective, {"s": 0.0}).actions["a"] < -1.0


def test_few_or_one_sided_samples():
    for outcome in (["hit"], ["hit"] * 4, ["miss", "hit"]):
        network = BranchNetwork({"a": 1, "s": 1}, ["hit", "miss"], hidden=(5,))
        network.fit(happened(len(outcome))[0], outcome)
        p = network.predict(np.zeros((3, 2)))
        assert ((p > 0.0) & (p < 1.0)).all()  # what has not happened yet is not impossible


def test_pickled_network_predicts_the_same(fitted):
    x = happened(5)[0]
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(fitted)).predict(x), fitted.predict(x))


REFUSED = {
    "one branch": (lambda: BranchNetwork({"x": 1}, ["a"]), ["branches = ['a']", "two or more different names"]),
    "a string": (lambda: BranchNetwork({"x": 1}, "ab"), ["branches = 'ab'"]),
    "doubled": (lambda: BranchNetwork({"x": 1}, ["a", "a"]), ["two or more different names"]),
    "unknown branch": (
        lambda: BranchNetwork({"x": 1}, ["hit", "miss"]).fit([[1.0]], ["hot"]),
        ["branches: happened[0] = 'hot' is no branch; did you mean 'hit'?", "Branches: 'hit', 'miss'"],
    ),
    "no names": (lambda: BranchNetwork({"x": 1}, None), ["branches = None"]),
    "lists": (lambda: BranchNetwork({"x": 1}, [["a"], ["b"]]), ["two or more different names"]),
    "a string of names": (lambda: BranchNetwork({"x": 1}, ["a", "b"]).fit([[1.0], [2.0]], "ab"), ["happened = 'ab'"]),
    "seed": (lambda: BranchNetwork({"x": 1}, ["a", "b"]).fit([[1.0]], ["a"], seed="x"), ["seed = 'x'"]),
    "counts": (lambda: BranchNetwork({"x": 1}, ["a", "b"]).fit([[1.0]], []), ["x has 1 rows, happened 0 names"]),
    "shape": (lambda: BranchNetwork({"x": 2}, ["a", "b"]).predict([1.0]), ["mean has shape (1, 1); give (N, 2)"]),
}


@pytest.mark.parametrize(("make", "words"), REFUSED.values(), ids=REFUSED.keys())
def test_refusals(make, words):
    refuses(make, sg.InputError, *words)


def test_branches_of_the_chance_must_be_those_of_the_network(fitted):
    graph = sg.Graph({"a": sg.Action(low=0.0, high=1.0), "s": sg.State()}, start="n")
    refuses(
        lambda: graph.chance("n", {"hit": ("x", None), "mis": ("y", None)}, fitted),
        sg.GraphError,
        "model 'P_hit' returned the branches 'hit', 'miss'; the chance has 'hit', 'mis'",
    )
