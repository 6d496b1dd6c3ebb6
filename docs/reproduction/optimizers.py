"""Compare the optimizers: how good and how fast their plans are, on tasks of several kinds.

From the repository's root, `python docs/reproduction/optimizers.py`. Every plan is written to optimizers/results.csv as
soon as it is made; a run that was stopped goes on where it was. table.csv is made from that file alone.
"""

import csv
import functools
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from rich.progress import track

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from hock_schittkowski import HOCK_SCHITTKOWSKI
from mixed_integer import MIXED_INTEGER

import symgraph as sg
from models import cannon, push

FOLDER = Path(__file__).with_suffix("")
RESULTS, TABLE = FOLDER / "results.csv", FOLDER / "table.csv"
COLUMNS = ("task", "case", "optimizer", "seed", "value", "violation", "gradients", "seconds")
SEEDS = range(3)
CLOSE, MET = 1e-4, 1e-5  # a plan that is nearly the best: to its value, relative where that is large; to requirements

OPTIMIZERS = {
    "Lbfgs()": sg.Lbfgs(),
    "Lbfgs(starts=64)": sg.Lbfgs(starts=64),
    "Adadelta()": sg.Adadelta(),
    "Adadelta.paper()": sg.Adadelta.paper(),
    "Ipopt()": sg.Ipopt(),
    "Enumerate()": sg.Enumerate(),
    "Enumerate(Ipopt())": sg.Enumerate(sg.Ipopt()),
    "Bonmin()": sg.Bonmin(),
}


@dataclass(frozen=True)
class Case:
    """A situation of a task, with the best value known if there is one."""

    name: str
    graph: Callable[[], sg.Graph]
    state: Mapping[str, Any]
    best: float | None = None


def switches() -> sg.Graph:
    """Twelve switches, each of which moves what the actions must make up for: 4,096 combinations."""
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(12, 3))
    slots = {"u": sg.Action(3, low=-1, high=1)} | {f"s{k}": sg.Selection(["off", "on"]) for k in range(12)}
    graph = sg.Graph(slots | {"total": sg.State(3)}, start="add 0")
    graph.edge("add 0", "add 1", lambda u: {"total": 3 * u - 2})
    for k in range(12):
        moved = sg.Model(lambda total, s, k=k: {"total": total + s[1] * ca.DM(weights[k])}, rename={"s": f"s{k}"})
        graph.edge(f"add {k + 1}", f"add {k + 2}", moved)
        graph.reward(f"add {k + 1}", sg.Model(lambda s: -0.05 * s[1], rename={"s": f"s{k}"}))
    graph.reward("add 13", lambda total, u: -ca.sumsqr(total) - 0.3 * ca.sumsqr(ca.sin(7 * u)))
    return graph


def cases() -> dict[str, list[Case]]:
    """The cases of each task."""
    rng = np.random.default_rng(0)
    places = [(rng.uniform(0.2, 0.8, 2), rng.uniform(0.2, 0.8, 2)) for _ in range(20)]
    return {
        "cannon": [Case(f"{x:g}", cannon.graph, cannon.state(x)) for x in np.linspace(0.05, 1.5, 20).round(3).tolist()],
        "push": [Case(str(k), push.graph, push.state(a, 0.02, b, 0.05)) for k, (a, b) in enumerate(places)],
        "constrained": [Case(f"HS{one.number}", one.graph, {}, -one.value) for one in HOCK_SCHITTKOWSKI],
        "mixed-integer": [Case(one.name, one.graph, {}, -one.value) for one in MIXED_INTEGER],
        "4,096 combinations": [Case("switches", switches, {})],
    }


@functools.cache
def objective_of(graph: Callable[[], sg.Graph]) -> sg.Objective:
    """Built once for all that plan with it."""
    return sg.Objective(sg.unroll(graph()))


def read() -> list[dict[str, str]]:
    """The plans so far; a line that a stopped run left half-written is dropped from the file."""
    if not RESULTS.exists():
        FOLDER.mkdir(exist_ok=True)
        RESULTS.write_text(",".join(COLUMNS) + "\n")
    lines = RESULTS.read_text().splitlines(keepends=True)
    if not lines[-1].endswith("\n"):
        RESULTS.write_text("".join(lines[:-1]))
    return list(csv.DictReader(line for line in lines if line.endswith("\n")))


def plan_all() -> None:
    """Make the plans that are not in the file yet."""
    done = {tuple(row[name] for name in COLUMNS[:4]) for row in read()}
    jobs = [
        (task, case, name, seed)
        for task, those in cases().items()
        for case in those
        for name in OPTIMIZERS
        for seed in SEEDS
        if (task, case.name, name, str(seed)) not in done
    ]
    with RESULTS.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        warm = set()  # what was built and compiled already
        for task, case, name, seed in track(jobs, description="planning"):
            objective = objective_of(case.graph)
            if (case.graph, name) not in warm:
                sg.solve(objective, case.state, OPTIMIZERS[name], time_limit=10.0, progress=False)
                warm.add((case.graph, name))
            begin = time.process_time()
            plan = sg.solve(objective, case.state, OPTIMIZERS[name], seed=seed, time_limit=30.0, progress=False)
            seconds = time.process_time() - begin
            gradients = sum(run.gradients for run in plan.runs)
            writer.writerow(
                (task, case.name, name, seed, repr(plan.value), f"{plan.violation:.3g}", gradients, f"{seconds:.3g}")
            )
            file.flush()


def summarise() -> None:
    """Write the table: of each task and optimizer, how many plans are nearly the best, and how long they took."""
    rows = [row for row in read() if row["optimizer"] in OPTIMIZERS]
    known = {(task, case.name): case.best for task, those in cases().items() for case in those}
    best: dict[tuple[str, str], float] = defaultdict(lambda: -np.inf)
    for row in rows:
        key = row["task"], row["case"]
        if float(row["violation"]) <= MET:
            best[key] = max(best[key], float(row["value"]))
    lines = []
    for task in cases():
        for name in OPTIMIZERS:
            mine = [row for row in rows if (row["task"], row["optimizer"]) == (task, name)]
            if not mine:
                continue
            good = 0
            for row in mine:
                key = task, row["case"]
                top = best[key] if known[key] is None else known[key]
                gap = (top - float(row["value"])) / max(1.0, abs(top))
                good += gap <= CLOSE and float(row["violation"]) <= MET
            seconds = [float(row["seconds"]) for row in mine]
            lines.append(
                {
                    "task": task,
                    "optimizer": name,
                    "plans": len(mine),
                    "best found [%]": round(100 * good / len(mine)),
                    "median time [ms]": f"{1e3 * statistics.median(seconds):.3g}",
                    "largest violation": f"{max(float(row['violation']) for row in mine):.1e}",
                }
            )
    with TABLE.open("w", newline="") as file:
        writer = csv.DictWriter(file, lines[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)


if __name__ == "__main__":
    plan_all()
    summarise()
