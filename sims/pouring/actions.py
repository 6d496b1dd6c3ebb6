"""The actions of the pouring task: their labels, bounds and how values are read."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

SKILLS = ("tip", "shake")


@dataclass(frozen=True)
class Bounds:
    """Range and unit of an action.

    Args:
        low: Lowest value of each element.
        high: Highest value of each element.
        unit: Of the elements.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    unit: str

    def scale(self, shares: ArrayLike) -> np.ndarray:
        """Return the values at shares of the range, 0 for the lowest and 1 for the highest."""
        low = np.array(self.low)
        return low + np.asarray(shares, dtype=float) * (np.array(self.high) - low)


ACTIONS = {
    "grasp_ratio": Bounds((0.0,), (1.0,), "share of the source's height"),
    # x of the shoulder relative to the receiver's centre, z above the floor. Lower, the lip would press
    # spheres on the rim; further back, everything falls short.
    "pour_position": Bounds((-0.35, 0.32), (0.0, 0.55), "length"),
    "tilt_rate": Bounds((0.01,), (0.02,), "rad / control step"),
    "search_rate": Bounds((0.002,), (0.005,), "rad / control step"),
    "shake_speed": Bounds((0.7,), (0.9,), "length / time"),
    "shake_stroke": Bounds((0.05, -math.pi / 2), (0.1, math.pi / 2), "length, rad"),
}


@dataclass(frozen=True)
class Clamp:
    """A command that could not be followed as it was given.

    Args:
        label: Of the action, or "lift" if the source had to be raised to clear the receiver's rim, heap or
            the floor.
        asked: The value that was given; 0 for a lift.
        used: What was done instead.
    """

    label: str
    asked: tuple[float, ...]
    used: tuple[float, ...]


def read_action(node: str, actions: Mapping[str, ArrayLike], label: str, clamps: list[Clamp]) -> np.ndarray:
    """Return an action's value within its bounds, and add to the clamps if it had to be changed.

    Args:
        node: Where the action is needed, for messages.
        actions: Label -> value.
        label: Of the action.
        clamps: To be added to.

    Raises:
        ValueError: The action is missing, has the wrong size or is not finite.
    """
    if label not in actions:
        raise ValueError(f"node {node!r}: action {label!r} is missing; given are {sorted(actions)}")
    bounds = ACTIONS[label]
    value = np.atleast_1d(np.asarray(actions[label], dtype=float))
    if value.shape != (len(bounds.low),):
        raise ValueError(f"node {node!r}: action {label!r} has shape {value.shape}; give {len(bounds.low)} number(s)")
    if not np.isfinite(value).all():
        raise ValueError(f"node {node!r}: action {label!r} is {value.tolist()}; give finite numbers")
    used = np.clip(value, bounds.low, bounds.high)
    if (used != value).any():
        clamps.append(Clamp(label, tuple(value.tolist()), tuple(used.tolist())))
    return used
