import cannon_oracle as oracle
import casadi as ca
import numpy as np
import pytest

import symgraph as sg
from models import cannon
from sims import cannon as sim

CANNONS = ["lower", "upper"]
TARGETS = [0.01, 0.15, 0.5, 1.0, 1.5]  # [m]
THETAS = [-1.57, -1.5, -1.0, -0.3, 0.0, 0.7, 1.2, 1.5, 1.57]  # [rad]


@pytest.fixture(scope="module")
def objective():
    return sg.Objective(sg.unroll(cannon.graph()))


def grid(spacing):
    """Targets over (0, 1.5] [m]."""
    return spacing * np.arange(1, round(1.5 / spacing) + 1)


# The graph


def test_the_graph_is_wired_as_in_the_paper():
    graph = cannon.graph()
    assert graph.start == "aim"
    (aim,), (landed,) = graph.groups["aim"], graph.groups["landed"]
    assert (aim.kind, aim.selection, landed.kind) == ("choose", "cannon", "reward")
    assert {branch.label: branch.target for branch in aim.branches} == {"lower": "landed", "upper": "landed"}
    for branch in aim.branches:
        assert set(branch.model.reads) == {f"{branch.label}_muzzle", "target", "speed", "theta"}
        assert set(branch.model.writes) == {"hit_time", "hit_height"}
    assert set(landed.branches[0].model.reads) == {"hit_time", "hit_height", "target"}


def test_the_tree_has_a_landing_for_each_cannon(objective):
    plan = sg.solve(objective, cannon.state(0.5), fixed={"theta": 0.0, "cannon": "upper"})
    assert [node.path for node in plan.nodes] == ["aim", "aim/landed[lower]", "aim/landed[upper]"]
    assert [node.probability for node in plan.nodes] == [1.0, 0.0, 1.0]


def test_the_state_is_all_that_the_graph_needs(objective):
    assert set(cannon.state(0.5)) == set(objective.tree.needed_states)
    for label in cannon.state(0.5):
        without = {name: value for name, value in cannon.state(0.5).items() if name != label}
        with pytest.raises(sg.InputError, match=label):
            objective.value(without, {"theta": 0.0}, {"cannon": "lower"})


@pytest.mark.parametrize("choice", CANNONS)
def test_value_is_the_reward_of_the_shot(objective, choice):
    for x in TARGETS:
        for theta in THETAS:
            value = objective.value(cannon.state(x, 0.2), {"theta": theta}, {"cannon": choice})
            assert value == pytest.approx(oracle.reward(choice, theta, x, 0.2), rel=1e-10)


@pytest.mark.parametrize("choice", CANNONS)
def test_gradient_vanishes_where_the_oracle_says(objective, choice):
    for x in TARGETS:
        for theta in oracle.stationary(choice, x):
            slope = objective.gradient(cannon.state(x), {"theta": theta}, {"cannon": choice})["theta"]
            curvature = objective.hessian(cannon.state(x), {"theta": theta}, {"cannon": choice})[0, 0]
            assert abs(slope / curvature) < 1e-12  # how far one Newton step would move theta [rad]


# The plan


def check_plans(objective, spacing, seed):
    wrong, gaps = [], []
    for x in grid(spacing):
        best = oracle.best(x)
        plan = sg.solve(objective, cannon.state(x), seed=seed)
        shot = plan.selections["cannon"], plan.actions["theta"]
        assert abs(shot[1]) <= cannon.THETA_LIMIT
        assert plan.value == pytest.approx(oracle.reward(*shot, x), rel=1e-9)
        if shot[0] != best.cannon:
            wrong.append(float(x))
        gaps.append(best.value - oracle.reward(*shot, x))
    assert wrong == []
    assert max(gaps) <= 1e-9


@pytest.mark.parametrize("seed", range(5))
def test_plans_are_optimal(objective, seed):
    check_plans(objective, 0.05, seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("spacing", [0.0375, 0.01])  # 0.0375 m is the paper's
def test_plans_are_optimal_on_finer_grids(objective, spacing, seed):
    check_plans(objective, spacing, seed)


# The model and the world


@pytest.mark.parametrize("choice", CANNONS)
def test_model_agrees_with_the_integrated_flight(choice):
    for x in TARGETS:
        world = sim.World(target_x=x)
        observed = world.reset(0)
        for theta in THETAS:
            landed = world.execute("aim", {"theta": theta}, {"cannon": choice})["landed"]
            muzzle, target = ca.DM(observed[f"{choice}_muzzle"]), ca.DM(observed["target"])
            predicted = cannon.fly(muzzle, target, observed["speed"], theta)
            assert landed.keys() == predicted.keys()
            for label, value in landed.items():
                assert value == pytest.approx(float(predicted[label]), rel=1e-9, abs=1e-9)


def test_world_and_model_start_from_the_same_state():
    observed, expected = sim.World(target_x=0.7, target_y=0.4).reset(0), cannon.state(0.7, 0.4)
    assert observed.keys() == expected.keys()
    for label, value in expected.items():
        np.testing.assert_array_equal(observed[label], value)


@pytest.mark.parametrize("x", [0.1, 0.5, 1.2])
def test_a_planned_shot_lands_where_planned(objective, x):
    world = sim.World(target_x=x)
    plan = sg.solve(objective, world.reset(0))
    landed = world.execute("aim", plan.actions, plan.selections)["landed"]
    (node,) = (node for node in plan.nodes if node.node == "landed" and node.probability == 1.0)
    for label, value in landed.items():
        assert value == pytest.approx(float(node.states[label].mean), abs=1e-9)
    assert landed["hit_height"] == pytest.approx(0.3, abs=2e-3)  # time weighs in too


# The world alone


def test_equal_seeds_give_equal_episodes():
    def episode(seed):
        world = sim.World(speed_sd=0.05, theta_sd=0.02)
        x = world.reset(seed)["target"][0]
        return x, *[world.execute("aim", {"theta": 0.3}, {"cannon": "upper"})["landed"] for _ in range(3)]

    assert episode(1) == episode(1)
    assert episode(1) != episode(2)


def test_targets_are_drawn_over_the_whole_range():
    world = sim.World()
    x = np.array([world.reset(seed)["target"][0] for seed in range(400)])
    assert (x > 0).all()
    assert (x <= 1.5).all()
    assert np.quantile(x, [0.25, 0.5, 0.75]) == pytest.approx([0.375, 0.75, 1.125], abs=0.12)


def test_noise_has_the_spread_that_was_asked_for():
    """Flight times tell the speed of level shots, and the angle at a known speed: t = x / (v cos(theta))."""
    world = sim.World(target_x=0.5, speed_sd=0.1)
    world.reset(0)
    shots = [world.execute("aim", {"theta": 0.0}, {"cannon": "upper"})["landed"] for _ in range(500)]
    speed = np.array([0.5 / shot["hit_time"] for shot in shots])
    assert speed.mean() == pytest.approx(3.0, abs=0.015)
    assert speed.std() == pytest.approx(0.1, rel=0.1)

    world = sim.World(target_x=0.5, theta_sd=0.02)
    world.reset(0)
    shots = [world.execute("aim", {"theta": 0.8}, {"cannon": "upper"})["landed"] for _ in range(500)]
    theta = np.array([np.arccos(0.5 / (3.0 * shot["hit_time"])) for shot in shots])
    assert theta.mean() == pytest.approx(0.8, abs=0.003)
    assert theta.std() == pytest.approx(0.02, rel=0.1)


def test_a_shot_backwards_is_missed_and_says_so():
    world = sim.World(target_x=0.5)
    world.reset(0)
    with pytest.raises(sim.MissedError, match="theta 2 rad") as missed:
        world.execute("aim", {"theta": 2.0}, {"cannon": "lower"})
    assert missed.value.observed == {}


def test_only_aiming_can_be_executed():
    world = sim.World(target_x=0.5)
    with pytest.raises(ValueError, match=r"'landed'.*'aim'"):
        world.execute("landed", {"theta": 0.0}, {"cannon": "lower"})


def test_a_flight_keeps_its_energy():
    velocity = np.array([1.0, 2.0])
    flight = sim.shoot(sim.MUZZLES["lower"], velocity, target_x=0.3, points=50)
    assert flight.position[0, -1] == pytest.approx(0.3)
    climb = np.gradient(flight.position[1], flight.time, edge_order=2)  # exact on a parabola
    energy = (1.0 + climb**2) / 2 + 9.8 * flight.position[1]
    np.testing.assert_allclose(energy, 2.5, rtol=1e-9)
