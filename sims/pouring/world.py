"""The pouring world: what an on-line learner drives, node by node, and what it observes on each edge."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sims.pouring import observation
from sims.pouring.actions import SKILLS, Clamp, read_action
from sims.pouring.behaviour import SPHERE_AMOUNT, Behaviour, BehaviourState, End, Phase
from sims.pouring.geometry import MOUTH_RANGE, RECEIVER_SIZE, SIDE_RANGE, SPHERES, START, Receiver, Source
from sims.pouring.materials import Material, find_material, mix
from sims.pouring.observation import Observation
from sims.pouring.scene import CONTROL_STEP
from sims.pouring.simulation import Simulation, SimulationFailed, SimulationState

Actions = Mapping[str, ArrayLike]
Selections = Mapping[str, str]

RECEIVER_RANGE = (0.5, 1.1)
SETTLE_TIME = 3.0  # at most; spheres that bounce take that long
SETTLED_SPEED = 0.01  # root mean square


@dataclass(frozen=True)
class WorldState:
    """Everything that decides how an episode goes on."""

    material: Material
    mouth: float
    receiver: Receiver
    target: float
    behaviour: BehaviourState
    clamps: tuple[Clamp, ...]
    end: End | None


class PouringWorld:
    r"""Pour 100 spheres from a source with a narrow mouth into a receiver, by tipping or by shaking.

    An episode goes from node to node::

        start -> grasped -> at_receiver -> at_pour -> ready -> tipped | shaken
                       \-> receiver_moved

        -> tip_bounded | shake_bounded -> released -> landed -> poured -> at_receiver ...

    `reset` returns what is observed at "start"; `execute` does what leaves a node and returns what was
    observed on the way to each node that it leads to. After "poured", the trial loop leads to "at_receiver"
    again, or nowhere once the episode is over.

    Args:
        material: A name of `MATERIALS`, a Material, or a sequence of those from which every reset draws.
        mouth: Width of the source's opening [length], or (low, high) from which every reset draws.
        target: Amount to pour, 0.0055 for each sphere, or (low, high) from which every reset draws.
        receiver_x: Where the receiver's centre stands [length], or (low, high) from which every reset draws.
        receiver_size: Length (x), width (y) and height of the receiver [length]; each is a number or (low, high)
            from which every reset draws.
        time_limit: Simulated time after which no further trial begins.
        blend: Whether every reset draws two different materials and a share, and pours the `mix` of them.

    Raises:
        ValueError: A value lies outside its range; there is nothing to blend.

    Attributes:
        clamps: Commands of this episode that could not be followed as given.
        end: Why the episode is over; None while it is not.

    Source: Yamaguchi & Atkeson, Differential Dynamic Programming for Graph-Structured Dynamical Systems,
    Humanoids 2016, Section VII and Fig. 8.
    """

    def __init__(
        self,
        material: str | Material | Sequence[str | Material] = "bnc",
        mouth: float | tuple[float, float] = 0.23,
        target: float | tuple[float, float] = 0.3,
        receiver_x: float | tuple[float, float] = RECEIVER_RANGE,
        receiver_size: Sequence[float | tuple[float, float]] = RECEIVER_SIZE,
        time_limit: float = 500.0,
        blend: bool = False,
    ) -> None:
        if isinstance(material, str | Material):
            material = (material,)
        if len(material) == 0:
            raise ValueError("material: the sequence is empty; give at least one material")
        self._materials = tuple(find_material(one) for one in material)
        if blend and len(set(self._materials)) < 2:
            raise ValueError(f"blend: {material!r} has nothing to blend; give at least two different materials")
        self._blend = blend
        self._mouth = _check_range("mouth", mouth, MOUTH_RANGE)
        self._target = _check_range("target", target, (0.0, SPHERES * SPHERE_AMOUNT))
        self._receiver_x = _check_range("receiver_x", receiver_x, RECEIVER_RANGE)
        if len(receiver_size) != 3:
            raise ValueError(f"receiver_size: {receiver_size!r} is not length, width, height; give three values")
        self._receiver_size = tuple(_check_range("receiver_size", side, SIDE_RANGE) for side in receiver_size)
        self._time_limit = time_limit
        self._behaviour: Behaviour | None = None
        self.clamps: list[Clamp] = []
        self.end: End | None = None

    def reset(self, seed: int) -> Observation:
        """Begin an episode; the seed decides everything that is drawn.

        Args:
            seed: A non-negative integer.

        Returns:
            What is observed at the node "start", label -> value.
        """
        generator = np.random.default_rng(seed)
        # All are drawn, whether fixed or not, so that fixing one leaves the others as they were.
        mouth = float(generator.uniform(*self._mouth))
        target = float(generator.uniform(*self._target))
        receiver_x = float(generator.uniform(*self._receiver_x))
        material = self._materials[int(generator.integers(len(self._materials)))]
        # How many numbers the choice of a material takes depends on how many there are; from a stream of their own
        # these are the same whatever is drawn above.
        generator = np.random.default_rng([seed, 2])
        receiver = Receiver(tuple(float(generator.uniform(*side)) for side in self._receiver_size))
        if self._blend:
            others = [other for other in self._materials if other != material]
            material = mix(material, others[int(generator.integers(len(others)))], float(generator.uniform()))
        settled = _settle(material, Source(mouth), receiver, receiver_x, seed)
        self._begin(material, mouth, receiver, target, settled)
        self.clamps, self.end = [], None
        return observation.setting(self.behaviour, target) | observation.situation(self.behaviour, target)

    def execute(self, node: str, actions: Actions, selections: Selections | None = None) -> dict[str, Observation]:
        """Do what leaves a node.

        Args:
            node: Where the episode stands.
            actions: Label -> value, at least for the actions that leave this node; others are not looked
                at. Values outside the bounds of `ACTIONS` are clamped, which `clamps` reports.
            selections: {"skill": "tip" or "shake"}, needed at "ready".

        Returns:
            Node reached -> what was observed on the way there; empty if the episode is over.

        Raises:
            ValueError: The episode does not stand at that node; an action is missing or not finite.
            SimulationFailed: The physics broke down; its `observed` holds what was measured. The episode is
                over.
        """
        behaviour = self.behaviour
        if self.end is not None:
            raise ValueError(f"node {node!r}: the episode is over ({self.end.value}); call reset")
        if node != self.node:
            raise ValueError(f"node {node!r}: the episode stands at {self.node!r}; execute that")
        behaviour.simulation.lifted = 0.0
        try:
            reached = _EDGES[behaviour.phase](self, actions, selections or {})
        except SimulationFailed as failure:
            self.end = End.FAILED
            failure.observed |= (
                observation.totals(behaviour)
                | observation.flow(behaviour)
                | observation.released(behaviour)
                | observation.changes(behaviour)
            )
            raise
        # The first way to the waypoint is no command; where that is low, the floor raises the tilting source a little.
        if behaviour.simulation.lifted > 0.0 and node != Phase.GRASPED.value:
            self.clamps.append(Clamp("lift", (0.0,), (behaviour.simulation.lifted,)))
        return reached

    def close(self) -> None:
        """Let go of the simulation; `reset` begins anew."""
        self._behaviour = None

    @property
    def behaviour(self) -> Behaviour:
        """The state machine of the present episode, for looking at it."""
        if self._behaviour is None:
            raise ValueError("world: no episode has begun; call reset")
        return self._behaviour

    @property
    def node(self) -> str:
        """Where the episode stands."""
        return self.behaviour.phase.value

    @property
    def metrics(self) -> dict[str, float]:
        """Counts of the episode so far, under the names that other pouring environments use."""
        census = self.behaviour.census
        return {
            "fraction_in_receiver": census.in_receiver / SPHERES,
            "fraction_in_source": census.in_source / SPHERES,
            "fraction_spilled": census.spilled / SPHERES,
            "spilled_particles": float(census.spilled),
            "leaked_particles": float(len(census.leaked)),
            "simulated_time": self.behaviour.time,
        }

    def save(self) -> WorldState:
        """Return the state of the episode; `restore` goes on from it exactly as this world would."""
        simulation = self.behaviour.simulation
        return WorldState(
            simulation.material,
            simulation.source.mouth,
            simulation.receiver,
            self.behaviour.target,
            self.behaviour.save(),
            tuple(self.clamps),
            self.end,
        )

    def restore(self, state: WorldState) -> None:
        """Go on with an episode that this world, or one with the same time limit, has saved."""
        self._begin(state.material, state.mouth, state.receiver, state.target, state.behaviour.simulation)
        self.behaviour.restore(state.behaviour)
        self.clamps, self.end = list(state.clamps), state.end

    def _begin(
        self, material: Material, mouth: float, receiver: Receiver, target: float, state: SimulationState
    ) -> None:
        simulation = Simulation(material, Source(mouth), receiver)
        simulation.restore(state)
        self._behaviour = Behaviour(simulation, target, self._time_limit)

    def _grasp(self, actions: Actions, selections: Selections) -> dict[str, Observation]:
        (ratio,) = read_action(self.node, actions, "grasp_ratio", self.clamps)
        return {"grasped": {"grasp_height": self.behaviour.grasp(float(ratio))}}

    def _move_to_receiver(self, actions: Actions, selections: Selections) -> dict[str, Observation]:
        before = observation.places(self.behaviour)["receiver_corners"]
        speed = self.behaviour.move_to_receiver()
        after = observation.places(self.behaviour)
        return {
            "at_receiver": after,
            "receiver_moved": {
                "receiver_corner_change": after["receiver_corners"] - before,
                "receiver_speed": speed,
            },
        }

    def _move_to_pour(self, actions: Actions, selections: Selections) -> dict[str, Observation]:
        x, z = read_action(self.node, actions, "pour_position", self.clamps)
        self.behaviour.move_to_pour(float(x), float(z))
        return {"at_pour": observation.relative_position(self.behaviour)}

    def _get_ready(self, actions: Actions, selections: Selections) -> dict[str, Observation]:
        self.behaviour.get_ready()
        return {"ready": {}}

    def _pour(self, actions: Actions, selections: Selections) -> dict[str, Observation]:
        skill = selections.get("skill")
        read = functools.partial(read_action, self.node, actions, clamps=self.clamps)
        if skill == "tip":
            self.behaviour.tip(float(read("tilt_rate")[0]), float(read("search_rate")[0]))
        elif skill == "shake":
            length, angle = read("shake_stroke")
            self.behaviour.shake(
                float(read("tilt_rate")[0]), float(read("shake_speed")[0]), float(length), float(angle)
            )
        else:
            raise ValueError(f"node {self.node!r}: selection 'skill' is {skill!r}; choose from {list(SKILLS)}")
        return {self.node: observation.flow(self.behaviour)}

    def _bound(self, actions: Actions, selections: Selections) -> dict[str, Observation]:
        self.behaviour.bound()
        return {self.node: {}}

    def _release(self, actions: Actions, selections: Selections) -> dict[str, Observation]:
        self.behaviour.release()
        return {"released": observation.released(self.behaviour)}

    def _land(self, actions: Actions, selections: Selections) -> dict[str, Observation]:
        self.behaviour.land()
        return {"landed": {}}

    def _measure(self, actions: Actions, selections: Selections) -> dict[str, Observation]:
        self.behaviour.measure()
        return {"poured": observation.changes(self.behaviour)}

    def _try_again(self, actions: Actions, selections: Selections) -> dict[str, Observation]:
        self.end = self.behaviour.end
        if self.end is not None:
            return {}
        self.behaviour.go_back()
        return {"at_receiver": observation.situation(self.behaviour, self.behaviour.target)}


_EDGES = {
    Phase.START: PouringWorld._grasp,
    Phase.GRASPED: PouringWorld._move_to_receiver,
    Phase.AT_RECEIVER: PouringWorld._move_to_pour,
    Phase.AT_POUR: PouringWorld._get_ready,
    Phase.READY: PouringWorld._pour,
    Phase.TIPPED: PouringWorld._bound,
    Phase.SHAKEN: PouringWorld._bound,
    Phase.TIP_BOUNDED: PouringWorld._release,
    Phase.SHAKE_BOUNDED: PouringWorld._release,
    Phase.RELEASED: PouringWorld._land,
    Phase.LANDED: PouringWorld._measure,
    Phase.POURED: PouringWorld._try_again,
}


def _check_range(name: str, value: float | tuple[float, float], limits: tuple[float, float]) -> tuple[float, float]:
    low, high = value if isinstance(value, tuple) else (value, value)
    if not limits[0] <= low <= high <= limits[1]:
        raise ValueError(f"{name}: {value!r} is not a number or (low, high) from {limits[0]} to {limits[1]}")
    return float(low), float(high)


@functools.lru_cache(maxsize=256)
def _settle(material: Material, source: Source, receiver: Receiver, receiver_x: float, seed: int) -> SimulationState:
    """Return the state in which the spheres, dropped into the upright source, have come to rest."""
    simulation = Simulation(material, source, receiver)
    simulation.fill(receiver_x, np.random.default_rng([seed, 1]))
    upright = np.array([START[0], START[2], 0.0])
    for step in range(round(SETTLE_TIME / CONTROL_STEP)):
        simulation.step(upright)
        if step > 10 and np.sqrt((simulation.velocities**2).sum(axis=1).mean()) < SETTLED_SPEED:
            break
    return simulation.save()
