"""Materials: their ranges, mixtures, and that contacts bounce as asked."""

import mujoco
import numpy as np
import pytest

from sims.pouring.geometry import Receiver, Source
from sims.pouring.materials import MATERIALS, Material, find_material, mix
from sims.pouring.scene import compile_scene
from sims.pouring.simulation import Simulation


@pytest.mark.parametrize("name", MATERIALS)
def test_every_material_has_features_and_a_scene(name):
    material = find_material(name)
    assert material.features.shape == (4,)
    assert compile_scene(material, Source(0.2), Receiver()).nv == 307


def test_a_mixture_lies_between():
    half = mix("wat", "vsc", 0.5)
    assert half.friction == pytest.approx(0.225)
    assert half.attraction == pytest.approx(1.25e-7)
    assert mix("wat", "vsc", 0.0) == MATERIALS["wat"]
    assert mix("wat", "vsc", 1.0) == MATERIALS["vsc"]


def test_wrong_values_are_named():
    with pytest.raises(ValueError, match=r"'oil'; choose from \['wat', 'bnc', 'vsc', 'vsc\+'\]"):
        find_material("oil")
    with pytest.raises(ValueError, match=r"bounce is 1.5; give a number from 0.05 to 0.7"):
        Material(1.5, 0.1, 0.0, 0.1)
    with pytest.raises(ValueError, match=r"share is 2; give a number from 0 to 1"):
        mix("wat", "vsc", 2)


@pytest.mark.parametrize("bounce", [0.2, 0.45, 0.7])
def test_two_spheres_part_with_the_asked_share_of_their_speed(bounce):
    simulation = Simulation(Material(bounce, 0.1, 0.0, 0.1), Source(0.25), Receiver())
    simulation.model.opt.gravity[:] = 0.0
    ratios = []
    try:
        for speed in (0.2, 0.5, 1.0):
            for phase in np.linspace(0.0, 1.0, 8, endpoint=False):
                mujoco.mj_resetData(simulation.model, simulation.data)
                # All but two wait far away, each on its own.
                simulation.positions[:] = np.stack([np.arange(100) * 0.2, np.full(100, 5.0), np.ones(100)], axis=1)
                simulation.positions[:2] = [[0, -5, 1], [0.06 + phase * speed / 80, -5, 1]]
                simulation.velocities[1, 0] = -speed
                mujoco.mj_step(simulation.model, simulation.data, 60)
                ratios.append((simulation.velocities[1, 0] - simulation.velocities[0, 0]) / speed)
    finally:
        simulation.model.opt.gravity[2] = -1.0  # the model is shared with other simulations of the same scene
    assert np.mean(ratios) == pytest.approx(bounce, abs=0.03)
