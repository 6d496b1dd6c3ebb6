"""Counting: every class of sphere, and every way to leak, with spheres placed by hand."""

import numpy as np
import pytest

from sims.pouring.census import Census, SphereClass
from sims.pouring.geometry import Receiver, Source
from sims.pouring.materials import MATERIALS
from sims.pouring.simulation import Simulation

RECEIVER_X = 0.8


@pytest.fixture
def scene():
    """A filled simulation at rest and a census of it; the source stands upright at x = 0."""
    simulation = Simulation(MATERIALS["wat"], Source(0.2), Receiver())
    simulation.fill(RECEIVER_X, np.random.default_rng(0))
    census = Census(simulation)
    census.update(simulation)
    return simulation, census


def place(simulation, census, position, velocity=(0.0, 0.0, 0.0), sphere=0):
    simulation.positions[sphere] = position
    simulation.velocities[sphere] = velocity
    census.update(simulation)
    return SphereClass(census.classes[sphere])


def test_all_begin_in_the_source(scene):
    _, census = scene
    assert (census.classes == SphereClass.SOURCE).all()
    assert (census.in_source, census.in_receiver, census.spilled, census.flowing) == (100, 0, 0, 0)
    assert not census.leaked


def test_a_sphere_flows_is_received_and_counted_once(scene):
    simulation, census = scene
    place(simulation, census, (0.0, 0.0, 0.53))
    assert place(simulation, census, (0.1, 0.0, 0.65), (0.3, 0, 0)) is SphereClass.FLOWING
    assert census.flowing == 1
    assert place(simulation, census, (0.75, 0.1, 0.3), (0.3, 0, -0.5)) is SphereClass.FLOWING
    assert len(census.landings) == 0
    assert place(simulation, census, (0.78, 0.1, 0.21), (0.3, 0, -0.5)) is SphereClass.BOUNCED
    assert np.allclose(census.landings, [[-0.02, 0.1]])
    assert census.in_receiver == 1
    assert census.flowing == 0
    assert place(simulation, census, (0.8, 0.1, 0.05)) is SphereClass.RECEIVED
    assert census.in_receiver == 1
    assert census.in_source == 99
    census.start_trial()
    assert len(census.landings) == 0


def test_the_heap_above_the_rim_counts_when_it_rests(scene):
    simulation, census = scene
    assert place(simulation, census, (0.8, 0.0, 0.35)) is SphereClass.RECEIVED
    assert census.in_receiver == 1
    place(simulation, census, (0.8, 0.0, 0.35), (0.0, 0.0, 0.5))
    assert census.in_receiver == 0


def test_spheres_in_a_source_above_the_receiver_are_not_poured(scene):
    simulation, census = scene
    simulation.pose[:] = [RECEIVER_X + 0.15, 0.7, 0.0]
    simulation.positions[:, 0] += RECEIVER_X
    simulation.positions[:, 2] += 0.2
    census.update(simulation)
    assert census.in_source == 100
    assert census.in_receiver == 0


def test_spilled_spheres_stay_spilled(scene):
    simulation, census = scene
    assert place(simulation, census, (0.4, 0.0, 0.025)) is SphereClass.SPILLED
    place(simulation, census, (4.0, 0.0, 0.5), sphere=1)
    assert census.spilled == 2
    place(simulation, census, (0.4, 0.0, 0.2))
    assert census.spilled == 2


def test_resting_outside_is_neither_flow_nor_spill(scene):
    simulation, census = scene
    assert place(simulation, census, (0.4, 0.0, 0.3)) is SphereClass.BOUNCED
    assert census.spilled == 0


def test_a_pile_beside_the_receiver_is_spilled(scene):
    simulation, census = scene
    assert place(simulation, census, (0.99, 0.0, 0.12), (0.0, 0.0, -0.5)) is SphereClass.FLOWING
    assert place(simulation, census, (0.99, 0.0, 0.12)) is SphereClass.SPILLED


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ((0.1, 0.0, 0.2), (0.2, 0.0, 0.2)),  # through the source's wall
        ((0.0, 0.0, 0.03), (0.0, 0.0, -0.03)),  # through its bottom
        ((0.11, 0.0, 0.5), (0.16, 0.0, 0.53)),  # through its lip
        ((0.8, 0.0, 0.1), (1.0, 0.0, 0.1)),  # out of the receiver
        ((0.8, 0.3, 0.1), (0.8, 0.1, 0.1)),  # into it
        ((0.4, 0.0, 0.0), (0.4, 0.0, -0.03)),  # through the floor
    ],
)
def test_leaks_are_noticed(scene, before, after):
    simulation, census = scene
    place(simulation, census, before)
    census.leaked.clear()  # spheres placed by hand may have passed a wall on the way
    place(simulation, census, after)
    assert census.leaked == {0}


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ((0.0, 0.0, 0.53), (0.05, 0.0, 0.57)),
        ((0.6, 0.0, 0.3), (0.7, 0.0, 0.25)),
        ((0.8, 0, 0.2), (0.96, 0, 0.23)),
    ],
)
def test_proper_ways_are_no_leaks(scene, before, after):
    simulation, census = scene
    place(simulation, census, before)
    census.leaked.clear()
    place(simulation, census, after)
    assert not census.leaked


def test_a_dip_into_a_soft_wall_is_no_leak(scene):
    simulation, census = scene
    place(simulation, census, (0.12, 0.0, 0.2))
    census.leaked.clear()
    assert place(simulation, census, (0.155, 0.0, 0.2), (-0.4, 0.0, 0.0)) is SphereClass.SOURCE
    assert place(simulation, census, (0.12, 0.0, 0.2)) is SphereClass.SOURCE
    assert not census.leaked
