"""Physics: walls hold at the highest speed, and no sphere is faster."""

import numpy as np
import pytest

from sims.pouring.geometry import INNER, WALL, Receiver, Source
from sims.pouring.materials import Material
from sims.pouring.scene import TIME_STEP
from sims.pouring.simulation import SPHERE_SPEED_LIMIT, Simulation

RECEIVER_X = 0.8
INSIDE = Receiver().size[0] / 2 - WALL  # the receiver's inner face, from its centre


@pytest.fixture(scope="module")
def simulation():
    """A simulation of the bounciest material; the source stands upright at x = 0."""
    simulation = Simulation(Material(0.7, 0.1, 0.0, 0.1), Source(0.25), Receiver())
    simulation.fill(RECEIVER_X, np.random.default_rng(0))
    return simulation


def shoot(simulation, x, speed):
    """Let one sphere fly along x, all others lying far away; return its x and the highest speed on the way."""
    simulation.positions[:] = np.stack([np.arange(100) * 0.2, np.full(100, 5.0), np.full(100, 0.025)], axis=1)
    simulation.velocities[:] = 0.0
    simulation.positions[0], simulation.velocities[0] = (x, 0.0, 0.15), (speed, 0.0, 0.0)
    fastest = 0.0
    for _ in range(16):
        simulation.step(simulation.pose)
        fastest = max(fastest, float(np.linalg.norm(simulation.velocities[0])))
    return float(simulation.positions[0, 0]), fastest


@pytest.mark.parametrize("phase", np.linspace(0.0, 1.0, 16, endpoint=False))
def test_walls_hold_at_the_highest_speed(simulation, phase):
    ahead = phase * SPHERE_SPEED_LIMIT * TIME_STEP  # where in a physics step the wall is met
    assert shoot(simulation, 0.05 + ahead, SPHERE_SPEED_LIMIT)[0] < INNER
    centre = float(simulation.receiver_pose[0])
    assert shoot(simulation, centre + ahead, SPHERE_SPEED_LIMIT)[0] < simulation.receiver_pose[0] + INSIDE
    centre = float(simulation.receiver_pose[0])
    assert shoot(simulation, centre + 0.4 - ahead, -SPHERE_SPEED_LIMIT)[0] > simulation.receiver_pose[0] + INSIDE


def test_a_flung_sphere_is_slowed(simulation):
    before = simulation.slowed
    _, fastest = shoot(simulation, 2.0, 4.0)
    assert fastest == pytest.approx(SPHERE_SPEED_LIMIT, abs=0.01)
    assert simulation.slowed > before
