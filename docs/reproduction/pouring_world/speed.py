"""Measure where the time of an attempt goes and what a second process gains.

Run from the repository's root on an otherwise idle machine:
`PYTHONPATH=. python docs/reproduction/pouring_world/speed.py`.
"""

from __future__ import annotations

import csv
import os
import time
from pathlib import Path

import joblib
import mujoco
import numpy as np

from sims.pouring import MATERIALS, SKILLS, PouringWorld, run_episodes
from sims.pouring.attraction import Attraction

FOLDER = Path(__file__).parent
ACTIONS = {
    "grasp_ratio": 0.3,
    "pour_position": (-0.2, 0.33),
    "tilt_rate": 0.014,
    "search_rate": 0.003,
    "shake_speed": 0.75,
    "shake_stroke": (0.06, -1.5708),
}


def shares(material: str, skill: str) -> dict[str, float]:
    """Return the CPU time of an attempt, and the shares of the attraction, MuJoCo's step and its solver."""
    spent = 0.0
    plain = Attraction.accelerations

    def timed(self: Attraction, positions: np.ndarray) -> np.ndarray:
        nonlocal spent
        begin = time.perf_counter()
        accelerations = plain(self, positions)
        spent += time.perf_counter() - begin
        return accelerations

    world = PouringWorld(material, 0.17)
    world.reset(0)
    timers = world.behaviour.simulation.data.timer
    Attraction.accelerations = timed  # type: ignore[method-assign]  # to be timed
    begin, cpu = time.perf_counter(), time.process_time()
    try:
        while world.node != "poured":
            world.execute(world.node, ACTIONS, {"skill": skill})
    finally:
        Attraction.accelerations = plain  # type: ignore[method-assign]  # as it was
    cpu, total = time.process_time() - cpu, time.perf_counter() - begin
    step = timers[mujoco.mjtTimer.mjTIMER_STEP].duration
    solver = timers[mujoco.mjtTimer.mjTIMER_CONSTRAINT].duration
    return {"CPU seconds": cpu, "attraction": spent / total, "MuJoCo's step": step / total, "solver": solver / total}


def side_by_side(episodes: int = 10) -> list[dict[str, object]]:
    """Time like episodes in one and in two processes."""
    setup = {"material": "wat", "mouth": 0.25}
    rows: list[dict[str, object]] = []
    for processes in (1, 2):
        run = joblib.Parallel(n_jobs=processes)
        run([joblib.delayed(cpu_seconds)(setup, seed) for seed in range(processes)])  # starts the processes
        load, begin = os.getloadavg()[0], time.perf_counter()
        # None of these seeds has been settled before.
        first = 1000 * processes
        cpu = sum(run([joblib.delayed(cpu_seconds)(setup, seed) for seed in range(first, first + episodes)]))
        taken = time.perf_counter() - begin
        values = {"seconds": round(taken, 2), "CPU seconds": round(cpu, 2), "cores used": round(cpu / taken, 2)}
        rows.append({"processes": processes, "episodes": episodes} | values | {"load before": round(load, 1)})
    return rows


def cpu_seconds(setup: dict[str, object], seed: int) -> float:
    """Return the CPU time of an episode in the process that runs it."""
    begin = time.process_time()
    run_episodes([(setup, ACTIONS, "shake", seed)], 1)
    return time.process_time() - begin


def write(name: str, rows: list[dict[str, object]]) -> None:
    """Write a table beside this script."""
    with (FOLDER / f"{name}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    rows = [
        {"material": material, "skill": skill}
        | {name: round(value, 3) for name, value in shares(material, skill).items()}
        for material in MATERIALS
        for skill in SKILLS
    ]
    write("speed", rows)
    write("processes", side_by_side())
