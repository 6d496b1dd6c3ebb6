"""Reproduce figure 3 of the paper, and tell how good and how fast each optimizer's plans for it are.

Writes every plan to cannon/results.csv as soon as it is made, then table.csv and figure.svg from that file
alone. A run that was stopped goes on where it was; to make plans anew, delete their rows.
"""

import csv
import statistics
import sys
import time
from collections import defaultdict
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests/models")]

import cannon_oracle as oracle

import symgraph as sg
from models import cannon

FOLDER = Path(__file__).with_suffix("")
RESULTS = FOLDER / "results.csv"
COLUMNS = ["optimizer", "spacing_m", "seed", "target_x_m", "cannon", "theta_rad", "cpu_seconds"]

OPTIMIZERS = {
    "default": None,
    "Lbfgs()": sg.Lbfgs(),
    "Adadelta()": sg.Adadelta(),
    "Adadelta.paper()": sg.Adadelta.paper(),
    "Ipopt()": sg.Ipopt(),
}
SPACINGS = [0.05, 0.0375, 0.01]  # of the targets over (0, 1.5]; the paper has 40, which is 0.0375 [m]
SEEDS = range(5)
GAP_LIMIT = 1e-9  # a plan this close to the optimum counts as optimal [m^2]


def targets(spacing: float) -> list[float]:
    """Targets over (0, 1.5] [m]."""
    return [round(spacing * i, 6) for i in range(1, round(1.5 / spacing) + 1)]


def read() -> list[dict[str, str]]:
    """The plans so far; a line that a stopped run left half-written is dropped from the file."""
    if not RESULTS.exists():
        RESULTS.parent.mkdir(exist_ok=True)
        RESULTS.write_text(",".join(COLUMNS) + "\n")
    lines = RESULTS.read_text().splitlines(keepends=True)
    if not lines[-1].endswith("\n"):
        RESULTS.write_text("".join(lines[:-1]))
    return list(csv.DictReader(line for line in lines if line.endswith("\n")))


def plan_all() -> None:
    """Make the plans that are not in the file yet."""
    done = {tuple(row[name] for name in COLUMNS[:4]) for row in read()}
    objective = sg.Objective(sg.unroll(cannon.graph()))
    jobs = [
        (name, optimizer, spacing, seed, x)
        for name, optimizer in OPTIMIZERS.items()
        for spacing in SPACINGS
        for seed in SEEDS
        for x in targets(spacing)
        if (name, str(spacing), str(seed), str(x)) not in done
    ]
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns) as progress, RESULTS.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        bar = progress.add_task("planning", total=len(jobs))
        warm = set()  # optimizers whose first plan, which compiles, is behind us
        for name, optimizer, spacing, seed, x in jobs:
            progress.update(bar, description=name)
            if name not in warm:
                sg.solve(objective, cannon.state(x), optimizer, progress=False)
                warm.add(name)
            begin = time.process_time()  # of one core, whatever else the machine does
            plan = sg.solve(objective, cannon.state(x), optimizer, seed=seed, progress=False)
            seconds = time.process_time() - begin
            theta = repr(plan.actions["theta"])
            writer.writerow([name, spacing, seed, x, plan.selections["cannon"], theta, f"{seconds:.6f}"])
            file.flush()
            progress.advance(bar)


def tabulate(rows: list[dict[str, str]]) -> None:
    """Write table.csv: a line per optimizer."""
    wrong = defaultdict(int)  # (optimizer, spacing) -> plans with the wrong cannon
    gaps, seconds = defaultdict(list), defaultdict(list)
    for row in rows:
        name, x = row["optimizer"], float(row["target_x_m"])
        best = oracle.best(x)
        wrong[name, row["spacing_m"]] += row["cannon"] != best.cannon
        gaps[name].append(best.value - float(oracle.reward(row["cannon"], float(row["theta_rad"]), x)))
        seconds[name].append(float(row["cpu_seconds"]))
    counts = {spacing: len(SEEDS) * len(targets(spacing)) for spacing in SPACINGS}
    header = ["optimizer"]
    header += [f"wrong of {counts[spacing]} ({spacing} m)" for spacing in SPACINGS]
    header += [f"gap > {GAP_LIMIT:.0e} of {sum(counts.values())}", "largest gap [m²]", "median gap [m²]"]
    header += ["median CPU time [ms]"]
    with (FOLDER / "table.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        for name in OPTIMIZERS:
            gap = np.array(gaps[name])
            line = [name, *(wrong[name, str(spacing)] for spacing in SPACINGS), (gap > GAP_LIMIT).sum()]
            line += [f"{max(0.0, gap.max()):.1e}", f"{max(0.0, np.median(gap)):.1e}"]  # -1e-20 is rounding
            writer.writerow([*line, f"{1e3 * statistics.median(seconds[name]):.1f}"])


def draw(rows: list[dict[str, str]]) -> None:
    """Write figure.svg: the paper's figure 3, planned by default and with the paper's settings."""
    colors = {"lower": "tab:blue", "upper": "tab:orange"}
    markers = {"right": "o", "wrong": "x", "approximation": "^"}
    mpl.rcParams.update({"svg.hashsalt": "cannon", "svg.fonttype": "none"})
    figure, panels = plt.subplots(1, 2, figsize=(11, 4.5), sharey=True, layout="constrained")
    for axes, name in zip(panels, ["default", "Adadelta.paper()"], strict=True):
        for choice, color in colors.items():
            x = np.linspace(1e-3, oracle.reach(choice) * (1 - 1e-12), 500)
            theta = [oracle.arcs(choice, at)[0] for at in x]
            axes.plot(x, theta, color=color, label=f"{choice} cannon, analytic")
        shown = [row for row in rows if (row["optimizer"], row["spacing_m"], row["seed"]) == (name, "0.0375", "0")]
        for row in shown:
            choice, x = row["cannon"], float(row["target_x_m"])
            right = choice == oracle.best(x).cannon
            kind = "wrong" if not right else "right" if oracle.arcs(choice, x) else "approximation"
            axes.plot(
                x,
                float(row["theta_rad"]),
                markers[kind],
                color=colors[choice],
                fillstyle="none",
                markersize=7,
            )
        axes.set(title=name, xlabel="target x [m]")
    for kind, marker in markers.items():
        panels[1].plot([], [], marker, color="black", fillstyle="none", label=f"planned: {kind}")
    panels[0].set(ylabel="theta [rad]")
    panels[1].legend(loc="lower right")
    figure.savefig(FOLDER / "figure.svg", metadata={"Date": None})


if __name__ == "__main__":
    plan_all()
    tabulate(read())
    draw(read())
