"""What is observed: the labels of the pouring task, read off the behaviour and its simulation."""

from __future__ import annotations

import numpy as np

from sims.pouring.behaviour import SPHERE_AMOUNT, SPILL_AMOUNT, Behaviour
from sims.pouring.geometry import SPHERES

Value = float | np.ndarray
Observation = dict[str, Value]


def setting(behaviour: Behaviour, target: float) -> Observation:
    """What is given with an episode: where the trials start, how much to pour, containers and material."""
    simulation = behaviour.simulation
    return {
        "waypoint": behaviour.waypoint,
        "target": target,
        "mouth": simulation.source.mouth,
        "material": simulation.material.features,
        "receiver_size": np.array(simulation.receiver.size),
    }


def situation(behaviour: Behaviour, target: float) -> Observation:
    """Where the containers are and how much has been poured, at the beginning of a trial."""
    amounts = totals(behaviour)
    return places(behaviour) | amounts | {"target_change": target - amounts["poured"]}


def places(behaviour: Behaviour) -> Observation:
    """Corners of the receiver's rim and position of the source's shoulder."""
    simulation = behaviour.simulation
    x, z, _ = simulation.pose
    return {
        "receiver_corners": simulation.receiver.corners(simulation.receiver_pose),
        "position": np.array([x, 0.0, z]),
    }


def relative_position(behaviour: Behaviour) -> Observation:
    """Position of the shoulder relative to the middle of the receiver's rim."""
    simulation = behaviour.simulation
    x, z, _ = simulation.pose
    receiver_x, receiver_y, _ = simulation.receiver_pose
    return {"relative_position": np.array([x - receiver_x, -receiver_y, z - simulation.receiver.rim])}


def totals(behaviour: Behaviour) -> Observation:
    """Amounts in the receiver, spilled and out of the source since the episode began."""
    census = behaviour.census
    return {
        "poured": SPHERE_AMOUNT * census.in_receiver,
        "spilled": SPILL_AMOUNT * census.spilled,
        "released": SPHERE_AMOUNT * (SPHERES - census.in_source),
    }


def flow(behaviour: Behaviour) -> Observation:
    """Where and how widely the flow of this trial came down at the height of the rim.

    If nothing flowed, the centre is the middle of the mouth where the skill ended: the place it would have
    left from.
    """
    census, trial = behaviour.census, behaviour.trial
    landings = census.landings
    centre = landings.mean(axis=0) if len(landings) else np.array([trial.mouth, 0.0])
    return {
        "flow_centre": centre,
        "flow_variance": float(((landings - centre) ** 2).sum(axis=1).mean()) if len(landings) else 0.0,
    }


def released(behaviour: Behaviour) -> Observation:
    """How much left the source in this trial."""
    census, trial = behaviour.census, behaviour.trial
    return {"released_change": SPHERE_AMOUNT * (SPHERES - census.in_source - trial.released)}


def changes(behaviour: Behaviour) -> Observation:
    """What this trial added to the receiver and to the floor."""
    census, trial = behaviour.census, behaviour.trial
    return {
        "poured_change": SPHERE_AMOUNT * (census.in_receiver - trial.poured),
        "spilled_change": SPILL_AMOUNT * (census.spilled - trial.spilled),
    }
