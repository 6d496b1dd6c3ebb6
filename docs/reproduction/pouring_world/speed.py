"""Measure the attraction's share of an attempt and what a second process gains.

Run from the repository's root on an otherwise idle machine:
`PYTHONPATH=. python docs/reproduction/pouring_world/speed.py`.
"""

from __future__ import annotations

import csv
import os
import time
from pathlib import Path

import numpy as np

from sims.pouring import PouringWorld, run_episodes
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


def attraction_share(material: str, skill: str) -> tuple[float, float]:
    """Return the CPU time of an attempt and the part of it that goes into the attraction."""
    spent = 0.0
    plain = Attraction.accelerations

    def timed(self: Attraction, positions: np.ndarray) -> np.ndarray:
        nonlocal spent
        begin = time.process_time()
        accelerations = plain(self, positions)
        spent += time.process_time() - begin
        return accelerations

    world = PouringWorld(material, 0.17)
    world.reset(0)
    Attraction.accelerations = timed  # type: ignore[method-assign]
    begin = time.process_time()
    try:
        while world.node != "poured":
            world.execute(world.node, ACTIONS, {"skill": skill})
    finally:
        Attraction.accelerations = plain  # type: ignore[method-assign]
    total = time.process_time() - begin
    return total, spent / total


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


if __name__ == "__main__":
    rows: list[list[object]] = [["what", "value"]]
    for material in ("vsc", "vsc+"):
        for skill in ("tip", "shake"):
            cpu, share = attraction_share(material, skill)
            rows.append([f"{material} {skill}: CPU seconds", round(cpu, 2)])
            rows.append([f"{material} {skill}: share of the attraction", round(share, 3)])
    rows.append(["load average before", round(os.getloadavg()[0], 1)])
    one, two = speed_up()
    rows.append(["10 episodes in one process, seconds", round(one, 2)])
    rows.append(["10 episodes in two processes, seconds", round(two, 2)])
    rows.append(["speed-up", round(one / two, 2)])
    with (FOLDER / "speed.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
