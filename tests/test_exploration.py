"""Plans while a model has too few samples: random, but such that the model gets some."""

import casadi as ca
import numpy as np
import pytest

import symgraph as sg
from symgraph.learned import StochasticNetwork


def network(name, needed=3):
    return StochasticNetwork({"a": 1}, {"y": 1}, hidden=(8,), samples_needed=needed, name=name)


def fit(one, count=5):
    x = np.linspace(-1.0, 1.0, count)[:, None]
    one.fit(x, x)


@pytest.fixture
def skills():
    """Two skills with a network each, and the objective of choosing between them."""
    tip, shake = network("F_tip"), network("F_shake")
    slots = {"a": sg.Action(low=-2.0, high=2.0), "skill": sg.Selection(["tip", "shake"]), "y": sg.State()}
    graph = sg.Graph(slots, start="ready")
    graph.choose("ready", "skill", {"tip": ("poured", tip), "shake": ("poured", shake)})
    graph.reward("poured", lambda y: -((y - 0.5) ** 2))
    return tip, shake, sg.Objective(sg.unroll(graph))


def test_status_says_which_models_lack_what(skills):
    tip, _, objective = skills
    plan = sg.solve(objective, {})
    assert plan.status == "exploring: model 'F_tip' has 0 of 3 samples, model 'F_shake' has 0 of 3 samples"
    assert plan.optimizer == "uniform draw"
    assert np.isfinite(plan.value)
    fit(tip, 2)
    assert "model 'F_tip' has 2 of 3 samples" in sg.solve(objective, {}).status


def test_explores_where_the_samples_are_lacking(skills):
    tip, _, objective = skills
    fit(tip)
    plans = [sg.solve(objective, {}, seed=seed) for seed in range(20)]
    assert {plan.selections["skill"] for plan in plans} == {"shake"}
    actions = [plan.actions["a"] for plan in plans]
    assert min(actions) < -1.0
    assert max(actions) > 1.0  # over the bounds, not near some optimum


def test_both_are_tried_while_both_lack_samples(skills):
    objective = skills[2]
    tried = [sg.solve(objective, {}, seed=seed).selections["skill"] for seed in range(20)]
    assert 3 <= tried.count("tip") <= 17


def test_every_sample_that_comes_in_brings_another_draw(skills):
    """Otherwise a loop that leaves the seed alone would try one action until it counts as known."""
    tip, _, objective = skills
    drawn = [sg.solve(objective, {}).actions["a"]]
    for count in (1, 2):
        fit(tip, count)
        drawn.append(sg.solve(objective, {}).actions["a"])
    assert len(set(drawn)) == 3


def test_same_seed_same_draw(skills):
    objective = skills[2]
    one, two = (sg.solve(objective, {}, seed=4) for _ in range(2))
    assert one.actions == two.actions
    assert one.selections == two.selections


def test_plans_where_the_lacking_model_cannot_be_met(skills):
    tip, _, objective = skills
    fit(tip)
    plan = sg.solve(objective, {}, fixed={"skill": "tip"})
    assert plan.optimizer == "Lbfgs"
    assert plan.actions["a"] == pytest.approx(0.5, abs=0.3)


def test_held_actions_stay_held(skills):
    plan = sg.solve(skills[2], {}, fixed={"a": 0.25})
    assert plan.actions["a"] == 0.25


def test_plans_once_all_have_enough(skills):
    tip, shake, objective = skills
    fit(tip), fit(shake)
    assert sg.solve(objective, {}).status.startswith("best of")


def test_a_model_further_down_counts_too():
    slots = {"a": sg.Action(low=0.0, high=1.0), "way": sg.Selection(["left", "right"]), "y": sg.State()}
    graph = sg.Graph(slots, start="fork")
    graph.choose("fork", "way", {"left": ("end", lambda a: {"y": a}), "right": ("middle", lambda a: {"y": a})})
    graph.edge("middle", "end", network("F_late", needed=10))
    graph.reward("end", lambda y: y)
    objective = sg.Objective(sg.unroll(graph))
    plan = sg.solve(objective, {})
    assert plan.status == "exploring: model 'F_late' has 0 of 10 samples"
    assert plan.selections == {"way": "right"}
    assert plan.runs[0].outcome == "drawn"


def test_a_guess_keeps_its_choice(skills):
    objective = skills[2]
    chosen = [sg.solve(objective, {}, guess={"skill": "tip"}, seed=seed).selections["skill"] for seed in range(8)]
    assert set(chosen) == {"tip"}


def test_explores_although_the_value_is_not_finite():
    """An unfitted network gives 0, of which the reward is infinite; only a sample can change that."""
    graph = sg.Graph({"a": sg.Action(low=0.0, high=1.0), "y": sg.State()}, start="here")
    graph.edge("here", "there", StochasticNetwork({"a": 1}, {"y": 1}, hidden=(4,), error="none", name="F"))
    graph.reward("there", lambda y: ca.log(y))
    plan = sg.solve(sg.Objective(sg.unroll(graph)), {})
    assert plan.status == "exploring: model 'F' has 0 of 3 samples"
    assert 0.0 <= plan.actions["a"] <= 1.0
    assert np.isnan(plan.value)


@pytest.mark.parametrize(("share", "explores"), [(0.001, False), (0.2, True)])
def test_what_is_seldom_met_does_not_keep_a_plan_waiting(share, explores):
    graph = sg.Graph({"a": sg.Action(low=0.0, high=1.0), "y": sg.State()}, start="here")
    branches = {"rare": ("there", network("F_rare")), "usual": ("there", lambda a: {"y": a})}
    graph.chance("here", branches, {"rare": share, "usual": 1.0 - share})
    graph.reward("there", lambda y: y)
    plan = sg.solve(sg.Objective(sg.unroll(graph)), {})
    assert plan.status.startswith("exploring") == explores
    if not explores:
        assert plan.actions["a"] > 0.99
        assert "model 'F_rare' has 0 of 3 samples; it is met too seldom to explore" in plan.notes


def test_models_of_ones_own_may_lack_something_too():
    class Own:
        reads, writes, lacking = ("a",), ("y",), "no calibration yet"

        def propagate(self, inputs):
            return {"y": inputs["a"]}

    graph = sg.Graph({"a": sg.Action(low=0.0, high=1.0), "y": sg.State()}, start="here")
    graph.edge("here", "there", Own())
    graph.reward("there", lambda y: y)
    assert sg.solve(sg.Objective(sg.unroll(graph)), {}).status == "exploring: model 'Own' has no calibration yet"
