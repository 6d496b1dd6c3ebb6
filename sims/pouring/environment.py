"""The pouring world as a Gymnasium environment: one step is one attempt."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

from sims.pouring import observation
from sims.pouring.actions import ACTIONS, SKILLS
from sims.pouring.behaviour import End
from sims.pouring.geometry import MOUTH_RANGE
from sims.pouring.materials import MATERIALS
from sims.pouring.observation import Observation
from sims.pouring.simulation import SimulationFailed
from sims.pouring.world import PouringWorld

# What an agent sees before an attempt: label -> (size, lowest, highest); amounts are at most 0.55 poured and
# 10 spilled. The size of the receiver is left out, because its corners tell it.
SEEN = {
    "receiver_corners": (12, -5.0, 5.0),
    "position": (3, -5.0, 5.0),
    "mouth": (1, 0.0, 0.3),
    "material": (4, 0.0, 10.0),
    "target_change": (1, -1.0, 1.0),
    "poured": (1, 0.0, 1.0),
    "spilled": (1, 0.0, 10.0),
    "released": (1, 0.0, 1.0),
}


class PouringEnv(gymnasium.Env):
    """Choose a skill and its parameters; the reward is that of the paper for what the attempt poured and
    spilled.

    Parameters are given as shares of their range, 0 for the low and 1 for the high bound of `ACTIONS`.
    With a = poured - still to be poured in this attempt, and s the amount spilled in it,
    R = -100 min(0, a)^2 - 10 s^2 - max(0, a)^2. An episode terminates when the target is reached, the source
    is empty, the time is over or the simulation failed; wrap it in `gymnasium.wrappers.TimeLimit` to bound
    the attempts.

    Args:
        render_mode: "rgb_array" for pictures, None for none.
        **world: Arguments of `PouringWorld`; by default all four materials and all mouths are drawn.

    Source: Yamaguchi & Atkeson, Differential Dynamic Programming for Graph-Structured Dynamical Systems,
    Humanoids 2016, equation (8).
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 1}

    def __init__(self, render_mode: str | None = None, **world: Any) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: {render_mode!r} is not known; choose 'rgb_array' or None")
        self.render_mode = render_mode
        self._world = PouringWorld(**{"material": tuple(MATERIALS), "mouth": MOUTH_RANGE, **world})
        self._camera: Any = None
        self.action_space = spaces.Dict(
            {"skill": spaces.Discrete(len(SKILLS))}
            | {label: spaces.Box(0.0, 1.0, (len(bounds.low),), np.float32) for label, bounds in ACTIONS.items()}
        )
        self.observation_space = spaces.Dict(
            {label: spaces.Box(low, high, (size,), np.float32) for label, (size, low, high) in SEEN.items()}
        )

    @property
    def world(self) -> PouringWorld:
        """The world behind the environment."""
        return self._world

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode; see `gymnasium.Env.reset`."""
        super().reset(seed=seed, options=options)
        known = self._world.reset(int(self.np_random.integers(2**31)))
        return self._see(known), self._info()

    def step(self, action: dict[str, Any]) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Make one attempt; see `gymnasium.Env.step`."""
        world = self._world
        target_change = self._situation()["target_change"]
        selections = {"skill": SKILLS[int(action["skill"])]}
        actions = {label: bounds.scale(action[label]) for label, bounds in ACTIONS.items()}
        try:
            # The attempt is over when the trial loop would begin anew.
            while True:
                reached = world.execute(world.node, actions, selections)
                if "poured" in reached:
                    changes = reached["poured"]
                    break
            world.execute(world.node, actions, selections)
        except SimulationFailed as failure:
            changes = failure.observed
        reward = reward_of(changes["poured_change"] - target_change, changes["spilled_change"])
        return self._see(self._situation()), reward, world.end is not None, False, self._info()

    def render(self) -> np.ndarray | None:
        """Return a picture of the present moment, if pictures were asked for."""
        if self.render_mode is None:
            return None
        if self._camera is None:
            from sims.pouring.rendering import Camera  # opens a graphics context, which few runs need

            self._camera = Camera(self._world)
        return self._camera.picture()

    def close(self) -> None:
        """Let go of the world and of the graphics."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None
        self._world.close()

    def _situation(self) -> Observation:
        behaviour = self._world.behaviour
        return observation.setting(behaviour, behaviour.target) | observation.situation(behaviour, behaviour.target)

    def _see(self, known: Observation) -> dict[str, np.ndarray]:
        return {
            label: np.clip(np.atleast_1d(known[label]), low, high).astype(np.float32)
            for label, (_, low, high) in SEEN.items()
        }

    def _info(self) -> dict[str, Any]:
        end = self._world.end
        return self._world.metrics | {
            "success": end is End.TARGET,
            "end": None if end is None else end.value,
            "clamped": [clamp.label for clamp in self._world.clamps],
        }


def reward_of(excess: float, spilled: float) -> float:
    """Equation (8): R = -100 min(0, excess)^2 - 10 max(0, spilled)^2 - max(0, excess)^2."""
    return float(-100.0 * min(0.0, excess) ** 2 - 10.0 * max(0.0, spilled) ** 2 - max(0.0, excess) ** 2)


if "Pouring-v0" not in gymnasium.registry:
    gymnasium.register("Pouring-v0", entry_point="sims.pouring.environment:PouringEnv")
