"""Measure the pouring world: one attempt per row, written to CSV files beside this script as it happens.

Run from the repository's root, `PYTHONPATH=. python docs/reproduction/pouring_world/measure.py table
jamming`. Rows that are in a file already are not measured again, so a stopped run goes on where it was.
"""

from __future__ import annotations

import csv
import enum
import hashlib
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import typer

from sims.pouring import ACTIONS, MATERIALS, SKILLS, Material, PouringWorld, SimulationFailed
from sims.pouring.behaviour import SPHERE_AMOUNT, SPILL_AMOUNT
from sims.pouring.observation import flow
from sims.pouring.simulation import Simulation

FOLDER = Path(__file__).parent
MOUTHS = (0.11, 0.13, 0.17, 0.20, 0.23, 0.25)
GOOD = {
    "tip": {"pour_position": (-0.19, 0.33), "tilt_rate": 0.014, "search_rate": 0.003},
    "shake": {
        "pour_position": (-0.20, 0.33),
        "tilt_rate": 0.014,
        "shake_speed": 0.75,
        "shake_stroke": (0.06, -1.5708),
    },
}
SETUPS = {"tip": ("bnc", 0.23), "shake": ("vsc", 0.13)}  # the paper's SETUP1 and SETUP2
TARGET = 55  # spheres that are more than the target amount 0.3
CANDIDATES = 40  # random action sets per skill
ACTION_SET = ("skill", "px", "pz", "tilt_rate", "search_rate", "shake_speed", "shake_length", "shake_angle")
GIVEN = (
    "label",
    "material",
    "bounce",
    "friction",
    "attraction",
    "reach",
    "mouth",
    "skill",
    "seed",
    "px",
    "pz",
    "tilt_rate",
    "search_rate",
    "shake_speed",
    "shake_length",
    "shake_angle",
)
MEASURED = (
    "received",
    "spilled",
    "released",
    "stop",
    "skill_time",
    "simulated_time",
    "cpu",
    "flow_x",
    "flow_variance",
    "leaked",
    "slowed",
    "lift",
    "failed",
    "digest",
)
AT_STOP = ("received_at_stop", "released_at_stop")  # wanted of the best action sets only


Actions = dict[str, float | tuple[float, float]]


@dataclass(frozen=True)
class Attempt:
    """One attempt to measure: the setup, the skill with its actions, the seed, and what it is for."""

    label: str
    material: Material
    name: str
    mouth: float
    skill: str
    actions: Actions
    seed: int

    def columns(self) -> dict[str, object]:
        """What identifies the attempt in a file."""
        px, pz = self.actions["pour_position"]
        length, angle = self.actions.get("shake_stroke", ("", ""))
        return {
            "label": self.label,
            "material": self.name,
            "bounce": self.material.bounce,
            "friction": self.material.friction,
            "attraction": self.material.attraction,
            "reach": self.material.reach,
            "mouth": self.mouth,
            "skill": self.skill,
            "seed": self.seed,
            "px": px,
            "pz": pz,
            "tilt_rate": self.actions["tilt_rate"],
            "search_rate": self.actions.get("search_rate", ""),
            "shake_speed": self.actions.get("shake_speed", ""),
            "shake_length": length,
            "shake_angle": angle,
        }


def perform(attempt: Attempt) -> dict[str, object]:
    """Run one attempt and return its row."""
    world = PouringWorld(attempt.material, attempt.mouth)
    actions = {"grasp_ratio": 0.3, **attempt.actions}
    world.reset(attempt.seed)
    at_stop: list[int] = []

    def look(simulation: Simulation) -> None:
        # The census still counts the moment before this step: the first time, that at which the skill stopped.
        if not at_stop and world.behaviour.trial.stopped is not None:
            census = world.behaviour.census
            at_stop.extend([census.in_receiver, len(census.classes) - census.in_source])

    world.behaviour.simulation.listeners.append(look)
    begin = time.process_time()  # settled starts are reused where a learner meets a setup again: not counted
    failed = 0
    try:
        while world.node != "poured":
            world.execute(world.node, actions, {"skill": attempt.skill})
    except SimulationFailed:
        failed = 1
    cpu = time.process_time() - begin
    behaviour = world.behaviour
    census, simulation = behaviour.census, behaviour.simulation
    measured = flow(behaviour)
    return attempt.columns() | {
        "received": census.in_receiver,
        "spilled": census.spilled,
        "released": len(census.classes) - census.in_source,
        "stop": behaviour.trial.stopped,
        "received_at_stop": at_stop[0] if at_stop else "",
        "released_at_stop": at_stop[1] if at_stop else "",
        "skill_time": round(behaviour.trial.duration, 3),
        "simulated_time": round(behaviour.time, 3),
        "cpu": round(cpu, 3),
        "flow_x": round(float(measured["flow_centre"][0]), 4),
        "flow_variance": round(float(measured["flow_variance"]), 5),
        "leaked": len(census.leaked),
        "slowed": simulation.slowed,
        "lift": round(max([clamp.used[0] for clamp in world.clamps if clamp.label == "lift"], default=0.0), 4),
        "failed": failed,
        "digest": hashlib.sha256(simulation.data.qpos.tobytes()).hexdigest()[:16],
    }


def table() -> Iterator[Attempt]:
    """All materials and mouths with both skills at fixed good parameters."""
    for seed in range(5):
        for mouth in MOUTHS:
            for name, material in MATERIALS.items():
                for skill in SKILLS:
                    yield Attempt("table", material, name, mouth, skill, GOOD[skill], seed)


def jamming() -> Iterator[Attempt]:
    """Tipping viscous material at mouth 0.13: less attraction, less friction, a wider mouth."""
    vsc = MATERIALS["vsc"]
    for seed in range(5):
        for share in (1.0, 0.8, 0.6, 0.4, 0.2, 0.0):
            material = replace(vsc, attraction=share * vsc.attraction)
            yield Attempt(f"attraction {share}", material, "vsc", 0.13, "tip", GOOD["tip"], seed)
        for share in (1.0, 0.8, 0.6, 0.4, 0.3, 0.2, 0.0):
            material = replace(vsc, friction=max(0.001, share * vsc.friction))
            yield Attempt(f"friction {share}", material, "vsc", 0.13, "tip", GOOD["tip"], seed)
        for mouth in (0.13, 0.15, 0.17, 0.19, 0.21, 0.23, 0.25):
            yield Attempt(f"mouth {mouth}", vsc, "vsc", mouth, "tip", GOOD["tip"], seed)


def extremes() -> Iterator[Attempt]:
    """100 random action sets per skill over all bounds, in random setups."""
    generator = np.random.default_rng(0)
    for number in range(100):
        for skill in SKILLS:
            name = str(generator.choice(list(MATERIALS)))
            mouth = round(float(generator.uniform(0.11, 0.25)), 4)
            drawn = {label: generator.uniform(bounds.low, bounds.high).round(4) for label, bounds in ACTIONS.items()}
            actions = {label: tuple(v.tolist()) if len(v) > 1 else float(v[0]) for label, v in drawn.items()}
            yield Attempt(f"random {number}", MATERIALS[name], name, mouth, skill, actions, number)


def again() -> Iterator[Attempt]:
    """Every fifth of the random attempts once more, in another process than the first time."""
    yield from list(extremes())[::5]


def dependence() -> Iterator[Attempt]:
    """One action after the other varied, tipping at SETUP1 and shaking at SETUP2, 10 seeds each."""
    tip, shake = GOOD["tip"], GOOD["shake"]
    variations: list[tuple[str, Actions]] = [("tip", tip), ("shake", shake)]
    variations += [("tip", {**tip, "tilt_rate": rate}) for rate in (0.010, 0.017, 0.020)]
    variations += [("tip", {**tip, "search_rate": rate}) for rate in (0.002, 0.004, 0.005)]
    variations += [("tip", {**tip, "pour_position": (x, 0.33)}) for x in (-0.29, -0.24, -0.14, -0.09)]
    variations += [("tip", {**tip, "pour_position": (-0.19, z)}) for z in (0.38, 0.43, 0.48)]
    variations += [("shake", {**shake, "shake_speed": speed}) for speed in (0.70, 0.80, 0.90)]
    variations += [("shake", {**shake, "shake_stroke": (length, -1.5708)}) for length in (0.05, 0.08, 0.10)]
    variations += [("shake", {**shake, "shake_stroke": (0.06, angle)}) for angle in (-0.7854, 0.0, 0.7854, 1.5708)]
    variations += [("shake", {**shake, "pour_position": (x, 0.33)}) for x in (-0.30, -0.25, -0.15, -0.10)]
    for seed in range(10):
        for skill, actions in variations:
            yield _at_setup("dependence", skill, actions, seed)


def search() -> Iterator[Attempt]:
    """Random action sets over all that is useful, 2 seeds each."""
    generator = np.random.default_rng(1)
    ranges = {label: (bounds.low, bounds.high) for label, bounds in ACTIONS.items()}
    ranges["pour_position"] = ((-0.26, 0.32), (-0.08, 0.45))  # elsewhere much is spilled, see `dependence`
    candidates = []
    for _ in range(CANDIDATES):
        drawn = {label: generator.uniform(*limits).round(4).tolist() for label, limits in ranges.items()}
        values = {label: tuple(value) if len(value) > 1 else value[0] for label, value in drawn.items()}
        candidates += [(skill, {label: values[label] for label in GOOD[skill]}) for skill in SKILLS]
    for seed in range(2):
        for skill, actions in candidates:
            yield _at_setup("search", skill, actions, seed)


def finals() -> Iterator[Attempt]:
    """The best of the search, 10 seeds each."""
    yield from _tried("finals", _best(("search",), 6), range(10))


def refined() -> Iterator[Attempt]:
    """Action sets near the best so far, 10 seeds each."""
    generator = np.random.default_rng(2)
    near = []
    for skill, best in _best(("finals", "dependence"), 1):
        for _ in range(5):
            actions = {}
            for label, value in best.items():
                low, high = np.array(ACTIONS[label].low), np.array(ACTIONS[label].high)
                moved = value + generator.uniform(-0.15, 0.15, len(low)) * (high - low)
                drawn = np.clip(moved, low, high).round(4).tolist()
                actions[label] = tuple(drawn) if len(drawn) > 1 else drawn[0]
            near.append((skill, actions))
    yield from _tried("refined", near, range(10))


def fresh() -> Iterator[Attempt]:
    """The best of all that was tried with 10 seeds, on 10 seeds that had no part in choosing them."""
    yield from _tried("fresh", _best(("finals", "dependence", "refined"), 3), range(100, 110))


def _at_setup(label: str, skill: str, actions: Actions, seed: int) -> Attempt:
    name, mouth = SETUPS[skill]
    return Attempt(label, MATERIALS[name], name, mouth, skill, actions, seed)


def _tried(label: str, sets: Sequence[tuple[str, Actions]], seeds: range) -> Iterator[Attempt]:
    for skill, actions in sets:
        for seed in seeds:
            yield _at_setup(label, skill, actions, seed)


def _best(names: tuple[str, ...], count: int) -> list[tuple[str, Actions]]:
    """The best action sets of each skill in measured files, judged by `keeps`."""
    groups: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for file_name in names:
        with (FOLDER / f"{file_name}.csv").open(newline="") as file:
            for row in csv.DictReader(file):
                groups.setdefault(tuple(row[name] for name in ACTION_SET), []).append(row)
    ranked = sorted(groups, key=lambda key: keeps(groups[key]).cost)
    return [(skill, _actions(key)) for skill in SKILLS for key in [key for key in ranked if key[0] == skill][:count]]


def _actions(key: tuple[str, ...]) -> Actions:
    """The actions of a row's `ACTION_SET`."""
    given = {name: float(text) for name, text in zip(ACTION_SET[1:], key[1:], strict=True) if text}
    values: Actions = given | {"pour_position": (given["px"], given["pz"])}
    if key[0] == "shake":
        values["shake_stroke"] = (given["shake_length"], given["shake_angle"])
    return {name: values[name] for name in GOOD[key[0]]}


@dataclass(frozen=True)
class Kept:
    """What an action set keeps to in 8 of 10 attempts: its cost, spheres short, over and spilled at most."""

    cost: float
    short: int
    over: int
    spilled: int


def keeps(rows: Sequence[Mapping[str, str]]) -> Kept:
    """Judge the attempts of one action set by the cheapest 80 % under equation (8), in spheres."""
    received = np.array([float(row["received"]) for row in rows])
    spilled = np.array([float(row["spilled"]) for row in rows])
    short, over = np.maximum(0, TARGET - received), np.maximum(0, received - TARGET)
    amount = SPHERE_AMOUNT
    cost = 100 * (amount * short) ** 2 + 10 * (SPILL_AMOUNT * spilled) ** 2 + (amount * over) ** 2
    kept = np.argsort(cost)[: math.ceil(0.8 * len(rows))]
    return Kept(float(cost[kept].max()), int(short[kept].max()), int(over[kept].max()), int(spilled[kept].max()))


def measure(name: str, attempts: Iterator[Attempt]) -> None:
    """Add the rows that are missing to a CSV file."""
    path = FOLDER / f"{name}.csv"
    done: list[list[str]] = []
    if path.exists():
        with path.open(newline="") as file:
            done = [row[: len(GIVEN)] for row in csv.reader(file)]
    with path.open("a", newline="") as file:
        columns = GIVEN + MEASURED + (AT_STOP if name == "fresh" else ())
        writer = csv.DictWriter(file, columns, extrasaction="ignore")
        if file.tell() == 0:
            writer.writeheader()
        for attempt in attempts:
            if [str(value) for value in attempt.columns().values()] not in done:
                writer.writerow(perform(attempt))
                file.flush()


EXPERIMENTS = {
    function.__name__: function
    for function in (table, jamming, extremes, again, dependence, search, finals, refined, fresh)
}

Experiment = enum.StrEnum("Experiment", list(EXPERIMENTS))


def main(experiments: list[Experiment]) -> None:
    """Measure what is named, where it has not been measured already."""
    for name in experiments:
        measure(name, EXPERIMENTS[name]())


if __name__ == "__main__":
    typer.run(main)
