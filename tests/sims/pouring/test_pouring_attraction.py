"""Attraction: the formula, Newton's third law, and what it costs."""

import os
import subprocess
import sys
import time

import numpy as np
import pytest

from sims.pouring.attraction import Attraction
from sims.pouring.geometry import SPHERE_RADIUS, SPHERES, Receiver, Source
from sims.pouring.materials import MATERIALS
from sims.pouring.simulation import Simulation


def pair_by_pair(positions, material):
    """The definition, one pair after the other."""
    mass = 4 / 3 * np.pi * SPHERE_RADIUS**3
    accelerations = np.zeros_like(positions)
    for i, here in enumerate(positions):
        for j, there in enumerate(positions):
            distance = np.linalg.norm(there - here)
            if i != j and distance < material.reach:
                strength = material.attraction / mass / max(distance, SPHERE_RADIUS) ** 2
                accelerations[i] += strength * (there - here)
    return accelerations


@pytest.mark.parametrize("name", ["vsc", "vsc+"])
def test_it_is_the_sum_over_pairs(name):
    positions = np.random.default_rng(0).uniform(0.0, 0.4, (SPHERES, 3)) + (2.0, 0.0, 0.0)
    material = MATERIALS[name]
    accelerations = Attraction(material, SPHERES).accelerations(positions)
    assert np.allclose(accelerations, pair_by_pair(positions, material), rtol=1e-10, atol=1e-12)
    assert np.allclose(accelerations.sum(axis=0), 0.0, atol=1e-12)


@pytest.mark.parametrize(("name", "share"), [("vsc", 0.076), ("vsc+", 0.458)])
def test_two_touching_spheres_pull_with_the_published_share_of_their_weight(name, share):
    positions = np.array([[0.0, 0.0, 0.0], [2 * SPHERE_RADIUS, 0.0, 0.0]])
    pull = Attraction(MATERIALS[name], 2).accelerations(positions)[0, 0]
    assert pull == pytest.approx(share, abs=0.001)  # gravity is 1


def test_other_processors_round_it_alike():
    """BLAS stands for them: it chooses its kernels, and with them the order of its sums, by the processor."""
    script = """
import hashlib
import numpy as np
from sims.pouring.attraction import Attraction
from sims.pouring.materials import MATERIALS
positions = np.random.default_rng(0).uniform(0.0, 0.4, (100, 3))
accelerations = Attraction(MATERIALS["vsc"], 100).accelerations(positions)
print(hashlib.sha256(accelerations.tobytes()).hexdigest())
"""
    digests = {
        subprocess.run(
            [sys.executable, "-c", script],
            env=os.environ | {"OPENBLAS_CORETYPE": kind},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for kind in ("Nehalem", "Sandybridge")
    }
    assert len(digests) == 1


def test_materials_without_attraction_need_no_computing():
    assert not Attraction(MATERIALS["wat"], SPHERES).active
    assert Attraction(MATERIALS["vsc"], SPHERES).active


@pytest.mark.slow
def test_it_takes_less_than_a_tenth_of_a_step():
    simulation = Simulation(MATERIALS["vsc"], Source(0.13), Receiver())
    simulation.fill(0.8, np.random.default_rng(0))
    command = simulation.pose.copy()
    attraction = Attraction(MATERIALS["vsc"], SPHERES)
    begin = time.process_time()
    for _ in range(200):
        simulation.step(command)
    step = time.process_time() - begin
    begin = time.process_time()
    for _ in range(200):
        attraction.accelerations(simulation.positions)
    assert time.process_time() - begin < 0.1 * step
