"""The pouring model: its reward against integrals, its edges against the world, its plans against a grid."""

import itertools

import casadi as ca
import numpy as np
import pytest
from small_tasks import objective_of

import symgraph as sg
from models import pouring
from sims.pouring import ACTIONS, SKILLS, PouringWorld
from sims.pouring.behaviour import SPHERE_AMOUNT, SPILLS, Phase
from sims.pouring.geometry import SPHERES, Receiver

# The reward of amounts

AMOUNTS = ("poured_change", "spilled_change", "target_change")


def paper_reward(poured, spilled, target):
    """Equation (8), word by word."""
    missing = np.minimum(0.0, poured - target)
    return -100 * missing**2 - 10 * np.maximum(0.0, spilled) ** 2 - np.maximum(0.0, poured - target) ** 2


@pytest.fixture(scope="module")
def reward_of():
    """(means (3,), variances (3,)) → reward and its gradient by means and variances (6,), all variances given."""
    means, variances = ca.MX.sym("means", 3), ca.MX.sym("variances", 3)
    inputs = {label: sg.Gaussian(means[i], variances[i]) for i, label in enumerate(AMOUNTS)}
    reward = pouring.AmountReward().propagate(inputs)["reward"].mean
    both = ca.vertcat(means, variances)
    hessian, gradient = ca.hessian(reward, both)
    function = ca.Function("reward", [means, variances], [reward, gradient, hessian])

    def call(m, v):
        r, g, h = function(np.asarray(m, float), np.asarray(v, float))
        assert np.isfinite(h.full()).all()
        return float(r), g.full()[:, 0]

    return call


NODES, WEIGHTS = np.polynomial.legendre.leggauss(80)


def integral(function, low, high):
    """Gauss–Legendre over arrays of ends, whose last axis the nodes become."""
    low, high = np.asarray(low, float)[..., None], np.asarray(high, float)[..., None]
    x = (low + high) / 2 + (high - low) / 2 * NODES
    return ((high - low) / 2 * WEIGHTS * function(x)).sum(axis=-1)


def density(x, mean, sd):
    return np.exp(-(((x - mean) / sd) ** 2) / 2) / (sd * np.sqrt(2 * np.pi))


def integrated_reward(means, variances, reach=11.0):
    """The expectation over all three amounts, in pieces between which the integrand has its kinks."""
    (poured, spilled, target), (sd_poured, sd_spilled, sd_target) = means, np.sqrt(variances)

    def over_target(x):
        ends = target + reach * sd_target * np.array([-1.0, 1.0])
        kink = np.clip(x, *ends)

        def loss(t):
            return density(t, target, sd_target) * paper_reward(x[..., None], 0.0, t)

        return integral(loss, np.full_like(x, ends[0]), kink) + integral(loss, kink, np.full_like(x, ends[1]))

    pieces = poured + reach * sd_poured * np.linspace(-1, 1, 9)
    total = integral(lambda x: density(x, poured, sd_poured) * over_target(x), pieces[:-1], pieces[1:]).sum()
    ends = np.maximum(0.0, spilled + reach * sd_spilled * np.array([-1.0, 1.0]))
    return total + integral(lambda x: -10 * x**2 * density(x, spilled, sd_spilled), *ends)


GAUSSIANS = [
    ((0.2, 0.1, 0.3), (0.01, 0.02, 0.005)),
    ((0.3, 0.0, 0.3), (0.04, 0.04, 0.01)),
    ((0.5, -0.1, 0.3), (0.002, 0.001, 0.003)),
    ((0.1, 0.9, 0.4), (0.0001, 0.3, 0.0004)),
    ((0.45, -0.6, 0.3), (0.003, 0.02, 0.002)),
]


def test_exact_amounts_are_rewarded_as_in_the_paper():
    rng = np.random.default_rng(0)
    for poured, spilled, target in [*rng.uniform(-0.2, 0.6, (50, 3)), (0.3, 0.0, 0.3), (0.0, 0.0, 0.0)]:
        inputs = dict(zip(AMOUNTS, map(sg.Gaussian, map(ca.MX, (poured, spilled, target))), strict=True))
        inputs = {label: sg.Gaussian(g.mean, ca.MX(1, 1)) for label, g in inputs.items()}
        reward = pouring.AmountReward().propagate(inputs)["reward"]
        assert float(ca.evalf(reward.mean)) == pytest.approx(paper_reward(poured, spilled, target), abs=1e-14)
        assert reward.covariance.nnz() == 0


@pytest.mark.parametrize(("means", "variances"), GAUSSIANS)
def test_the_expected_reward_is_the_integral(reward_of, means, variances):
    assert reward_of(means, variances)[0] == pytest.approx(integrated_reward(means, variances), rel=1e-10, abs=1e-12)


def test_the_integral_is_the_average_over_draws():
    """What the other test compares with: within four standard errors of 400,000 draws."""
    rng = np.random.default_rng(0)
    for means, variances in GAUSSIANS:
        draws = paper_reward(*(np.array(means)[:, None] + np.sqrt(variances)[:, None] * rng.normal(size=(3, 400_000))))
        tolerance = 4 * draws.std() / np.sqrt(draws.size)
        assert integrated_reward(means, variances) == pytest.approx(draws.mean(), abs=tolerance)


@pytest.mark.parametrize(("means", "variances"), GAUSSIANS)
def test_the_gradient_is_that_of_finite_differences(reward_of, means, variances):
    both, gradient = np.array([*means, *variances]), reward_of(means, variances)[1]
    for i in range(6):
        step = np.zeros(6)
        step[i] = 1e-4 * (1.0 if i < 3 else both[i])
        ahead, behind = (integrated_reward(x[:3], x[3:]) for x in (both + step, both - step))
        assert gradient[i] == pytest.approx((ahead - behind) / (2 * step[i]), rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("variance", [0.0, 1e-30, 1e-20, 1e-16, 1e-14, 1e-12, 1e-10])
def test_small_variances_lead_to_the_exact_reward(reward_of, variance):
    """E[max(0, X)²] exceeds max(0, E[X])² by at most the variance, as ∫ (x - E[X])² p shows; slopes by its root."""
    for means in itertools.product((-0.2, 0.0, 0.3, 0.5), (-0.1, 0.0, 0.2), (0.0, 0.3)):
        poured, spilled, target = means
        reward, gradient = reward_of(means, np.full(3, variance))
        exact = paper_reward(*means)
        assert exact - (2 * 101 + 10) * variance - 1e-14 <= reward <= exact + 1e-14
        missing, excess = max(0.0, target - poured), max(0.0, poured - target)
        slope = 200 * missing - 2 * excess
        by_mean = [slope, -20 * max(0.0, spilled), -slope]
        np.testing.assert_allclose(gradient[:3], by_mean, rtol=1e-9, atol=200 * np.sqrt(2 * variance + 1e-16))
        share = (np.sign(target - poured) + 1) / 2, (np.sign(spilled) + 1) / 2  # of X above 0
        by_spread = -100 * share[0] - (1 - share[0])
        np.testing.assert_allclose(gradient[3:], [by_spread, -10 * share[1], by_spread], rtol=1e-9)


@pytest.mark.parametrize("variance", [0.0, 1e-16, 1e-12, 1e-4])
@pytest.mark.parametrize("distance", [1e-9, 3e-8, 1e-3, 1.0, 1e6])
def test_far_from_what_is_wanted_the_reward_is_a_parabola_or_nothing(reward_of, distance, variance):
    """Beyond six standard deviations a Gaussian's share of 1e-9 is all that lies on the other side."""
    for side in (-1.0, 1.0):
        means = (-side * distance, side * distance, 0.0)
        reward, gradient = reward_of(means, (variance, variance, 0.0))
        assert np.isfinite(gradient).all()
        weight = 100 + 10 if side > 0 else 1
        wanted = -weight * (distance**2 + variance)
        if distance > 6 * np.sqrt(variance):
            slack = 110 * (variance + 1e-16)
            assert reward == pytest.approx(wanted, rel=1e-8, abs=slack)
        assert reward <= 1e-14


def test_a_graph_pays_the_reward_of_its_states():
    graph = sg.Graph(dict.fromkeys(AMOUNTS, sg.State()), start="poured")
    graph.reward("poured", pouring.AmountReward())
    objective = objective_of(graph)
    means, variances = GAUSSIANS[0]
    state = {label: sg.Gaussian(m, v) for label, m, v in zip(AMOUNTS, means, variances, strict=True)}
    assert objective.value(state) == pytest.approx(integrated_reward(means, variances), rel=1e-10)
    exact = paper_reward(*means)
    assert objective.value(dict(zip(AMOUNTS, means, strict=True))) == pytest.approx(exact, rel=1e-12)
    assert objective.value({label: sg.Gaussian(g.mean, 0.0) for label, g in state.items()}) == pytest.approx(exact)


# A stand-in for the networks: what flows grows with the rates, and spills where it does not come down in the middle


def flow_tip(tilt_rate, relative_position):
    return {
        "flow_centre": ca.vertcat(relative_position[0] + 0.2, relative_position[1]),
        "flow_variance": 100 * (tilt_rate - 0.013) ** 2,
    }


def flow_shake(shake_stroke, relative_position):
    return {
        "flow_centre": ca.vertcat(relative_position[0] + 0.2 + 0.05 * ca.sin(shake_stroke[1]), relative_position[1]),
        "flow_variance": 0.001,
    }


def release_tip(tilt_rate, search_rate):
    return {"released_change": 12 * tilt_rate + 40 * search_rate}


def release_shake(shake_speed, shake_stroke):
    return {"released_change": 0.2 * shake_speed + 0.5 * shake_stroke[0]}


def amount(released_change, flow_centre, flow_variance):
    spilled = released_change * (5 * ca.sumsqr(flow_centre) + 100 * flow_variance)
    return {"poured_change": released_change - spilled, "spilled_change": spilled}


def plain_graph(**options):
    flow, release = {"tip": flow_tip, "shake": flow_shake}, {"tip": release_tip, "shake": release_shake}
    return pouring.graph(flow, release, amount, **options)


def network_graph():
    return pouring.graph(*pouring.networks())


# The model and the world

ACTION = {
    "grasp_ratio": 0.3,
    "pour_position": (-0.2, 0.4),
    "tilt_rate": 0.02,
    "search_rate": 0.005,
    "shake_speed": 0.75,
    "shake_stroke": (0.06, -1.5),
}


@pytest.fixture(scope="module")
def episode():
    """{node: what was observed on the way there} of one real episode that pours in both ways."""
    world = PouringWorld("wat", 0.25, receiver_size=(0.25, 0.36, 0.17))
    observed = {"start": world.reset(5)}
    while world.node != "ready":
        observed |= world.execute(world.node, ACTION)
    ready = world.save()
    for skill in SKILLS:
        world.restore(ready)
        observed |= world.execute("ready", ACTION, {"skill": skill})
        while world.node != "poured":
            observed |= world.execute(world.node, ACTION)
    assert not world.clamps  # the actions were followed as given
    world.close()
    return observed


@pytest.fixture(scope="module")
def predicted(episode):
    """{node: {state: mean}} as the graph has it from what was observed at the start."""
    objective = objective_of(plain_graph())
    state = {label: episode["start"][label] for label in objective.tree.needed_states}
    nodes = objective.outcomes(state, ACTION, {"skill": "tip"})
    return {node.node: {label: np.ravel(g.mean) for label, g in node.states.items()} for node in nodes}


def test_actions_have_the_bounds_of_the_world():
    actions = plain_graph().actions()
    assert list(actions) == list(ACTIONS)
    for label, bounds in ACTIONS.items():
        assert actions[label].size == len(bounds.low)
        np.testing.assert_array_equal(actions[label].lower, bounds.low)
        np.testing.assert_array_equal(actions[label].upper, bounds.high)
    assert plain_graph().selections()["skill"].choices == pouring.SKILLS == SKILLS


def test_the_graph_has_the_nodes_of_the_world(episode):
    nodes = {node.name for node in sg.unroll(plain_graph()).nodes}
    assert nodes == set(episode) == {phase.value for phase in Phase} | {"receiver_moved"}


def test_the_world_observes_all_that_a_plan_needs(episode):
    at_receiver = {**episode["start"], **episode["grasped"], **episode["at_receiver"]}
    for start, observed in (("start", episode["start"]), ("at_receiver", at_receiver)):
        tree = sg.unroll(network_graph(), start=start)
        needed = tree.needed_states
        assert set(needed) <= set(observed)
        for label in needed:
            assert np.size(observed[label]) == tree.graph.slots[label].size, label


def test_the_world_observes_all_that_is_written(episode):
    """So that every edge can be checked, and the networks' learned, by what the world says of it."""
    graph = network_graph()
    assert {group.kind for groups in graph.groups.values() for group in groups} == {"edge", "choose", "reward"}
    for node, groups in graph.groups.items():
        for branch in (branch for group in groups for branch in group.branches):
            # What misses the receiver, and what that ends, is no observation; it follows from the flow.
            if branch.target not in (None, "tip_bounded", "shake_bounded", "landed") and branch.model is not None:
                assert set(branch.model.writes) <= set(episode[branch.target]), (node, branch.target)
                for label in branch.model.writes:
                    assert np.size(episode[branch.target][label]) == graph.slots[label].size


def test_grasp_agrees_with_the_world(episode, predicted):
    np.testing.assert_allclose(predicted["grasped"]["grasp_height"], episode["grasped"]["grasp_height"], atol=1e-15)
    for ratio, height in ((0.0, 0.05), (1.0, 0.45)):
        assert float(pouring.grasp(ratio)["grasp_height"]) == pytest.approx(height, abs=1e-15)


def test_the_way_to_the_receiver_agrees_with_the_world(episode, predicted):
    seen, said = episode["at_receiver"], predicted["at_receiver"]
    np.testing.assert_allclose(said["receiver_corners"], seen["receiver_corners"], atol=1e-12)
    np.testing.assert_allclose(said["position"], seen["position"], atol=0.005)  # where a move ends, ARRIVED
    seen, said = episode["receiver_moved"], predicted["receiver_moved"]
    np.testing.assert_allclose(said["receiver_corner_change"], seen["receiver_corner_change"], atol=1e-12)
    np.testing.assert_allclose(said["receiver_speed"], seen["receiver_speed"], atol=1e-12)


def test_the_pouring_position_agrees_with_the_world(episode, predicted):
    said = predicted["at_pour"]["relative_position"]
    np.testing.assert_allclose(said, episode["at_pour"]["relative_position"], atol=0.005)  # ARRIVED
    corners = episode["start"]["receiver_corners"].reshape(4, 3)
    above = ACTION["pour_position"][1] - corners[0, 2]
    np.testing.assert_allclose(said, [-0.2, 0.0, above], atol=1e-12)


def test_a_receiver_that_was_pushed_and_turned_is_seen_from_its_middle():
    """By the world's own formulas, since its receiver has not moved yet when an episode begins."""
    receiver, (x, y, yaw) = Receiver((0.25, 0.36, 0.17)), (0.9, 0.04, 0.3)
    said = pouring.move_to_pour(ca.DM(receiver.corners(np.array([x, y, yaw]))), ca.DM([-0.2, 0.4]))
    np.testing.assert_allclose(said["relative_position"].full()[:, 0], [-0.2, -y, 0.4 - 0.17], atol=1e-12)


def test_what_misses_the_receiver_is_the_share_of_a_gaussian_beside_it():
    rng = np.random.default_rng(0)
    size = np.array([0.3, 0.4, 0.2])
    for centre, variance in (([0.0, 0.0], 0.004), ([0.12, -0.03], 0.01), ([-0.2, 0.1], 0.001), ([0.5, 0.0], 0.0)):
        said = {k: float(v) for k, v in pouring.bound(ca.DM(centre), variance, 0.3, 0.1, ca.DM(size)).items()}
        points = centre + np.sqrt(variance / 2 + 0.03**2) * rng.standard_normal((200_000, 2))
        share = 1 - np.mean(np.all(np.abs(points) < size[:2] / 2, axis=1))
        assert said["missed"] == pytest.approx(share, abs=4e-3)
        assert float(pouring.land(said["missed"], 0.4)["missed_change"]) == pytest.approx(0.4 * said["missed"])
    below = pouring.bound(ca.DM([0.0, 0.0]), -0.001, 0.3, 0.1, ca.DM(size))  # networks may say that
    at_zero = pouring.bound(ca.DM([0.0, 0.0]), 0, 0.3, 0.1, ca.DM(size))
    assert float(below["missed"]) == pytest.approx(float(at_zero["missed"]))


def stop(centre, target=0.3, released=0.0):
    said = pouring.bound(ca.DM([centre, 0.0]), 0.002, target, released, ca.DM([0.3, 0.4, 0.2]))
    return float(said["missed"]), float(said["stop_amount"])


def test_a_skill_ends_at_the_target_or_after_ten_spills_or_where_the_source_is_empty():
    missed, amount = stop(0.0)
    assert missed < 0.01
    assert amount == pytest.approx(0.3 / (1 - missed))
    missed, amount = stop(0.16)
    assert 0.4 < missed < 0.7
    assert amount == pytest.approx(10 * SPHERE_AMOUNT / missed)
    assert stop(0.0, target=0.4, released=0.35)[1] == pytest.approx(0.2)
    missed, amount = stop(5.0)  # nothing is hit
    assert missed == pytest.approx(1.0)
    assert amount == pytest.approx(0.055)
    assert pytest.approx(SPILLS * SPHERE_AMOUNT) == pouring.STOP_SPILLED
    assert pytest.approx(SPHERES * SPHERE_AMOUNT) == pouring.FULL


def test_a_skill_ends_in_the_world_where_the_model_says():
    """Water flows freely: what has left the source is what ends the skill, and the few spheres in the air by then."""
    world = PouringWorld("wat", 0.16, target=0.2, receiver_x=0.7)
    known = world.reset(0)
    while world.node != "landed":
        for observed in world.execute(world.node, ACTION | {"pour_position": (-0.2, 0.33)}, {"skill": "tip"}).values():
            known |= observed
    said = pouring.bound(
        *(ca.DM(known[label]) for label in ("flow_centre", "flow_variance", "target_change")),
        0.0,
        known["receiver_size"],
    )
    assert 0.0 <= known["released_change"] - float(said["stop_amount"]) < 0.1


def test_rewards_of_moves_are_those_of_the_distances():
    rng = np.random.default_rng(0)
    for _ in range(10):
        corners, change, speed = rng.normal(size=(4, 3)), rng.normal(size=12), rng.normal()
        assert float(pouring.receiver_moved(ca.DM(change), speed)) == pytest.approx(-np.sum(change**2) - speed**2)
        position, goal = rng.normal(size=3), rng.normal(size=2)
        way = np.array([corners[:, 0].mean() + goal[0], goal[1]]) - position[[0, 2]]
        reward = pouring.moved_to_pour(ca.DM(position), ca.DM(goal), ca.DM(corners.ravel()))
        assert float(reward) == pytest.approx(-0.1 * way @ way, rel=1e-12)


# The graph

FIGURE_8 = {
    "start": ["grasped"],
    "grasped": ["at_receiver", "receiver_moved"],
    "receiver_moved": [],
    "at_receiver": ["at_pour"],
    "at_pour": ["ready"],
    "ready": ["tipped", "shaken"],
    "tipped": ["tip_bounded"],
    "shaken": ["shake_bounded"],
    "tip_bounded": ["released"],
    "shake_bounded": ["released"],
    "released": ["landed"],
    "landed": ["poured"],
    "poured": [],
}


def ways(tree):
    """{node: the nodes that it leads to}, the same wherever it stands in the tree."""
    found = {}
    for node in tree.nodes:
        children = [tree.nodes[b.child].name for g in node.groups for b in g.branches if b.child is not None]
        assert found.setdefault(node.name, children) == children
    return found


def test_the_graph_is_that_of_figure_8_with_nodes_for_what_follows_from_the_flow():
    tree = sg.unroll(plain_graph())
    assert ways(tree) == FIGURE_8
    later = [node for node in FIGURE_8 if node not in ("start", "grasped", "receiver_moved")]
    assert ways(sg.unroll(plain_graph(), start="at_receiver")) == {node: FIGURE_8[node] for node in later}
    rewards = {
        node: [b.model.name for g in groups for b in g.branches if g.kind == "reward"]
        for node, groups in plain_graph().groups.items()
    }
    assert {node: names for node, names in rewards.items() if names} == {
        "receiver_moved": ["receiver_moved"],
        "at_pour": ["moved_to_pour"],
        "poured": ["R_amount"],
    }


def test_both_skills_share_one_model_of_amounts():
    flow, release, shared = pouring.networks()
    graph = pouring.graph(flow, release, shared)
    (ready,) = (group for group in graph.groups["ready"] if group.kind == "choose")
    assert {b.label: b.model.learner for b in ready.branches} == flow
    for skill in SKILLS:
        ((branch,),) = (group.branches for group in graph.groups[f"{skill}_bounded"])
        assert branch.model.learner is release[skill]
    ((branch,),) = (group.branches for group in graph.groups["landed"])
    assert branch.model.learner is shared


def test_flows_of_another_skill_are_refused():
    with pytest.raises(ValueError, match=r"skill is 'stir'; choose from \['tip', 'shake'\]"):
        pouring.flow_network("stir")
    with pytest.raises(ValueError, match=r"skill is 'stir'; choose from \['tip', 'shake'\]"):
        pouring.release_network("stir")


def test_networks_are_named_and_take_options():
    tip, shared = pouring.flow_network("tip", hidden=(5,)), pouring.amount_network(name="amounts", samples_needed=7)
    assert (tip.name, tip.hidden) == ("F_flow_tip", (5,))
    assert (shared.name, shared.samples_needed) == ("amounts", 7)
    assert "search_rate" in tip.reads
    assert "search_rate" not in pouring.flow_network("shake").reads


# Plans

TARGET, RECEIVER = 0.28, (0.8, 0.2)  # x of the receiver, height of its rim


def start_state():
    corners = [(RECEIVER[0] + x, y, RECEIVER[1]) for x, y in ((0.15, 0.2), (-0.15, 0.2), (-0.15, -0.2), (0.15, -0.2))]
    return {
        "receiver_corners": np.ravel(corners),
        "receiver_size": (0.3, 0.4, RECEIVER[1]),
        "waypoint": (RECEIVER[0] - 0.3, RECEIVER[1] + 0.35),
        "mouth": 0.2,
        "material": np.zeros(4),
        "target_change": TARGET,
        "released": 0.0,
    }


def steps(label, count, element=0):
    return np.linspace(ACTIONS[label].low[element], ACTIONS[label].high[element], count)


def grid_search(skill):
    """The best value of a fine grid and where it is: everything written anew."""
    x, z = steps("pour_position", 36), steps("pour_position", 24, 1)
    if skill == "tip":
        u, v, w = steps("tilt_rate", 41), steps("search_rate", 61), np.zeros(1)
    else:
        u, v, w = steps("shake_speed", 21), steps("shake_stroke", 11), steps("shake_stroke", 41, 1)
    x, u, v, w = np.meshgrid(x, u, v, w, indexing="ij", sparse=True)
    if skill == "tip":
        released, aside, wide = 12 * u + 40 * v, x + 0.2, 100 * (u - 0.013) ** 2
    else:
        released, aside, wide = 0.2 * u + 0.5 * v, x + 0.2 + 0.05 * np.sin(w), 0.001
    spilled = released * (5 * aside**2 + 100 * wide)
    value = paper_reward(released - spilled, spilled, TARGET) - 0.1 * (x + 0.3) ** 2
    best = np.unravel_index(np.argmax(value), value.shape)
    height = -0.1 * (z - 0.55) ** 2  # of the waypoint; the height matters nowhere else
    where = [np.ravel(axis)[i] for axis, i in zip((x, u, v, w), best, strict=True)]
    return value[best] + height.max(), [where[0], z[height.argmax()], *where[1:]]


@pytest.fixture(scope="module")
def plan():
    return sg.solve(objective_of(plain_graph(), compiled=True), start_state(), progress=False)


def test_the_plan_is_the_best_of_a_grid(plan):
    values = {skill: grid_search(skill) for skill in SKILLS}
    assert values["tip"][0] > values["shake"][0]
    assert plan.selections == {"skill": "tip"}
    value, (x, z, tilt, search, _) = values["tip"]
    assert 0.0 <= plan.value - value < 2e-3  # a grid misses an optimum by a step: 100 · (0.002)² and less
    np.testing.assert_allclose(plan.actions["pour_position"], (x, z), atol=0.011)  # a step is 0.01
    assert plan.actions["tilt_rate"] == pytest.approx(tilt, abs=3e-4)
    assert plan.actions["search_rate"] == pytest.approx(search, abs=1.5e-4)


def test_each_skill_alone_is_planned_as_the_grid_says():
    objective = objective_of(plain_graph(), compiled=True)
    for skill in SKILLS:
        plan = sg.solve(objective, start_state(), fixed={"skill": skill}, progress=False)
        assert 0.0 <= plan.value - grid_search(skill)[0] < 2e-3


def test_a_plan_from_the_receiver_is_the_rest_of_the_plan(plan):
    """The grasp costs nothing here, so what is left to decide is the same."""
    objective = objective_of(plain_graph(), compiled=True, start="at_receiver")
    state = {label: value for label, value in start_state().items() if label != "waypoint"}
    state |= {"position": (RECEIVER[0] - 0.3, 0.0, RECEIVER[1] + 0.35), "grasp_height": 0.2}
    later = sg.solve(objective, state, progress=False)
    assert later.value == pytest.approx(plan.value, abs=1e-6)
    assert later.selections == plan.selections
    np.testing.assert_allclose(later.actions["pour_position"], plan.actions["pour_position"], atol=1e-3)


def test_a_bonus_decides_between_the_skills(plan):
    objective = objective_of(plain_graph(shaped=True), compiled=True)
    for skill, bonus in (("tip", (10.0, 0.0)), ("shake", (0.0, 10.0))):
        shaped = sg.solve(objective, {**start_state(), "bonus": bonus}, progress=False)
        assert shaped.selections == {"skill": skill}
        assert 0.0 <= shaped.value - 10 - grid_search(skill)[0] < 2e-3
    neither = sg.solve(objective, {**start_state(), "bonus": (0.0, 0.0)}, progress=False)
    assert neither.selections == plan.selections
    assert neither.value == pytest.approx(plan.value, abs=1e-6)


def test_without_samples_a_plan_explores():
    objective = objective_of(network_graph())
    plan = sg.solve(objective, start_state(), progress=False)
    assert plan.status.startswith("exploring: ")
    for name in ("F_flow_tip", "F_flow_shake", "F_amount"):
        assert f"model {name!r} has 0 of 3 samples" in plan.status
    for label, bounds in ACTIONS.items():
        assert (np.ravel(plan.actions[label]) >= bounds.low).all()
        assert (np.ravel(plan.actions[label]) <= bounds.high).all()
