"""Measure where the time of an attempt goes and what a second process gains.

Run from the repository's root on an otherwise idle machine:
`PYTHONPATH=. python docs/reproduction/pouring_world/speed.py`.
"""

from __future__ import annotations

import csv
import os
import time
from pathlib import Path

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
    Attraction.accelerations = timed  # type: ignore[method-assign]
    begin, cpu = time.perf_counter(), time.process_time()
    try:
        while world.node != "poured":
            world.execute(world.node, ACTIONS, {"skill": skill})
    finally:
        Attraction.accelerations = plain  # type: ignore[method-assign]
    cpu, total = time.process_time() - cpu, time.perf_counter() - begin
    step = timers[mujoco.mjtTimer.mjTIMER_STEP].duration
    solver = timers[mujoco.mjtTimer.mjTIMER_CONSTRAINT].duration
    return {"CPU seconds": cpu, "attraction": spent / total, "MuJoCo's step": step / total, "solver": solver / total}


def speed_up(episodes: int = 10, rounds: int = 2) -> tuple[float, float]:
    """Return the wall-clock times of the same episodes in one and in two processes, best of the rounds."""
    times: dict[int, list[float]] = {1: [], 2: []}
    setup = {"material": "wat", "mouth": 0.25}
    run_episodes([(setup, ACTIONS, "shake", 0)] * 2, 1, 2)  # starts the processes
    for number in range(rounds):
        seeds = range(100 * number, 100 * number + episodes)  # none has been settled before
        jobs = [(setup, ACTIONS, "shake", seed) for seed in seeds]
        for processes, taken in times.items():
            begin = time.perf_counter()
            run_episodes(jobs, 1, processes)
            taken.append(time.perf_counter() - begin)
    return min(times[1]), min(times[2])


def write(name: str, rows: list[dict[str, object]]) -> None:
    """Write a table beside this script."""
    with (FOLDER / f"{name}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    load = round(os.getloadavg()[0], 1)
    rows = [
        {"material": material, "skill": skill}
        | {name: round(value, 3) for name, value in shares(material, skill).items()}
        for material in MATERIALS
        for skill in SKILLS
    ]
    write("speed", rows)
    one, two = speed_up()
    times = {"10 episodes in one process": one, "in two processes": two, "speed-up": one / two}
    write("processes", [{name: round(value, 2) for name, value in times.items()} | {"load average before": load}])
