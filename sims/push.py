"""A table with one object on it, seen in two places, and a gripper that pushes blindly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtr

ARM = 0.3  # the arms run from the gripper's centre to (ARM, ±ARM) in its frame [m]
PLACES = (0.3, 0.7)  # the object is seen in this range, along x and y [m]
LARGEST_SD = 0.1  # of what is seen [m]
SAMPLED_PLACES = (0.2, 0.8)  # where objects stand in pushes that serve as samples [m]
SAMPLED_ADVANCES = (0.01, 2.0)  # of such pushes [m]
FARTHEST = 8.0  # standard deviations that are integrated over; 1e-15 lies beyond
POINTS = 32  # Gauss–Legendre points on each side of the gripper's axis


@dataclass(frozen=True)
class Situation:
    """What is seen: the object is at one of two places, with equal odds.

    Attributes:
        first, second: (2,) [m].
        first_sd, second_sd: () standard deviation around it, the same in every direction [m].
    """

    first: np.ndarray
    first_sd: float
    second: np.ndarray
    second_sd: float

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Situation:
        """Draw both places and their standard deviations uniformly."""
        first, second = rng.uniform(*PLACES, size=(2, 2))
        return cls(first, rng.uniform(0, LARGEST_SD), second, rng.uniform(0, LARGEST_SD))

    def objects(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Draw (count, 2) positions of the object [m]."""
        is_first = rng.random(count) < 0.5
        means = np.where(is_first[:, None], self.first, self.second)
        return means + np.where(is_first, self.first_sd, self.second_sd)[:, None] * rng.standard_normal((count, 2))


def in_gripper(place: Any, gripper: Any, theta: Any) -> np.ndarray:
    """Return places (..., 2) in the frame of grippers (..., 2) that point along theta (...) [m], [rad]."""
    along = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    delta = np.asarray(place) - gripper
    return np.stack([(delta * along).sum(-1), (delta * across).sum(-1)], axis=-1)


def pushed(local: Any, advance: Any) -> np.ndarray:
    """Return where objects at local (..., 2) are in the gripper's frame after advances (...) [m].

    The gripper comes closer by `advance`. An object between the arms is met by one of them when the gripper has moved
    by x - |y|, and slides along it until the centre takes it or the gripper halts.
    """
    x, y = np.moveaxis(np.asarray(local, dtype=float), -1, 0)
    x, y, advance = np.broadcast_arrays(x, y, advance)
    met_after = x - np.abs(y)
    left = advance - met_after  # of the motion once the arm is met
    met = (met_after >= 0) & (left > 0) & (np.abs(y) <= ARM)
    slid = np.maximum(np.abs(y) - left, 0.0)  # each step forwards brings it one step closer to the axis
    return np.stack([np.where(met, slid, x - advance), np.where(met, np.copysign(slid, y), y)], axis=-1)


def captured(local: Any, advance: Any) -> np.ndarray:
    """Return whether pushes take objects at local (..., 2) to the gripper's centre: |y| ≤ x < advance, |y| ≤ ARM."""
    x, y = np.moveaxis(np.asarray(local, dtype=float), -1, 0)
    return (np.abs(y) <= x) & (x < advance) & (np.abs(y) <= ARM)


def success_probability(situation: Situation, gripper: Any, theta: Any, advance: Any) -> np.ndarray:
    """Return how likely pushes capture the object, over the mixture of what is seen.

    For each Gaussian N((x, y), s²) in the gripper's frame it is ∫ φ(z) (Φ(c) - Φ(a(z))) dz over the z with
    |y + s z| ≤ min(ARM, advance), where c = (advance - x) / s and a(z) = (|y + s z| - x) / s. The integrand is smooth
    on a scale of 1 but for the kink on the axis; Gauss–Legendre on both sides of it has errors below 1e-9.

    Args:
        situation: what is seen.
        gripper: (..., 2) [m].
        theta: (...) [rad].
        advance: (...) [m].

    Returns:
        (...) in [0, 1].
    """
    seen = (situation.first, situation.first_sd), (situation.second, situation.second_sd)
    return sum(
        0.5 * _capture_probability(in_gripper(mean, gripper, theta), sd, np.asarray(advance)) for mean, sd in seen
    )


def _capture_probability(local: np.ndarray, sd: float, advance: np.ndarray) -> np.ndarray:
    if not (np.isfinite(sd) and sd >= 0):
        raise ValueError(f"standard deviation {sd!r} m; give a number of at least 0")
    if sd == 0:
        return captured(local, advance).astype(float)
    x, y = np.moveaxis(local / sd, -1, 0)
    edge, end = np.minimum(ARM, advance) / sd, advance / sd
    nodes, weights = np.polynomial.legendre.leggauss(POINTS)
    total = np.zeros(np.broadcast_shapes(x.shape, advance.shape))
    for low, high in ((-edge, 0.0), (0.0, edge)):
        low, high = (np.clip(limit - y, -FARTHEST, FARTHEST) for limit in (low, high))
        half = ((high - low) / 2)[..., None]
        z = (high + low)[..., None] / 2 + half * nodes
        inside = ndtr((end - x)[..., None]) - ndtr(np.abs(y[..., None] + z) - x[..., None])
        density = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
        total += (half * weights * density * inside).sum(-1)
    return np.clip(total, 0.0, 1.0)


def samples(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Push at random, to learn from it.

    Returns:
        x: (count, 3) local position of the object and advance [m].
        y: (count, 2) its offset after the push [m].
    """
    place = rng.uniform(*SAMPLED_PLACES, size=(count, 2))
    gripper = rng.uniform(0.0, 1.0, size=(count, 2))
    local = in_gripper(place, gripper, rng.uniform(-np.pi, np.pi, size=count))
    advance = rng.uniform(*SAMPLED_ADVANCES, size=count)
    return np.column_stack([local, advance]), pushed(local, advance)


class World:
    """The table. Each episode has an object that is seen in two places, and stands near one of them.

    Args:
        situation: what is seen; None draws it anew at each reset.
    """

    def __init__(self, situation: Situation | None = None):
        self.situation = situation
        self.reset(0)

    def reset(self, seed: int) -> dict[str, float | np.ndarray]:
        """Put the object down; equal seeds give equal episodes.

        Returns:
            first, second: (2,) where the object is seen [m]; first_sd, second_sd: () how uncertain that is [m].
        """
        rng = np.random.default_rng(seed)
        seen = self.situation or Situation.draw(rng)
        (self._object,) = seen.objects(rng, 1)
        self._local = None
        return {
            "first": seen.first.copy(),
            "first_sd": seen.first_sd,
            "second": seen.second.copy(),
            "second_sd": seen.second_sd,
        }

    def execute(
        self, node: str, actions: Mapping[str, Any], selections: Mapping[str, str]
    ) -> dict[str, dict[str, np.ndarray]]:
        """Put the gripper down (node 'aim'), then push (node 'approached').

        Args:
            node: 'aim' or 'approached'.
            actions: gripper: (2,) [m]; theta: () [rad]; advance: () [m].
            selections: none.

        Returns:
            approached: local: (2,) where the object was in the gripper's frame [m]; or
            pushed: offset: (2,) where it is in that frame afterwards [m].
        """
        if node == "aim":
            self._local = in_gripper(self._object, np.asarray(actions["gripper"], dtype=float), actions["theta"])
            return {"approached": {"local": self._local.copy()}}
        if node != "approached":
            raise ValueError(f"node {node!r}: nothing to execute there; the nodes are 'aim' and 'approached'")
        if self._local is None:
            raise ValueError("node 'approached': the gripper is not on the table yet; execute 'aim' first")
        return {"pushed": {"offset": pushed(self._local, actions["advance"])}}

    def close(self) -> None:
        """Nothing is held open."""
