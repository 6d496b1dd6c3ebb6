"""Physics: the source follows commands, MuJoCo moves everything else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from sims.pouring.attraction import Attraction
from sims.pouring.geometry import (
    INNER,
    SPHERE_RADIUS,
    SPHERES,
    START,
    WALL,
    Receiver,
    Source,
    required_lift,
)
from sims.pouring.materials import Material
from sims.pouring.scene import SPHERE_MASS, SUBSTEPS, TIME_STEP, compile_scene

SERVO_GAIN = 10.0  # [1 / time]; velocity = gain * (command - pose)
SPEED_LIMIT = np.array([1.0, 1.0, 2.0])  # of shoulder x, z [length / time] and tilt [rad / time]
# Faster, the bounciest spheres sink beyond the middle of the receiver's walls and are pushed out on the other
# side. Spheres that pour, or bounce after it, stay slower: the limit is for those that something flings.
SPHERE_SPEED_LIMIT = 1.6
# With the solver's warm start: the same state goes on the same way.
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
_SOURCE = slice(0, 3)
_GRIPPER = 3
_RECEIVER = slice(4, 7)
_SPHERES = slice(7, 7 + 3 * SPHERES)


class SimulationFailed(RuntimeError):
    """The physics has left the finite numbers.

    Args:
        message: Where and why.
        observed: What was measured before, label -> value.
    """

    def __init__(self, message: str, observed: dict[str, object] | None = None) -> None:
        super().__init__(message)
        self.observed = {} if observed is None else observed


@dataclass(frozen=True)
class SimulationState:
    """Everything that decides how a simulation goes on."""

    physics: np.ndarray
    pose: np.ndarray
    command: np.ndarray
    lifted: float
    slowed: int


class Simulation:
    """Spheres in a source that moves on command, and a receiver that can be pushed.

    Args:
        material: What the spheres are.
        source: The container they start in.
        receiver: The container they should end in.

    Attributes:
        pose: (3,) shoulder x, z [length] and tilt [rad]; tilt 0 is upright.
        command: (3,) where the shoulder shall go, in the same units.
        lifted: The most that clearing the rim, the heap or the floor has raised a command [length].
        slowed: How often a sphere was slowed to the speed limit.
        distance_to_goal: The largest distance, in length or rad, left to the command of the last step.
        listeners: Functions that are called with the simulation after every control step.
    """

    def __init__(self, material: Material, source: Source, receiver: Receiver) -> None:
        self.material, self.source, self.receiver = material, source, receiver
        self.model = compile_scene(material, source, receiver)
        self.data = mujoco.MjData(self.model)
        self.listeners: list[Callable[[Simulation], None]] = []
        self.pose = np.array([START[0], START[2], 0.0])
        self.command = self.pose.copy()
        self.lifted = 0.0
        self.slowed = 0
        self.distance_to_goal = 0.0
        self._attraction = Attraction(material, SPHERES)
        self._outline = source.outline()

    @property
    def time(self) -> float:
        """Simulated time since the start."""
        return float(self.data.time)

    @property
    def positions(self) -> np.ndarray:
        """(n, 3) centres of the spheres [length]."""
        return self.data.qpos[_SPHERES].reshape(SPHERES, 3)

    @property
    def velocities(self) -> np.ndarray:
        """(n, 3) velocities of the spheres [length / time]."""
        return self.data.qvel[_SPHERES].reshape(SPHERES, 3)

    @property
    def receiver_pose(self) -> np.ndarray:
        """(3,) receiver's centre x, y [length] and yaw [rad]."""
        return self.data.qpos[_RECEIVER]

    @property
    def receiver_speed(self) -> float:
        """Speed of the receiver's centre [length / time]."""
        return float(np.hypot(*self.data.qvel[_RECEIVER][:2]))

    def fill(self, receiver_x: float, generator: np.random.Generator) -> None:
        """Place the receiver, and the spheres in jittered layers in the upright source."""
        pitch = 2.1 * SPHERE_RADIUS
        edge = INNER - pitch / 2
        places = np.linspace(-edge, edge, 5)
        z, y, x = np.meshgrid(WALL + pitch / 2 + pitch * np.arange(SPHERES // 25), places, places, indexing="ij")
        layers = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
        layers += generator.uniform(-1e-3, 1e-3, layers.shape)
        self.data.qpos[_RECEIVER] = [receiver_x, 0.0, 0.0]
        self.data.qpos[_SPHERES] = generator.permutation(layers).ravel()

    def grip(self, height: float) -> None:
        """Put the gripper's blocks at a height on the source, measured from its bottom [length]."""
        self.data.qpos[_GRIPPER] = height

    def step(self, command: np.ndarray) -> None:
        """Go on by one control step towards a command (x, z, tilt).

        Raises:
            SimulationFailed: A velocity is no longer finite.
        """
        self.command = np.array(command, dtype=float)
        lift = required_lift(self._outline, self.command, self.receiver, float(self.receiver_pose[0]))
        self.lifted = max(self.lifted, lift)
        goal = self.command + (0.0, lift, 0.0)
        velocity = np.clip(SERVO_GAIN * (goal - self.pose), -SPEED_LIMIT, SPEED_LIMIT)
        data = self.data
        before = data.qpos.copy()
        if self._attraction.active:
            data.qfrc_applied[_SPHERES] = SPHERE_MASS * self._attraction.accelerations(self.positions).ravel()
        for _ in range(SUBSTEPS):
            data.qpos[_SOURCE] = self.pose
            data.qvel[_SOURCE] = velocity
            data.qvel[_GRIPPER] = 0.0
            mujoco.mj_step(self.model, data)
            if not np.isfinite(data.qvel).all():
                data.qpos[:], data.qvel[:] = before, 0.0  # what is looked at afterwards shall be finite
                raise SimulationFailed(f"simulation: a velocity is not finite at time {self.time:.3f}")
            self.pose = self.pose + velocity * TIME_STEP
            self._limit_speeds()
        data.qpos[_SOURCE] = self.pose
        self.distance_to_goal = float(np.abs(goal - self.pose).max())
        for listener in self.listeners:
            listener(self)

    def _limit_speeds(self) -> None:
        velocities = self.velocities
        # The largest component of too fast a sphere exceeds limit / sqrt(3).
        if np.abs(velocities).max() > SPHERE_SPEED_LIMIT / 2:
            speeds = np.linalg.norm(velocities, axis=1)
            fast = speeds > SPHERE_SPEED_LIMIT
            velocities[fast] *= (SPHERE_SPEED_LIMIT / speeds[fast])[:, None]
            self.slowed += int(fast.sum())

    def save(self) -> SimulationState:
        """Return the state; `restore` goes on from it exactly as this simulation would."""
        physics = np.empty(mujoco.mj_stateSize(self.model, _STATE))
        mujoco.mj_getState(self.model, self.data, physics, _STATE)
        return SimulationState(physics, self.pose.copy(), self.command.copy(), self.lifted, self.slowed)

    def restore(self, state: SimulationState) -> None:
        """Take over a state that a simulation of the same scene has saved."""
        mujoco.mj_setState(self.model, self.data, state.physics, _STATE)
        self.pose, self.command = state.pose.copy(), state.command.copy()
        self.lifted, self.slowed = state.lifted, state.slowed
