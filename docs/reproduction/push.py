"""Reproduce section VI of the paper: pushes planned under uncertainty, with analytic and with learned models.

Writes every plan to push/results.csv as soon as it is made, then table.csv and figure.svg from that file alone. A run
that was stopped goes on where it was; to make plans anew, delete their rows. `push.py development` makes the plans
that choices were made by, in situations of their own.
"""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle, Polygon
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

import symgraph as sg
from models import push
from sims import push as world
from symgraph.learned import StochasticNetwork

FOLDER = Path(__file__).with_suffix("")
COLUMNS = ["row", "network", "trial", "gripper_x_m", "gripper_y_m", "theta_rad", "advance_m", "value", "cpu_seconds"]

STEP = 0.05  # of the differences that make the local linear model [m]
SAMPLES = 2000  # pushes that a network learns from
HIDDEN = (200, 200)
TEST, DEVELOPMENT, LEARNING = 1, 2, 3  # what the numbers of trials and networks are joined with, as seeds
NETWORKS = {TEST: [0, 1, 2, 3, 4], DEVELOPMENT: [5, 6]}  # seeds of data and weights alike
TRIALS = 1000
DRAWS = 4000  # of the object, to see what a plan is worth

# One search for all rows: on development trials, networks gain nothing by more starts or iterations. The analytic
# models, whose plans depend on how far one searches, are searched in two more ways.
SEARCH = sg.Lbfgs(starts=6, iterations=60)
DEFAULT_SEARCH = sg.Lbfgs()
PAPER_SEARCH = sg.Adadelta.paper()
RULE = "auto"  # the best on development trials, closely before "quadrature" and "low-rank", which take less time

SHOWN_ROWS = {  # in the figure
    "analytic, linear by differences, the paper's search": "analytic",
    "analytic, zero SD, the paper's search": "analytic, zero SD",
    "network": "network",
}
SHOWN_TRIALS = (8, 13, 4, 3)  # the last one because networks that had learned for less long failed there


@dataclass(frozen=True)
class Row:
    """One way to plan.

    Attributes:
        model: of the push, given the seed of a network; None maximises the probability of success itself.
        search: the optimizer.
        learned: whether the seed of a network matters; trials are then shared evenly by the networks.
        trials: how many, from the first on.
        every: plan each trial with every network.
    """

    model: Callable[[int], Any] | None
    search: sg.Optimizer = SEARCH
    learned: bool = False
    trials: int = TRIALS
    every: bool = False

    def plans(self, networks: list[int]) -> list[tuple[int, int]]:
        """Return (network, trial) of its plans; network -1 where there is none."""
        if not self.learned:
            return [(-1, k) for k in range(self.trials)]
        if self.every:
            return [(network, k) for network in networks for k in range(self.trials)]
        return [(network, k) for i, network in enumerate(networks) for k in range(i, self.trials, len(networks))]


@cache
def network(seed: int, error: str = "none", mirrored: bool = True) -> StochasticNetwork:
    """Return a network that has learned from random pushes.

    The gripper is symmetric: if an object on the left goes there, one on the right goes to the mirror image. Each push
    is learned from as it was and mirrored.
    """
    x, y = world.samples(np.random.default_rng([LEARNING, seed]), SAMPLES)
    if mirrored:
        x, y = np.vstack([x, x * [1, -1, 1]]), np.vstack([y, y * [1, -1]])
    learned = StochasticNetwork({"local": 2, "advance": 1}, {"offset": 2}, HIDDEN, error=error)
    print(f"network {seed}, error {error}: {learned.fit(x, y, seed=seed, progress=False)}")
    return learned


def analytic(rule: str) -> Callable[[int], Any]:
    """The true model under a rule."""
    return lambda seed: sg.Model(push.push, propagation=rule)


def learned(rule: str, **options: Any) -> Callable[[int], Any]:
    """A network under a rule."""
    return lambda seed: network(seed, **options).with_propagation(rule)


def differences(seed: int) -> Any:
    """The paper's local linear model."""
    return push.CentralDifferences(push.push, "offset", STEP)


SEARCHES = {"": SEARCH, ", default search": DEFAULT_SEARCH, ", the paper's search": PAPER_SEARCH}

ROWS = {
    f"analytic, {name}{how}": Row(model, search)
    for name, model in {
        "zero SD": analytic("mean"),
        "linear by differences": differences,
        "linear by derivatives": analytic("linear"),
        "unscented": analytic("unscented"),
        "quadrature": analytic("quadrature"),
    }.items()
    for how, search in SEARCHES.items()
} | {
    "success probability itself": Row(None),
    "network": Row(learned(RULE), learned=True),
    "network, mean": Row(learned("mean"), learned=True),
    "network, not mirrored": Row(learned(RULE, mirrored=False), learned=True, trials=100),
    "network, likelihood": Row(learned(RULE, error="likelihood"), learned=True, trials=50),
    "network, as in the paper": Row(learned("paper", error="paper"), learned=True, trials=200),
    "network, paper": Row(learned("paper"), learned=True, trials=100),
    "network, diagonal": Row(learned("diagonal"), learned=True, trials=200),
    "network, low-rank": Row(learned("low-rank"), learned=True, trials=200),
    "network, quadrature": Row(learned("quadrature"), learned=True, trials=200),
}

# What the choices were made between, beside the rows above.
DEVELOPMENT_ROWS = {
    "network": Row(learned(RULE), learned=True, trials=40),
    "network, mean": Row(learned("mean"), learned=True, trials=40),
    "network, quadrature": Row(learned("quadrature"), learned=True, trials=40),
    "network, low-rank": Row(learned("low-rank"), learned=True, trials=100),
    "network, low-rank, 8 starts": Row(
        learned("low-rank"), sg.Lbfgs(starts=8, iterations=100), learned=True, trials=100
    ),
    "network, low-rank, not mirrored": Row(learned("low-rank", mirrored=False), learned=True, trials=40),
    "network, low-rank, likelihood": Row(learned("low-rank", error="likelihood"), learned=True, trials=40),
}


def draw_situation(group: int, trial: int) -> world.Situation:
    """Return what is seen in a trial."""
    return world.Situation.draw(np.random.default_rng([group, trial]))


def state_of(seen: world.Situation) -> dict[str, sg.Gaussian]:
    """Return the start state of a situation."""
    return push.state(seen.first, seen.first_sd, seen.second, seen.second_sd)


def most_probable(seen: world.Situation, rng: np.random.Generator) -> np.ndarray:
    """Return the actions (4,) that most probably succeed: random ones, then the best 8 with shrinking changes."""
    low = np.array([push.TABLE[0], push.TABLE[0], -np.pi, push.ADVANCE[0]])
    high = np.array([push.TABLE[1], push.TABLE[1], np.pi, push.ADVANCE[1]])

    def probability(points: np.ndarray) -> np.ndarray:
        return world.success_probability(seen, points[..., :2], points[..., 2], points[..., 3])

    points = rng.uniform(low, high, size=(2000, 4))
    best = points[np.argsort(probability(points))[-8:]]
    for width in 0.1 * 0.8 ** np.arange(25):
        tried = best[:, None] + width * (high - low) * rng.standard_normal((8, 20, 4))
        tried = np.concatenate([best[:, None], np.clip(tried, low, high)], axis=1)
        best = np.take_along_axis(tried, probability(tried).argmax(1)[:, None, None], axis=1)[:, 0]
    return best[probability(best).argmax()]


def planner(row: Row, seed: int) -> Callable[[world.Situation, int], tuple[np.ndarray, float]]:
    """Return what makes plans: (situation, seed of the search) → actions (4,), expected reward."""
    if row.model is None:
        return lambda seen, trial: (most_probable(seen, np.random.default_rng(trial)), float("nan"))
    objective = sg.Objective(sg.unroll(push.graph(row.model(seed))))

    def plan(seen: world.Situation, trial: int) -> tuple[np.ndarray, float]:
        made = sg.solve(objective, state_of(seen), row.search, seed=trial, progress=False)
        return np.hstack([made.actions[label] for label in ("gripper", "theta", "advance")]), made.value

    return plan


def read(path: Path) -> list[dict[str, str]]:
    """The plans so far; a line that a stopped run left half-written is dropped from the file."""
    if not path.exists():
        path.parent.mkdir(exist_ok=True)
        path.write_text(",".join(COLUMNS) + "\n")
    lines = path.read_text().splitlines(keepends=True)
    if not lines[-1].endswith("\n"):
        path.write_text("".join(lines[:-1]))
    return list(csv.DictReader(line for line in lines if line.endswith("\n")))


def plan_all(rows: dict[str, Row], group: int, path: Path) -> None:
    """Make the plans that are not in the file yet."""
    done = {(row["row"], row["network"], row["trial"]) for row in read(path)}
    jobs = [
        (name, *plan)
        for name, row in rows.items()
        for plan in row.plans(NETWORKS[group])
        if (name, str(plan[0]), str(plan[1])) not in done
    ]
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns) as progress, path.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        bar = progress.add_task("planning", total=len(jobs))
        current, plan = None, None
        for name, seed, trial in jobs:
            progress.update(bar, description=name)
            seen = draw_situation(group, trial)
            if current != (name, seed):
                current, plan = (name, seed), planner(rows[name], seed)
                plan(seen, trial)  # compiles
            begin = time.process_time()  # of one core, whatever else the machine does
            actions, value = plan(seen, trial)
            seconds = time.process_time() - begin
            writer.writerow([name, seed, trial, *(f"{a:.6g}" for a in actions), f"{value:.5g}", f"{seconds:.4f}"])
            file.flush()
            progress.advance(bar)


def actions_of(row: dict[str, str]) -> tuple[np.ndarray, float, float]:
    """Return gripper (2,) [m], theta [rad] and advance [m] of a plan in the file."""
    x, y, theta, advance = (float(row[name]) for name in COLUMNS[3:7])
    return np.array([x, y]), theta, advance


def success(seen: world.Situation, row: dict[str, str]) -> float:
    """Return the probability that a plan succeeds."""
    return float(world.success_probability(seen, *actions_of(row)))


def true_value(seen: world.Situation, row: dict[str, str]) -> float:
    """Return the expected reward of a plan, over draws of the object."""
    gripper, theta, advance = actions_of(row)
    objects = seen.objects(np.random.default_rng(0), DRAWS)
    offset = world.pushed(world.in_gripper(objects, gripper, theta), advance)
    return float(-push.OFFSET_WEIGHT * (offset**2).sum(1).mean() - push.ADVANCE_WEIGHT * advance**2)


def lines(rows: list[dict[str, str]], group: int) -> Iterator[list[str | int]]:
    """Yield the lines of the table."""
    yield ["model", "plans", "success [%]", "± [%]", "by network [%]", "value planned", "true", "CPU time [ms]"]
    for name in dict.fromkeys(row["row"] for row in rows):
        mine = [row for row in rows if row["row"] == name]
        seen = [draw_situation(group, int(row["trial"])) for row in mine]
        rate = 100 * np.array([success(*pair) for pair in zip(seen, mine, strict=True)])
        value = np.array([float(row["value"]) for row in mine])
        true = np.array([true_value(*pair) for pair in zip(seen, mine, strict=True)])
        seeds = np.array([int(row["network"]) for row in mine])
        each = [rate[seeds == seed].mean() for seed in np.unique(seeds)]
        yield [
            name,
            len(mine),
            f"{rate.mean():.1f}",
            f"{rate.std(ddof=1) / np.sqrt(len(rate)):.1f}",
            f"{min(each):.1f} to {max(each):.1f}" if len(each) > 1 else "",
            "" if np.isnan(value).any() else f"{value.mean():.2f}",
            f"{true.mean():.2f}",
            f"{1e3 * np.median([float(row['cpu_seconds']) for row in mine]):.0f}",
        ]


def tabulate(rows: list[dict[str, str]], group: int, path: Path) -> None:
    """Write the table: a line per row, in per cent, with its standard error over the plans."""
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(lines(rows, group))


def draw_gripper(axes: plt.Axes, position: np.ndarray, theta: float, **style: Any) -> None:
    """Draw the two arms."""
    arms = push.ARM * np.array([[1, 1], [0, 0], [1, -1]])
    turn = np.array([[np.cos(theta), np.sin(theta)], [-np.sin(theta), np.cos(theta)]])
    axes.add_patch(Polygon(position + arms @ turn, closed=False, fill=False, **style))


def draw_plan(axes: plt.Axes, seen: world.Situation, row: dict[str, str]) -> None:
    """Draw a plan like the paper's figure 6: Gaussians to 1 and 2 sd, the gripper's way from dashed to solid."""
    gripper, theta, advance = actions_of(row)
    for mean, sd, color in ((seen.first, seen.first_sd, "tab:blue"), (seen.second, seen.second_sd, "tab:orange")):
        for k in (1, 2):
            axes.add_patch(Circle(mean, k * sd, color=color, alpha=0.25, linewidth=0))
        axes.plot(*mean, ".", color=color)
    end = gripper + advance * np.array([np.cos(theta), np.sin(theta)])
    draw_gripper(axes, gripper, theta, color="black", linestyle="--", linewidth=1)
    draw_gripper(axes, end, theta, color="black", linewidth=2)
    axes.annotate("", end, gripper, arrowprops={"arrowstyle": "->", "color": "tab:red", "linewidth": 1.5})
    axes.set(xlim=(-0.1, 1.1), ylim=(-0.1, 1.1), aspect="equal", xticks=[0, 0.5, 1], yticks=[0, 0.5, 1])


def draw(rows: list[dict[str, str]]) -> None:
    """Write figure.svg: three ways to plan in one situation, and the networks in three others."""
    mpl.rcParams.update({"svg.hashsalt": "push", "svg.fonttype": "none"})
    _, *ways = SHOWN_ROWS
    shown = [(name, SHOWN_TRIALS[0]) for name in SHOWN_ROWS] + [(ways[-1], trial) for trial in SHOWN_TRIALS[1:]]
    figure, panels = plt.subplots(2, 3, figsize=(11, 7.6), sharex=True, sharey=True, layout="constrained")
    for axes, letter, (name, trial) in zip(panels.flat, "abcdef", shown, strict=True):
        (row,) = (row for row in rows if (row["row"], row["trial"]) == (name, str(trial)))
        seen = draw_situation(TEST, trial)
        draw_plan(axes, seen, row)
        axes.set(title=f"({letter}) {SHOWN_ROWS[name]}: {100 * success(seen, row):.0f}%")
    for axes in panels[:, 0]:
        axes.set(ylabel="y [m]")
    for axes in panels[1]:
        axes.set(xlabel="x [m]")
    figure.savefig(FOLDER / "figure.svg", metadata={"Date": None})


def main() -> None:
    """Plan what is missing, then write the table and, of the test, the figure."""
    if sys.argv[1:] == ["development"]:
        path = FOLDER / "development.csv"
        short = {name: replace(row, trials=200) for name, row in ROWS.items() if not row.learned}
        plan_all(short | DEVELOPMENT_ROWS, DEVELOPMENT, path)
        tabulate(read(path), DEVELOPMENT, FOLDER / "development_table.csv")
        return
    path = FOLDER / "results.csv"
    plan_all(ROWS, TEST, path)
    tabulate(read(path), TEST, FOLDER / "table.csv")
    draw(read(path))


if __name__ == "__main__":
    main()
