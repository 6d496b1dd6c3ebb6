"""The world's protocol: nodes and labels, clamps, failures, determinism, save and restore."""

import hashlib
import pickle
import subprocess
import sys

import numpy as np
import pytest

from sims.pouring import ACTIONS, MATERIALS, End, Material, PouringWorld, SimulationFailed, behaviour
from sims.pouring.behaviour import TRANSITIONS, Phase

VARIED = {
    "material": tuple(MATERIALS),
    "mouth": (0.11, 0.25),
    "target": (0.1, 0.4),
    "receiver_size": ((0.22, 0.38), 0.4, (0.14, 0.22)),
    "blend": True,
}
ACTION = {
    "grasp_ratio": 0.3,
    "pour_position": (-0.2, 0.33),
    "tilt_rate": 0.02,
    "search_rate": 0.005,
    "shake_speed": 0.75,
    "shake_stroke": (0.06, -1.57),
}
# Sizes of what is observed at the start and on every edge: the inputs and outputs of the paper's edge models.
START_SIZES = {
    "receiver_corners": 12,
    "waypoint": 2,
    "position": 3,
    "poured": 1,
    "spilled": 1,
    "released": 1,
    "target": 1,
    "target_change": 1,
    "mouth": 1,
    "material": 4,
    "receiver_size": 3,
}
EDGE_SIZES = {
    "grasped": {"grasp_height": 1},
    "at_receiver": {"receiver_corners": 12, "position": 3},
    "receiver_moved": {"receiver_corner_change": 12, "receiver_speed": 1},
    "at_pour": {"relative_position": 3},
    "ready": {},
    "shaken": {"flow_centre": 2, "flow_variance": 1},
    "shake_bounded": {},
    "released": {"released_change": 1},
    "landed": {},
    "poured": {"poured_change": 1, "spilled_change": 1},
}


def sizes(observed):
    return {label: np.size(value) for label, value in observed.items()}


def digest(world):
    return hashlib.sha256(world.behaviour.simulation.data.qpos.tobytes()).hexdigest()


def advance(world, until, skill="shake", actions=ACTION):
    """Execute node after node up to one; return all that was observed on the way, node -> observation."""
    seen = {}
    while world.node != until:
        seen |= world.execute(world.node, actions, {"skill": skill})
    return seen


@pytest.fixture(scope="module")
def shaken():
    """A world that has poured water through a wide mouth, and what it observed on every edge."""
    world = PouringWorld("wat", 0.25, receiver_x=0.7)
    start = world.reset(5)
    return world, start, advance(world, "poured")


def test_every_edge_observes_its_labels(shaken):
    _, start, seen = shaken
    assert sizes(start) == START_SIZES
    assert {node: sizes(observed) for node, observed in seen.items()} == EDGE_SIZES
    scalars = [value for observed in (start, *seen.values()) for value in observed.values() if np.size(value) == 1]
    assert all(isinstance(value, float) for value in scalars)


def test_what_is_observed_agrees_with_itself(shaken):
    world, start, seen = shaken
    assert start["target"] == start["target_change"] == 0.3
    assert start["receiver_corners"].reshape(4, 3).mean(axis=0) == pytest.approx([0.7, 0.0, 0.2])
    assert start["waypoint"] == pytest.approx([0.4, 0.55])
    assert seen["grasped"]["grasp_height"] == pytest.approx(0.05 + 0.3 * 0.4)
    assert seen["at_receiver"]["position"] == pytest.approx([0.4, 0.0, 0.55], abs=0.01)
    assert seen["at_pour"]["relative_position"] == pytest.approx([-0.2, 0.0, 0.13], abs=0.01)
    assert seen["receiver_moved"]["receiver_corner_change"] == pytest.approx(np.zeros(12), abs=1e-6)
    census = world.behaviour.census
    assert seen["poured"]["poured_change"] == pytest.approx(0.0055 * census.in_receiver)
    assert seen["poured"]["poured_change"] > 0.3
    assert seen["poured"]["spilled_change"] == pytest.approx(0.1 * census.spilled)
    assert seen["released"]["released_change"] >= seen["poured"]["poured_change"]
    assert np.abs(seen["shaken"]["flow_centre"]).max() < 0.1
    assert 0.0 < seen["shaken"]["flow_variance"] < 0.05
    assert not census.leaked
    assert world.metrics["fraction_in_receiver"] == census.in_receiver / 100


def test_an_episode_ends_when_the_target_is_reached(shaken):
    world, _, _ = shaken
    assert world.execute("poured", {}) == {}
    assert world.end is End.TARGET
    with pytest.raises(ValueError, match=r"the episode is over .target reached.; call reset"):
        world.execute("poured", {})


def test_transitions_are_those_of_the_behaviour():
    assert set(TRANSITIONS) == set(Phase)
    assert TRANSITIONS[Phase.READY] == (Phase.TIPPED, Phase.SHAKEN)
    assert TRANSITIONS[Phase.POURED] == (Phase.AT_RECEIVER,)


def test_the_trial_loop_goes_on_where_the_target_is_missed():
    world = PouringWorld("vsc", 0.11, target=0.02, receiver_x=0.7)
    world.reset(0)
    # Straight over the rim nothing can be poured from so far away.
    seen = advance(world, "poured", "tip", ACTION | {"pour_position": (-0.35, 0.55)})
    assert world.behaviour.trial.stopped == "no flow"
    again = world.execute("poured", {})["at_receiver"]
    assert sizes(again) == {
        "receiver_corners": 12,
        "position": 3,
        "poured": 1,
        "spilled": 1,
        "released": 1,
        "target_change": 1,
    }
    assert world.node == "at_receiver"
    assert again["target_change"] == pytest.approx(0.02 - again["poured"])
    assert again["released"] == pytest.approx(seen["released"]["released_change"])


def test_a_stuck_attempt_ends_early_with_the_same_outcome(monkeypatch):
    outcomes, durations = [], []
    for speed in (behaviour.REST_SPEED, 0.0):  # at speed 0 nothing ever counts as resting
        monkeypatch.setattr(behaviour, "REST_SPEED", speed)
        world = PouringWorld("vsc+", 0.13, receiver_x=0.7)
        world.reset(1)
        advance(world, "poured", "tip")
        census = world.behaviour.census
        outcomes.append((census.in_receiver, census.spilled, census.in_source, world.behaviour.trial.stopped))
        durations.append(world.behaviour.trial.duration)
        monkeypatch.undo()
    assert durations[0] < durations[1] - 3.0
    assert outcomes[0] == outcomes[1]
    assert outcomes[0][3] == "no flow"


def test_the_time_limit_ends_the_episode():
    world = PouringWorld("vsc+", 0.11, receiver_x=0.7, time_limit=6.0)
    world.reset(0)
    advance(world, "poured", "tip")
    assert world.behaviour.trial.stopped == "time"
    assert world.execute("poured", {}) == {}
    assert world.end is End.TIME


def test_commands_outside_the_bounds_are_clamped_and_reported():
    world = PouringWorld("wat", 0.25, receiver_x=0.7)
    world.reset(0)
    observed = world.execute("start", {"grasp_ratio": 7.0})
    assert observed["grasped"]["grasp_height"] == pytest.approx(0.45)
    world.execute("grasped", {})
    observed = world.execute("at_receiver", {"pour_position": (-9.0, -9.0)})
    assert observed["at_pour"]["relative_position"] == pytest.approx([-0.35, 0.0, 0.12], abs=0.01)
    assert [(clamp.label, clamp.asked, clamp.used) for clamp in world.clamps] == [
        ("grasp_ratio", (7.0,), (1.0,)),
        ("pour_position", (-9.0, -9.0), (-0.35, 0.32)),
    ]


def test_a_source_that_would_hit_the_receiver_is_raised_and_reported():
    world = PouringWorld("wat", 0.25, receiver_x=0.7, time_limit=12.0)
    world.reset(0)
    advance(world, "ready", actions=ACTION | {"pour_position": (-0.3, 0.32)})
    world.execute("ready", ACTION | {"shake_stroke": (0.1, -1.57)}, {"skill": "shake"})
    lifts = [clamp.used[0] for clamp in world.clamps if clamp.label == "lift"]
    assert lifts
    assert 0.0 < max(lifts) < 0.2


def test_a_push_moves_the_receiver():
    world = PouringWorld("wat", 0.25, receiver_x=0.7)
    world.reset(0)
    advance(world, "tipped", "tip", ACTION | {"grasp_ratio": 0.5, "pour_position": (0.0, 0.32)})
    assert world.behaviour.simulation.receiver_pose[0] > 0.71


@pytest.mark.parametrize(
    ("node", "actions", "selections", "words"),
    [
        ("ready", {}, {}, "the episode stands at 'start'"),
        ("start", {"grasp": 0.5}, {}, r"action 'grasp_ratio' is missing; given are \['grasp'\]"),
        ("start", {"grasp_ratio": float("nan")}, {}, "give finite numbers"),
        ("start", {"grasp_ratio": (0.1, 0.2)}, {}, r"has shape \(2,\); give 1 number"),
    ],
)
def test_wrong_calls_are_named_and_change_nothing(node, actions, selections, words):
    world = PouringWorld("wat", 0.25, receiver_x=0.7)
    world.reset(0)
    before = digest(world)
    with pytest.raises(ValueError, match=words):
        world.execute(node, actions, selections)
    assert world.node == "start"
    assert digest(world) == before


def test_an_unknown_skill_is_named():
    world = PouringWorld("wat", 0.25, receiver_x=0.7)
    world.reset(0)
    advance(world, "ready")
    with pytest.raises(ValueError, match=r"'skill' is 'stir'; choose from \['tip', 'shake'\]"):
        world.execute("ready", ACTION, {"skill": "stir"})


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"mouth": 0.3}, "mouth: 0.3 is not a number or .low, high. from 0.11 to 0.25"),
        ({"target": (0.4, 0.2)}, "target"),
        ({"material": ()}, "give at least one material"),
        ({"receiver_x": 2.0}, "receiver_x"),
        ({"receiver_size": (0.3, 0.4)}, "receiver_size: .0.3, 0.4. is not length, width, height; give three values"),
        ({"receiver_size": (0.3, (0.4, 0.2), 0.2)}, "receiver_size: .0.4, 0.2. is not a number or .low, high."),
        ({"receiver_size": (0.3, 0.4, (0.05, 0.2))}, "from 0.1 to 1"),
        ({"material": "wat", "blend": True}, "blend: .'wat',. has nothing to blend; give at least two different"),
        ({"material": ("wat", "wat"), "blend": True}, "nothing to blend"),
    ],
)
def test_wrong_arguments_are_named(arguments, words):
    with pytest.raises(ValueError, match=words):
        PouringWorld(**arguments)


def test_a_world_that_has_not_begun_says_so():
    world = PouringWorld()
    with pytest.raises(ValueError, match="call reset"):
        world.execute("start", ACTION)
    world.reset(0)
    world.close()
    with pytest.raises(ValueError, match="call reset"):
        world.node  # noqa: B018


def test_resets_draw_what_is_not_fixed():
    world = PouringWorld(("wat", "vsc", Material(0.5, 0.2, 0.0, 0.1)), (0.11, 0.25), (0.2, 0.4))
    starts = [world.reset(seed) for seed in range(6)]
    assert len({start["mouth"] for start in starts}) == 6
    assert all(0.2 <= start["target"] <= 0.4 for start in starts)
    assert len({start["material"][0] for start in starts}) > 1
    fixed = PouringWorld("wat", (0.11, 0.25), 0.3).reset(3)
    assert fixed["mouth"] == starts[3]["mouth"]
    assert np.array_equal(fixed["receiver_corners"], starts[3]["receiver_corners"])


@pytest.mark.parametrize("varied", [{}, {"receiver_size": VARIED["receiver_size"]}, {"blend": True}])
def test_what_older_setups_draw_stays_as_it_was(varied):
    """Episodes that were published by their seed must not change when a reset learns to draw more."""
    names = ("wat", "vsc", "bnc")
    world = PouringWorld(names, (0.11, 0.25), (0.2, 0.4), **varied)
    for seed in range(4):
        generator = np.random.default_rng(seed)  # one after the other, as before there was more to draw
        mouth, target, x = (generator.uniform(low, high) for low, high in ((0.11, 0.25), (0.2, 0.4), (0.5, 1.1)))
        material = MATERIALS[names[generator.integers(3)]]
        start = world.reset(seed)
        assert (start["mouth"], start["target"]) == (mouth, target)
        assert start["receiver_corners"][0::3].mean() == pytest.approx(x, abs=1e-12)
        if "receiver_size" not in varied:
            assert start["receiver_size"].tolist() == [0.3, 0.4, 0.2]
        if "blend" not in varied:
            assert np.array_equal(start["material"], material.features)


def test_resets_draw_a_receiver_and_what_is_observed_of_it_agrees():
    world = PouringWorld(**VARIED)
    starts = [world.reset(seed) for seed in range(6)]
    sizes = np.array([start["receiver_size"] for start in starts])
    assert len(set(sizes[:, 0])) == len(set(sizes[:, 2])) == 6
    assert ((sizes >= [0.22, 0.4, 0.14]) & (sizes <= [0.38, 0.4, 0.22])).all()
    for start, size in zip(starts, sizes, strict=True):
        corners = start["receiver_corners"].reshape(4, 3)
        assert np.ptp(corners[:, :2], axis=0) == pytest.approx(size[:2])
        assert corners[:, 2] == pytest.approx(size[2])
        assert start["waypoint"] == pytest.approx([corners[:, 0].mean() - 0.3, size[2] + 0.35])
        assert 0.1 <= start["target"] == start["target_change"] <= 0.4
    # What else is drawn, and how many there are to draw it from, changes neither the receiver nor the rest.
    fixed = PouringWorld("wat", receiver_size=VARIED["receiver_size"]).reset(3)
    assert np.array_equal(fixed["receiver_corners"], starts[3]["receiver_corners"])


def test_a_blend_lies_between_two_different_materials():
    names = tuple(MATERIALS)
    pure, blended = PouringWorld(names), PouringWorld(names, blend=True)
    shares, pairs = [], set()
    for seed in range(12):
        first, seen = pure.reset(seed)["material"], blended.reset(seed)["material"]
        ways = {name: material.features - first for name, material in MATERIALS.items()}
        ways = {name: way for name, way in ways.items() if way.any()}
        found = {name: (seen - first) @ way / (way @ way) for name, way in ways.items()}
        found = {name: share for name, share in found.items() if np.allclose(first + share * ways[name], seen)}
        assert len(found) == 1
        pairs.add((tuple(first), *found))
        shares += found.values()
    assert all(0.0 <= share <= 1.0 for share in shares)
    assert max(shares) - min(shares) > 0.5
    assert len(pairs) > 4


def test_the_way_over_a_low_receiver_is_no_clamped_command():
    world = PouringWorld("wat", 0.25, receiver_x=0.5, receiver_size=(0.3, 0.4, 0.14))
    start = world.reset(0)
    seen = advance(world, "at_receiver")["at_receiver"]
    assert world.behaviour.simulation.lifted > 0.0  # the tilting source had to clear the floor
    assert world.clamps == []
    assert seen["position"] == pytest.approx([start["waypoint"][0], 0.0, start["waypoint"][1]], abs=0.005)
    observed = world.execute("at_receiver", ACTION)["at_pour"]
    assert observed["relative_position"] == pytest.approx([-0.2, 0.0, 0.33 - 0.14], abs=0.005)


def test_a_failed_simulation_ends_the_episode_with_what_was_measured():
    world = PouringWorld("wat", 0.25, receiver_x=0.7)
    world.reset(0)
    advance(world, "ready")

    def break_physics(simulation):
        if world.behaviour.census.flowing > 3:
            simulation.velocities[0, 0] = np.nan

    world.behaviour.simulation.listeners.append(break_physics)
    with pytest.raises(SimulationFailed, match="not finite at time") as failure:
        world.execute("ready", ACTION, {"skill": "shake"})
    assert world.end is End.FAILED
    observed = failure.value.observed
    assert {"poured", "spilled", "released", "released_change", "poured_change"} <= set(observed)
    assert observed["released"] > 0.0
    assert all(np.isfinite(value).all() for value in observed.values())
    with pytest.raises(ValueError, match="simulation failed"):
        world.execute("ready", ACTION, {"skill": "shake"})
    world.reset(0)
    assert world.end is None


def test_the_same_seed_gives_the_same_episode_here_and_in_another_process(shaken):
    world, _, _ = shaken
    again = PouringWorld("wat", 0.25, receiver_x=0.7)
    again.reset(5)
    advance(again, "poured")
    assert digest(again) == digest(world)
    script = f"""
import hashlib
import pickle
from sims.pouring import PouringWorld
world = PouringWorld("wat", 0.25, receiver_x=0.7)
world.reset(5)
while world.node != "poured":
    world.execute(world.node, {ACTION!r}, {{"skill": "shake"}})
print(hashlib.sha256(world.behaviour.simulation.data.qpos.tobytes()).hexdigest())
"""
    other = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert other.stdout.strip() == digest(world)


def test_other_seeds_give_other_episodes():
    world = PouringWorld("wat", 0.25, receiver_x=0.7)
    world.reset(5)
    first = digest(world)
    world.reset(6)
    assert digest(world) != first


def test_an_episode_goes_on_from_a_saved_state(shaken):
    world, _, _ = shaken
    other = PouringWorld("wat", 0.25, receiver_x=0.7)
    other.reset(5)
    advance(other, "ready")
    saved = pickle.loads(pickle.dumps(other.save()))
    advance(other, "poured")
    fresh = PouringWorld("bnc", 0.12)  # another world, which takes over everything
    fresh.restore(saved)
    assert fresh.node == "ready"
    observed = advance(fresh, "poured")
    assert digest(fresh) == digest(other) == digest(world)
    assert observed["poured"]["poured_change"] == pytest.approx(0.0055 * world.behaviour.census.in_receiver)


def test_a_varied_world_goes_back_to_the_receiver_that_it_saved():
    world = PouringWorld(**VARIED)
    start = world.reset(1)
    advance(world, "ready")
    saved = pickle.loads(pickle.dumps(world.save()))
    poured = advance(world, "poured")
    end = digest(world)
    assert not np.array_equal(world.reset(2)["receiver_size"], start["receiver_size"])
    for other in (world, PouringWorld("bnc", 0.12)):
        other.restore(saved)
        assert np.array_equal(other.behaviour.simulation.receiver.size, start["receiver_size"])
        again = advance(other, "poured")
        assert digest(other) == end
        assert again["poured"] == poured["poured"]


def test_physics_goes_on_from_a_state_saved_within_a_skill():
    world = PouringWorld("vsc", 0.2, receiver_x=0.7, time_limit=9.0)
    world.reset(0)
    simulation = world.behaviour.simulation
    saved, commands = [], []

    def record(simulation):
        if simulation.time > 7.0:
            commands.append(simulation.command.copy())
            if not saved:
                saved.append(simulation.save())
                commands.clear()

    simulation.listeners.append(record)
    advance(world, "shaken")
    end = simulation.data.qpos.copy()
    simulation.listeners.clear()
    simulation.restore(saved[0])
    for command in commands:
        simulation.step(command)
    assert np.array_equal(simulation.data.qpos, end)


def test_bounds_and_shares_of_bounds_agree():
    for bounds in ACTIONS.values():
        assert np.allclose(bounds.scale(np.zeros(len(bounds.low))), bounds.low)
        assert np.allclose(bounds.scale(np.ones(len(bounds.low))), bounds.high)
