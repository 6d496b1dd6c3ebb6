"""The cannon range: point masses, integrated under gravity until they pass the target's x position."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

GRAVITY = np.array([0.0, -9.8])  # [m/s^2]
SPEED = 3.0  # at the muzzle [m/s]
MUZZLES = {"lower": np.array([0.0, 0.0]), "upper": np.array([0.0, 0.8])}  # position [m]
FARTHEST_TARGET = 1.5  # [m]
LONGEST_FLIGHT = 1e4  # then the bullet counts as lost; at 1.57 rad it needs 630 s for 1.5 m [s]
TOLERANCE = 1e-12  # of the integration, relative and absolute [m], [m/s]


class MissedError(RuntimeError):
    """The bullet never passes the target's x position; `observed` holds what was seen until then."""

    def __init__(self, message: str, observed: dict[str, dict[str, object]]):
        super().__init__(message)
        self.observed = observed


@dataclass(frozen=True)
class Flight:
    """A bullet on its way.

    Attributes:
        time: (n,) since the shot [s].
        position: (2, n) [m].
    """

    time: np.ndarray
    position: np.ndarray


def shoot(muzzle: np.ndarray, velocity: np.ndarray, target_x: float, points: int = 2) -> Flight | None:
    """Integrate x'' = g from the muzzle to the event x = target_x.

    Args:
        muzzle: (2,) position [m].
        velocity: (2,) [m/s].
        target_x: () [m].
        points: how many, evenly spaced in time; the last one is the event.

    Returns:
        The flight, or None if the bullet is not there within LONGEST_FLIGHT.
    """

    def passes_target(_time: float, bullet: np.ndarray) -> float:
        return bullet[0] - target_x

    passes_target.terminal = True
    solution = solve_ivp(
        lambda _time, bullet: np.concatenate([bullet[2:], GRAVITY]),
        (0.0, LONGEST_FLIGHT),
        np.concatenate([muzzle, velocity]),
        method="DOP853",
        events=passes_target,
        dense_output=True,
        rtol=TOLERANCE,
        atol=TOLERANCE,
    )
    if not solution.t_events[0].size:
        return None
    time = np.linspace(0.0, solution.t_events[0][0], points)
    return Flight(time, solution.sol(time)[:2])


class World:
    """Two cannons and a target that each episode may put elsewhere.

    Args:
        target_x: () [m]; None draws it anew at each reset, uniformly from (0, 1.5].
        target_y: () [m].
        speed_sd: standard deviation of the speed at the muzzle from shot to shot [m/s].
        theta_sd: standard deviation of the launch angle around the commanded one [rad].
    """

    def __init__(
        self,
        target_x: float | None = None,
        target_y: float = 0.3,
        speed_sd: float = 0.0,
        theta_sd: float = 0.0,
    ):
        self.target_x = target_x
        self.target_y = target_y
        self.speed_sd = speed_sd
        self.theta_sd = theta_sd
        self.reset(0)

    def reset(self, seed: int) -> dict[str, float | np.ndarray]:
        """Set the target up and load the cannons; equal seeds give equal episodes.

        Returns:
            speed: () [m/s]; target, lower_muzzle, upper_muzzle: (2,) positions [m].
        """
        self._random = np.random.default_rng(seed)
        x = self.target_x
        if x is None:
            x = FARTHEST_TARGET * (1.0 - self._random.random())  # 1 - [0, 1) leaves out 0
        self._target = np.array([x, self.target_y])
        return {
            "speed": SPEED,
            "target": self._target.copy(),
            "lower_muzzle": MUZZLES["lower"].copy(),
            "upper_muzzle": MUZZLES["upper"].copy(),
        }

    def execute(
        self, node: str, actions: Mapping[str, float], selections: Mapping[str, str]
    ) -> dict[str, dict[str, float]]:
        """Shoot: the one thing that leaves node 'aim'.

        Args:
            node: 'aim'.
            actions: theta: () [rad].
            selections: cannon: 'lower' or 'upper'.

        Returns:
            landed: hit_time: () [s]; hit_height: () [m].

        Raises:
            MissedError: the bullet never passes the target's x position.
        """
        if node != "aim":
            raise ValueError(f"node {node!r}: nothing to execute there; the only such node is 'aim'")
        speed = self._random.normal(SPEED, self.speed_sd)
        theta = self._random.normal(actions["theta"], self.theta_sd)
        velocity = speed * np.array([np.cos(theta), np.sin(theta)])
        flight = shoot(MUZZLES[selections["cannon"]], velocity, self._target[0])
        if flight is None:
            raise MissedError(
                f"theta {theta:.6g} rad, speed {speed:.6g} m/s: the bullet does not pass x = {self._target[0]:.6g} m",
                observed={},
            )
        return {"landed": {"hit_time": float(flight.time[-1]), "hit_height": float(flight.position[1, -1])}}

    def close(self) -> None:
        """Nothing is held open."""
