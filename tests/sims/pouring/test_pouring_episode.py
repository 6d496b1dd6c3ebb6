"""Whole episodes: alone, side by side, and what physics makes of materials, mouths and skills."""

import numpy as np
import pytest

from sims.pouring import ACTIONS, MATERIALS, SKILLS, End, PouringWorld, run_episode, run_episodes
from sims.pouring.episode import fixed_policy

TIP = {"grasp_ratio": 0.3, "pour_position": (-0.19, 0.33), "tilt_rate": 0.014, "search_rate": 0.003}
SHAKE = {
    "grasp_ratio": 0.3,
    "pour_position": (-0.2, 0.33),
    "tilt_rate": 0.014,
    "shake_speed": 0.75,
    "shake_stroke": (0.06, -1.57),
}


def run(material, mouth, actions, skill, seed=0):
    return run_episode(PouringWorld(material, mouth), fixed_policy(actions, skill), seed, trials=1)


def spheres(episode, metric="fraction_in_receiver"):
    return round(100 * episode.metrics[metric])


def test_an_episode_keeps_every_step():
    episode = run("wat", 0.25, SHAKE, "shake")
    nodes = [node for node, _ in episode.steps]
    assert nodes == [
        "start",
        "grasped",
        "at_receiver",
        "receiver_moved",
        "at_pour",
        "ready",
        "shaken",
        "shake_bounded",
        "released",
        "landed",
        "poured",
    ]
    assert episode.end is End.TARGET
    assert episode.stops == ["target"]


def test_a_failure_ends_the_episode():
    world = PouringWorld("wat", 0.25)

    def policy(node, known):
        if node == "grasped":
            world.behaviour.simulation.velocities[3] = np.nan
        return TIP, {"skill": "tip"}

    episode = run_episode(world, policy, 0)
    assert episode.end is End.FAILED
    assert episode.steps[-1][0] == "failed"
    assert episode.steps[-1][1]["poured"] == 0.0
    assert episode.stops == []


def test_processes_do_not_change_the_results():
    jobs = [({"material": "wat", "mouth": 0.25}, SHAKE, "shake", seed) for seed in (0, 1)]
    alone, together = run_episodes(jobs, 1, processes=1), run_episodes(jobs, 1, processes=2)
    assert [episode.metrics for episode in alone] == [episode.metrics for episode in together]


def test_viscous_material_leaves_a_narrow_mouth_only_when_shaken():
    assert spheres(run("vsc", 0.13, TIP, "tip")) <= 10
    assert spheres(run("vsc", 0.13, SHAKE, "shake")) >= 55


def test_bouncing_material_is_tipped_cleanly_and_shaken_badly():
    tipped, shaken = run("bnc", 0.23, TIP, "tip"), run("bnc", 0.23, SHAKE, "shake")
    assert spheres(tipped) >= 55
    assert spheres(tipped, "fraction_spilled") <= 3
    assert spheres(shaken, "fraction_spilled") >= 10


@pytest.mark.slow
@pytest.mark.parametrize("change", ["attraction", "friction", "mouth"])
def test_jamming_is_physics(change):
    """Less attraction, less friction or a wider mouth bring the flow back."""
    vsc, wat = MATERIALS["vsc"], MATERIALS["wat"]
    eased = {
        "attraction": (type(vsc)(vsc.bounce, vsc.friction, 0.0, vsc.reach), 0.13),
        "friction": (type(vsc)(vsc.bounce, wat.friction / 10, vsc.attraction, vsc.reach), 0.13),
        "mouth": (vsc, 0.25),
    }
    jammed = np.mean([spheres(run(vsc, 0.13, TIP, "tip", seed)) for seed in range(3)])
    flowing = np.mean([spheres(run(*eased[change], TIP, "tip", seed)) for seed in range(3)])
    assert flowing > jammed + 15


@pytest.mark.slow
@pytest.mark.parametrize("skill", SKILLS)
def test_random_actions_leak_nothing_in_varied_setups(skill):
    generator = np.random.default_rng(2)
    size = ((0.22, 0.38), 0.4, (0.14, 0.22))
    world = PouringWorld(tuple(MATERIALS), (0.11, 0.25), (0.1, 0.4), receiver_size=size, blend=True)
    for seed in range(15):
        actions = {label: generator.uniform(bounds.low, bounds.high) for label, bounds in ACTIONS.items()}
        episode = run_episode(world, fixed_policy(actions, skill), seed, trials=1)
        assert episode.end is not End.FAILED
        assert episode.metrics["leaked_particles"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("skill", SKILLS)
def test_random_actions_leak_nothing(skill):
    generator = np.random.default_rng(1)
    for seed in range(15):
        actions = {label: generator.uniform(bounds.low, bounds.high) for label, bounds in ACTIONS.items()}
        material, mouth = str(generator.choice(list(MATERIALS))), float(generator.uniform(0.11, 0.25))
        episode = run(material, mouth, actions, skill, seed)
        assert episode.end is not End.FAILED
        assert episode.metrics["leaked_particles"] == 0
