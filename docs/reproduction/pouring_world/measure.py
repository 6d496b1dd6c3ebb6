"""Measure the pouring world: one attempt per row, written to CSV files beside this script as it happens.

Run from the repository's root, `PYTHONPATH=. python docs/reproduction/pouring_world/measure.py table
jamming`. Rows that are in a file already are not measured again, so a stopped run goes on where it was.
"""

from __future__ import annotations

import csv
import enum
import hashlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import typer

from sims.pouring import ACTIONS, MATERIALS, SKILLS, Material, PouringWorld, SimulationFailed
from sims.pouring.observation import flow

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
COLUMNS = GIVEN + MEASURED


@dataclass(frozen=True)
class Attempt:
    """One attempt to measure: the setup, the skill with its actions, the seed, and what it is for."""

    label: str
    material: Material
    name: str
    mouth: float
    skill: str
    actions: dict[str, float | tuple[float, float]]
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
    variations: list[tuple[str, dict[str, float | tuple[float, float]]]] = [("tip", tip), ("shake", shake)]
    variations += [("tip", {**tip, "tilt_rate": rate}) for rate in (0.010, 0.017, 0.020)]
    variations += [("tip", {**tip, "search_rate": rate}) for rate in (0.002, 0.004, 0.005)]
    variations += [("tip", {**tip, "pour_position": (x, 0.33)}) for x in (-0.29, -0.24, -0.14, -0.09)]
    variations += [("tip", {**tip, "pour_position": (-0.19, z)}) for z in (0.38, 0.43, 0.48)]
    variations += [("shake", {**shake, "shake_speed": speed}) for speed in (0.70, 0.80, 0.90)]
    variations += [("shake", {**shake, "shake_stroke": (length, -1.5708)}) for length in (0.05, 0.08, 0.10)]
    variations += [("shake", {**shake, "shake_stroke": (0.06, angle)}) for angle in (-0.7854, 0.0, 0.7854, 1.5708)]
    variations += [("shake", {**shake, "pour_position": (x, 0.33)}) for x in (-0.30, -0.25, -0.15, -0.10)]
    setups = {"tip": ("bnc", 0.23), "shake": ("vsc", 0.13)}
    for seed in range(10):
        for skill, actions in variations:
            name, mouth = setups[skill]
            yield Attempt("dependence", MATERIALS[name], name, mouth, skill, actions, seed)


def best() -> Iterator[Attempt]:
    """Random action sets in the useful part of the bounds, tipping at SETUP1 and shaking at SETUP2."""
    generator = np.random.default_rng(1)
    candidates: list[tuple[str, dict[str, float | tuple[float, float]]]] = []
    for _ in range(12):
        x, z = (
            round(float(generator.uniform(-0.26, -0.14)), 4),
            round(float(generator.uniform(0.32, 0.38)), 4),
        )
        rates = [round(float(generator.uniform(b.low[0], b.high[0])), 4) for b in _rates()]
        candidates.append(("tip", {"pour_position": (x, z), "tilt_rate": rates[0], "search_rate": rates[1]}))
        stroke = generator.uniform(ACTIONS["shake_stroke"].low, ACTIONS["shake_stroke"].high).round(4)
        candidates.append(
            (
                "shake",
                {
                    "pour_position": (x, z),
                    "tilt_rate": rates[0],
                    "shake_speed": rates[2],
                    "shake_stroke": tuple(stroke.tolist()),
                },
            )
        )
    for seed in range(10):
        for number, (skill, actions) in enumerate(candidates):
            name, mouth = {"tip": ("bnc", 0.23), "shake": ("vsc", 0.13)}[skill]
            yield Attempt(f"candidate {number}", MATERIALS[name], name, mouth, skill, actions, seed)


def _rates() -> tuple:
    return ACTIONS["tilt_rate"], ACTIONS["search_rate"], ACTIONS["shake_speed"]


def measure(name: str, attempts: Iterator[Attempt]) -> None:
    """Add the rows that are missing to a CSV file."""
    path = FOLDER / f"{name}.csv"
    done: list[list[str]] = []
    if path.exists():
        with path.open(newline="") as file:
            done = [row[: len(COLUMNS) - len(MEASURED)] for row in csv.reader(file)]
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        if file.tell() == 0:
            writer.writeheader()
        for attempt in attempts:
            if [str(value) for value in attempt.columns().values()] not in done:
                writer.writerow(perform(attempt))
                file.flush()


EXPERIMENTS = {function.__name__: function for function in (table, jamming, extremes, again, dependence, best)}

Experiment = enum.StrEnum("Experiment", list(EXPERIMENTS))


def main(experiments: list[Experiment]) -> None:
    """Measure what is named, where it has not been measured already."""
    for name in experiments:
        measure(name, EXPERIMENTS[name]())


if __name__ == "__main__":
    typer.run(main)
