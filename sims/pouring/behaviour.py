"""What the robot does: the state machine of the pouring behaviour, run on the simulation."""

from __future__ import annotations

import copy
import enum
import math
from dataclasses import dataclass

import numpy as np

from sims.pouring.census import Census, SphereClass
from sims.pouring.geometry import GRIP_RANGE
from sims.pouring.scene import CONTROL_STEP
from sims.pouring.simulation import Simulation, SimulationState
from sims.pouring.skills import Move, Shake, Tip

WAYPOINT = (-0.3, 0.35)  # shoulder's x from the receiver's centre and z above its rim, around a trial
CARRY_TILT = math.pi / 4
POUR_TILT = math.pi / 3  # before and after a flow; at 45 degrees a low source would stand on the floor
CARRY_SPEED = 0.3  # to the receiver and back to the waypoint [length / time]
APPROACH_SPEED = 0.1  # to the pouring position [length / time]
CARRY_TILT_SPEED = 0.8  # [rad / time]
# After a flow [rad / time]; what is still to come falls until the source has turned back.
RETURN_TILT_SPEED = 1.6
ARRIVED = 0.005  # distance to the goal, in length and rad, at which a move ends

SPHERE_AMOUNT = 0.0055  # amount of one sphere, poured or let out
SPILL_AMOUNT = 0.1  # amount of one spilled sphere
SPILLS = 10  # newly spilled spheres that end a skill
EMPTY = 20  # spheres left in the source with which an episode ends
REST_SPEED = 0.005  # all spheres slower for REST_TIME: nothing moves any more
REST_TIME = 0.5
CALM_SPEED = 0.1  # all spheres outside the source slower: the trial can be measured
CALM_TIME = 3.0  # but do not wait longer for that


class Phase(enum.Enum):
    """Where the behaviour stands; the values are the names of the nodes."""

    START = "start"
    GRASPED = "grasped"
    AT_RECEIVER = "at_receiver"
    AT_POUR = "at_pour"
    READY = "ready"
    TIPPED = "tipped"
    SHAKEN = "shaken"
    TIP_BOUNDED = "tip_bounded"
    SHAKE_BOUNDED = "shake_bounded"
    RELEASED = "released"
    LANDED = "landed"
    POURED = "poured"


TRANSITIONS = {
    Phase.START: (Phase.GRASPED,),
    Phase.GRASPED: (Phase.AT_RECEIVER,),
    Phase.AT_RECEIVER: (Phase.AT_POUR,),
    Phase.AT_POUR: (Phase.READY,),
    Phase.READY: (Phase.TIPPED, Phase.SHAKEN),
    Phase.TIPPED: (Phase.TIP_BOUNDED,),
    Phase.SHAKEN: (Phase.SHAKE_BOUNDED,),
    Phase.TIP_BOUNDED: (Phase.RELEASED,),
    Phase.SHAKE_BOUNDED: (Phase.RELEASED,),
    Phase.RELEASED: (Phase.LANDED,),
    Phase.LANDED: (Phase.POURED,),
    Phase.POURED: (Phase.AT_RECEIVER,),
}


class End(enum.Enum):
    """Why an episode is over."""

    TARGET = "target reached"
    EMPTY = "source empty"
    TIME = "time over"
    FAILED = "simulation failed"


@dataclass
class Trial:
    """Counts at the start of a trial, and how its flow went.

    Attributes:
        released, poured, spilled: Spheres out of the source, in the receiver, spilled, when the trial began.
        stopped: Why the skill ended: "target", "spilled", "empty", "time" or "no flow"; None before.
        duration: Simulated time that the skill took.
        mouth: x of the middle of the mouth, relative to the receiver, when the skill ended.
    """

    released: int
    poured: int
    spilled: int
    stopped: str | None = None
    duration: float = 0.0
    mouth: float = 0.0


@dataclass(frozen=True)
class BehaviourState:
    """Everything that decides how a behaviour goes on."""

    simulation: SimulationState
    census: Census
    trial: Trial
    phase: Phase
    started: float


class Behaviour:
    """Grasp, move to the receiver, move to the pouring position, tip or shake, go back, and again.

    Args:
        simulation: The physics, with settled spheres.
        target: Amount to pour.
        time_limit: Simulated time after which no further trial begins.

    Attributes:
        phase: Where it stands; each method leads from one phase to the next.
        census: The spheres by class.
        trial: The present trial.
    """

    def __init__(self, simulation: Simulation, target: float, time_limit: float) -> None:
        self.simulation = simulation
        self.phase = Phase.START
        self.census = Census(simulation)
        self.trial = Trial(0, 0, 0)
        self.target = target
        self._time_limit = time_limit
        self._started = simulation.time

    @property
    def time(self) -> float:
        """Simulated time since the episode began."""
        return self.simulation.time - self._started

    @property
    def end(self) -> End | None:
        """Why the episode is over; None while it is not."""
        if SPHERE_AMOUNT * self.census.in_receiver > self.target:
            return End.TARGET
        if self.census.in_source <= EMPTY:
            return End.EMPTY
        if self.time >= self._time_limit:
            return End.TIME
        return None

    @property
    def waypoint(self) -> np.ndarray:
        """(2,) x and z of the shoulder before and after a trial."""
        return np.array([self.simulation.receiver_pose[0] + WAYPOINT[0], self.simulation.receiver.rim + WAYPOINT[1]])

    def grasp(self, ratio: float) -> float:
        """Hold the source at a share of its height; return the height of the grasp [length]."""
        low, high = GRIP_RANGE
        height = low + ratio * (high - low)
        self.simulation.grip(height)
        self._enter(Phase.GRASPED)
        return height

    def move_to_receiver(self) -> float:
        """Go to the waypoint and tilt a little; return the highest speed of the receiver on the way."""
        fastest = self._move(np.array([*self.waypoint, CARRY_TILT]), CARRY_SPEED, CARRY_TILT_SPEED)
        self._enter(Phase.AT_RECEIVER)
        return fastest

    def move_to_pour(self, x: float, z: float) -> None:
        """Go to the pouring position, x relative to the receiver."""
        self._begin_trial()
        goal = np.array([self.simulation.receiver_pose[0] + x, z, POUR_TILT])
        self._move(goal, APPROACH_SPEED, CARRY_TILT_SPEED)
        self._enter(Phase.AT_POUR)

    def get_ready(self) -> None:
        """Nothing moves between arriving and starting to pour."""
        self._enter(Phase.READY)

    def tip(self, tilt_rate: float, search_rate: float) -> None:
        """Pour by tipping, and turn back."""
        self._pour(Tip(self.simulation.command, tilt_rate, search_rate))
        self._enter(Phase.TIPPED)

    def shake(self, tilt_rate: float, speed: float, length: float, angle: float) -> None:
        """Pour by shaking, and turn back."""
        self._pour(Shake(self.simulation.command, tilt_rate, speed, length, angle))
        self._enter(Phase.SHAKEN)

    def bound(self) -> None:
        """Let it be known what bounds the amount: nothing is done, so that a model can say so."""
        self._enter(Phase.TIP_BOUNDED if self.phase is Phase.TIPPED else Phase.SHAKE_BOUNDED)

    def release(self) -> None:
        """Count what has left the source."""
        self._enter(Phase.RELEASED)

    def land(self) -> None:
        """Let what is in the air come to rest."""
        steps = round(CALM_TIME / CONTROL_STEP)
        for _ in range(steps):
            if self._calm():
                break
            self._step(self.simulation.command)
        self._enter(Phase.LANDED)

    def measure(self) -> None:
        """Count what lies where."""
        self._enter(Phase.POURED)

    def go_back(self) -> None:
        """Return to the waypoint for another trial."""
        self._move(np.array([*self.waypoint, CARRY_TILT]), CARRY_SPEED, CARRY_TILT_SPEED)
        self._enter(Phase.AT_RECEIVER)

    def _enter(self, phase: Phase) -> None:
        if phase not in TRANSITIONS[self.phase]:
            raise ValueError(f"behaviour: {self.phase.value!r} does not lead to {phase.value!r}")
        self.phase = phase

    def _begin_trial(self) -> None:
        census = self.census
        self.trial = Trial(len(census.classes) - census.in_source, census.in_receiver, census.spilled)
        census.start_trial()

    def _step(self, command: np.ndarray) -> None:
        self.simulation.step(command)
        self.census.update(self.simulation)

    def _move(self, goal: np.ndarray, speed: float, tilt_speed: float) -> float:
        """Move and arrive; return the highest speed of the receiver on the way."""
        move = Move(self.simulation.command, goal, speed, tilt_speed)
        fastest = 0.0
        while not move.ended or self.simulation.distance_to_goal > ARRIVED:
            self._step(move.next())
            fastest = max(fastest, self.simulation.receiver_speed)
        return fastest

    def _pour(self, skill: Tip | Shake) -> None:
        """Run a skill until it or the trial is over, then turn back."""
        simulation = self.simulation
        place = simulation.command.copy()
        begin = simulation.time
        rested = 0
        while not skill.ended and (stopped := self._stop()) is None:
            self._step(skill.next(self.census.flowing > 0, rested * CONTROL_STEP >= REST_TIME))
            fastest = np.abs(simulation.velocities).max()
            rested = rested + 1 if fastest < REST_SPEED else 0
        self.trial.stopped = "no flow" if skill.ended else stopped
        self.trial.duration = simulation.time - begin
        self.trial.mouth = simulation.source.mouth_centre(simulation.pose) - float(simulation.receiver_pose[0])
        tilted = np.array([*place[:2], simulation.command[2]])
        back = Move(tilted, place, CARRY_SPEED, RETURN_TILT_SPEED)
        while not back.ended or simulation.distance_to_goal > ARRIVED:
            self._step(back.next())

    def _stop(self) -> str | None:
        """Why the skill has to stop; None if it may go on."""
        end = self.end
        if end is not None:
            return end.name.lower()
        return "spilled" if self.census.spilled - self.trial.spilled >= SPILLS else None

    def _calm(self) -> bool:
        outside = self.census.classes != SphereClass.SOURCE
        return not (outside & (np.linalg.norm(self.simulation.velocities, axis=1) > CALM_SPEED)).any()

    def save(self) -> BehaviourState:
        """Return the state; `restore` goes on from it exactly as this behaviour would."""
        return BehaviourState(
            self.simulation.save(), self.census.copy(), copy.copy(self.trial), self.phase, self._started
        )

    def restore(self, state: BehaviourState) -> None:
        """Take over a state that a behaviour in the same scene has saved."""
        self.simulation.restore(state.simulation)
        self.census, self.trial = state.census.copy(), copy.copy(state.trial)
        self.phase, self._started = state.phase, state.started
