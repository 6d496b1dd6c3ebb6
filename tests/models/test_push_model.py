import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import symgraph as sg
from models import push
from sims import push as sim

seeds = st.integers(0, 2**32 - 1)


def objective_of(model):
    return sg.Objective(sg.unroll(push.graph(model)))


@pytest.fixture(scope="module")
def exact():
    return objective_of(sg.Model(push.push, propagation="mean"))


@pytest.fixture(scope="module")
def smoothed():
    return objective_of(sg.Model(push.push, propagation="quadrature"))


def random_case(seed):
    rng = np.random.default_rng(seed)
    seen = sim.Situation.draw(rng)
    return seen, {"gripper": rng.uniform(size=2), "theta": rng.uniform(-3, 3), "advance": rng.uniform(0.05, 0.8)}


def state_of(seen):
    return push.state(seen.first, seen.first_sd, seen.second, seen.second_sd)


def offset_moments(model, local, sd, advance):
    """Mean (2,) and covariance (2, 2) of the offset for one Gaussian in the gripper's frame."""
    graph = sg.Graph(push.graph().slots, start="approached")
    graph.edge("approached", "pushed", model)
    graph.reward("pushed", push.score)
    state = {"local": sg.Gaussian(local, sd=(sd, sd))}
    (_, pushed) = sg.Objective(sg.unroll(graph)).outcomes(
        state, {"gripper": [0.0, 0.0], "theta": 0.0, "advance": advance}
    )
    return pushed.states["offset"].mean, pushed.states["offset"].covariance


# The graph


def test_the_graph_is_wired_as_in_the_paper():
    graph = push.graph()
    (aim,), (approached,), (pushed,) = (graph.groups[node] for node in ("aim", "approached", "pushed"))
    assert (graph.start, aim.kind, approached.kind, pushed.kind) == ("aim", "chance", "edge", "reward")
    for branch in aim.branches:
        assert branch.target == "approached"
        assert set(branch.model.reads) == {branch.label, "gripper", "theta"}
        assert set(branch.model.writes) == {"local"}
    assert set(approached.branches[0].model.reads) == {"local", "advance"}
    assert set(approached.branches[0].model.writes) == {"offset"}
    assert set(pushed.branches[0].model.reads) == {"offset", "advance"}


def test_both_beliefs_weigh_the_same(exact):
    seen, actions = random_case(0)
    nodes = exact.outcomes(state_of(seen), actions)
    assert [node.probability for node in nodes if node.node == "pushed"] == [0.5, 0.5]


@pytest.mark.parametrize("sd", [-0.1, float("nan"), float("inf")])
def test_a_standard_deviation_that_is_none_is_refused(sd):
    with pytest.raises(ValueError, match=r"second_sd = .*at least 0"):
        push.state([0.5, 0.5], 0.1, [0.4, 0.4], sd)


# The model and the world


def test_the_push_agrees_with_the_world():
    rng = np.random.default_rng(0)
    local, advance = rng.uniform([-0.2, -0.5], [0.9, 0.5], (5000, 2)), rng.uniform(0.05, 0.8, 5000)
    x, m = ca.MX.sym("local", 2), ca.MX.sym("advance")
    model = ca.Function("push", [x, m], [push.push(x, m)["offset"]])
    predicted = np.array(model(local.T, advance[None])).T
    np.testing.assert_allclose(predicted, sim.pushed(local, advance), atol=1e-12)


def test_the_gripper_s_frame_agrees_with_the_world():
    rng = np.random.default_rng(0)
    for _ in range(20):
        place, gripper, theta = rng.normal(size=2), rng.normal(size=2), rng.normal()
        local = push.approach(ca.DM(place), ca.DM(gripper), theta)["local"]
        np.testing.assert_allclose(local.full()[:, 0], sim.in_gripper(place, gripper, theta), atol=1e-14)


def test_the_value_is_the_world_s_mean_reward(exact):
    for seed in range(20):
        seen, actions = random_case(seed)
        local = sim.in_gripper(np.array([seen.first, seen.second]), actions["gripper"], actions["theta"])
        offset = sim.pushed(local, actions["advance"])
        reward = -1000 * (offset**2).sum(axis=1) - 0.001 * actions["advance"] ** 2
        assert exact.value(state_of(seen), actions) == pytest.approx(reward.mean(), rel=1e-10)


def test_the_world_does_what_a_plan_without_uncertainty_says(exact):
    seen = sim.Situation(np.array([0.4, 0.5]), 0.0, np.array([0.6, 0.6]), 0.0)
    world = sim.World(seen)
    plan = sg.solve(exact, push.state(**world.reset(3)), progress=False)
    for node in ("aim", "approached"):
        ((target, observed),) = world.execute(node, plan.actions, plan.selections).items()
        ((label, value),) = observed.items()
        expected = [node.states[label].mean for node in plan.nodes if node.node == target]
        assert any(np.allclose(value, mean, atol=1e-9) for mean in expected)


# Moments


@pytest.mark.parametrize(
    ("local", "mean", "covariance"),
    [
        ((-0.4, 0.1), (-0.9, 0.1), [[1, 0], [0, 1]]),  # nothing touches it
        ((0.65, -0.25), (0.15, -0.15), [[1, -1], [-1, 1]]),  # sliding
        ((0.3, 0.05), (0.0, 0.0), [[0, 0], [0, 0]]),  # captured
    ],
)
@pytest.mark.parametrize(
    "model",
    [
        sg.Model(push.push),
        sg.Model(push.push, propagation="quadrature"),
        sg.Model(push.push, propagation="unscented"),
        push.CentralDifferences(push.push, "offset", 0.01),
    ],
    ids=["linear", "quadrature", "unscented", "differences"],
)
def test_moments_away_from_jumps_are_those_of_a_linear_model(model, local, mean, covariance):
    y, spread = offset_moments(model, local, 0.01, 0.5)
    np.testing.assert_allclose(np.ravel(y), mean, atol=1e-9)
    np.testing.assert_allclose(spread, 1e-4 * np.array(covariance), atol=1e-9)


def test_differences_see_a_jump_within_their_step_and_derivatives_do_not():
    # The object is captured; 0.05 m further ahead the gripper would stop 0.02 m short of it.
    local, sd, advance = (0.47, 0.0), 0.1, 0.5
    _, linear = offset_moments(sg.Model(push.push), local, sd, advance)
    np.testing.assert_array_equal(linear, np.zeros((2, 2)))
    _, seen = offset_moments(push.CentralDifferences(push.push, "offset", 0.05), local, sd, advance)
    np.testing.assert_allclose(seen, [[(0.02 / 0.1 * sd) ** 2, 0], [0, 0]], atol=1e-12)


@pytest.mark.parametrize("step", [0.0, -0.1, float("nan")])
def test_a_step_that_is_none_is_refused(step):
    with pytest.raises(ValueError, match=r"step = .*positive"):
        push.CentralDifferences(push.push, "offset", step)


@given(seeds, st.floats(-3, 3), st.floats(-1, 1), st.floats(-1, 1))
@settings(max_examples=50)
def test_the_value_does_not_depend_on_where_the_table_stands(smoothed, seed, angle, dx, dy):
    seen, actions = random_case(seed)
    c, s = np.cos(angle), np.sin(angle)

    def place(point):
        return np.array([[c, -s], [s, c]]) @ point + [dx, dy]

    moved = sim.Situation(place(seen.first), seen.first_sd, place(seen.second), seen.second_sd)
    there = {"gripper": place(actions["gripper"]), "theta": actions["theta"] + angle, "advance": actions["advance"]}
    here = smoothed.value(state_of(seen), actions)
    assert smoothed.value(state_of(moved), there) == pytest.approx(here, rel=1e-7, abs=1e-7)


# The plan


def test_without_uncertainty_plans_capture_both_with_nearly_the_shortest_push(exact):
    """The funnel takes a triangle of base 2m, which is its longest chord: m cannot be less than d/2.

    To stop e short of capture saves 0.002 m e and costs 1000 e²: a plan may do so by e = 1e-6 m.
    """
    for seed in range(5):
        drawn, _ = random_case(seed)
        places = np.array([drawn.first, drawn.second])
        plan = sg.solve(exact, push.state(drawn.first, 0.0, drawn.second, 0.0), progress=False)
        advance = plan.actions["advance"]
        offset = sim.pushed(sim.in_gripper(places, plan.actions["gripper"], plan.actions["theta"]), advance)
        assert np.abs(offset).max() < 1e-4
        shortest = max(np.linalg.norm(places[0] - places[1]) / 2, push.ADVANCE[0])
        assert shortest - 1e-4 <= advance <= shortest + 0.15


def test_plans_that_know_the_uncertainty_succeed_nearly_always(smoothed):
    for seed in range(5):
        seen, _ = random_case(seed)
        plan = sg.solve(smoothed, state_of(seen), progress=False)
        actions = [plan.actions[label] for label in ("gripper", "theta", "advance")]
        assert sim.success_probability(seen, *actions) > 0.9
