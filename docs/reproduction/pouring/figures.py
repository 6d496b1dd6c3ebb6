"""Draw the paper's figures 9 to 12, and make the tables of the page.

From the repository's root: `python docs/reproduction/pouring/figures.py`. The figures and the first table come
from results.csv beside this program alone, the other tables from evaluation.csv and baselines.csv.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated

import matplotlib as mpl

mpl.use("Agg")
mpl.rcParams["svg.hashsalt"] = "pouring"  # the same drawing gives the same file

import matplotlib.pyplot as plt
import numpy as np
import typer
from setups import CONDITIONS, FOLDER, LAST, features_of, read, write

from sims.pouring import MATERIALS, SETUPS
from sims.pouring.behaviour import SPHERE_AMOUNT, SPILL_AMOUNT

Row = dict[str, str]
WINDOW = 5  # episodes of the moving average, as in the paper
GOOD_RETURN, GOOD_SHARE, GOOD_WINDOW = -1.0, 0.8, 10  # from the first such window on, a run has converged
BOTH = "PT0-Rnone, both skills tried"
MARKERS = {"tip": "o", "shake": "^"}


def column(rows: Iterable[Row], name: str) -> np.ndarray:
    """Return a column as numbers, NaN where it is empty."""
    return np.array([float(row[name] or "nan") for row in rows])


def grouped(rows: Iterable[Row], *names: str) -> dict[tuple[str, ...], list[Row]]:
    """Return the rows by the values of some columns, in order of appearance."""
    groups = defaultdict(list)
    for row in rows:
        groups[tuple(row[name] for name in names)].append(row)
    return groups


def smoothed(values: np.ndarray) -> np.ndarray:
    """Return the mean of the last 5 values at each place, of fewer at the beginning."""
    parts = [values[max(0, k + 1 - WINDOW) : k + 1] for k in range(len(values))]
    return np.array([np.nanmean(part) if np.isfinite(part).any() else np.nan for part in parts])


def draw_curves(axes: plt.Axes, rows: list[Row], setup: str, names: Sequence[str], value: str) -> None:
    """Draw the mean over the runs of conditions, and each run as a thin line."""
    for k, name in enumerate(names):
        runs = grouped([row for row in rows if (row["setup"], row["condition"]) == (setup, name)], "run")
        curves = [smoothed(column(run, value)) for run in runs.values()]
        if not curves:
            continue
        for curve in curves:
            axes.plot(np.arange(1, len(curve) + 1), curve, color=f"C{k}", linewidth=0.6, alpha=0.6)
        shortest = min(len(curve) for curve in curves)  # of runs that are under way
        mean = np.mean([curve[:shortest] for curve in curves], axis=0)
        axes.plot(np.arange(1, shortest + 1), mean, color=f"C{k}", linewidth=2, label=name)
    axes.set_xlabel("episode")
    if axes.get_lines():
        axes.legend(fontsize="small")


def figure_9(rows: list[Row]) -> plt.Figure:
    """The poured amount in SETUP1."""
    figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
    draw_curves(axes, rows, "setup1", ["PT0-Rnone", "PT0-Rtip"], "poured")
    axes.axhline(SETUPS["setup1"]["target"], color="grey", linestyle=":")
    axes.set_ylabel("poured amount")
    return figure


def draw_returns(axes: plt.Axes, rows: list[Row], setup: str, names: Sequence[str]) -> None:
    """Draw returns. Linear near 0 and logarithmic below -1: a single accident costs hundreds."""
    draw_curves(axes, rows, setup, names, "return")
    axes.set_yscale("symlog", linthresh=1.0)
    axes.set(ylabel="return", ylim=(None, 0.1))
    axes.grid(alpha=0.3)


def figure_10(rows: list[Row]) -> plt.Figure:
    """The return in SETUP2."""
    figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
    draw_returns(axes, rows, "setup2", ["PT0-Rnone", "PT1-Rnone", "PT1-Rshake"])
    return figure


def figure_11(rows: list[Row]) -> plt.Figure:
    """The return in the general setup."""
    figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
    draw_returns(axes, rows, "general", ["PT0-Rnone", "PT1-Rnone", "PT2-Rnone"])
    return figure


def figure_12(rows: list[Row]) -> plt.Figure:
    """Skill and error of the poured amount in the last episodes of the general setup."""
    figure, panels = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained", sharey=True)
    heights = {material: k for k, material in enumerate(MATERIALS)}
    trained = {"setup1": "SETUP1", "setup2": "SETUP2"}
    for panel, axes in enumerate(panels):
        name = f"PT{panel}-Rnone"
        runs = grouped([row for row in rows if (row["setup"], row["condition"]) == ("general", name)], "run")
        last = [row for run in runs.values() for row in run[-LAST:] if row["status"] == "done"]
        for skill, marker in MARKERS.items():
            used = [row for row in last if row["skill"] == skill]
            # A shift by the run keeps points from hiding each other.
            y = [heights[row["material"]] + 0.1 * (int(row["run"]) % 5 - 0.5) for row in used]
            size = 10 + 1000 * np.abs(column(used, "poured") - column(used, "target"))
            axes.scatter(column(used, "mouth"), y, size, marker=marker, alpha=0.5, edgecolors="none", label=skill)
        for setup in list(trained)[:panel]:
            where = SETUPS[setup]["mouth"], heights[SETUPS[setup]["material"]]
            axes.plot(*where, "+", color="black", markersize=14)
            axes.annotate(trained[setup], where, (4, 8), textcoords="offset points", fontsize="x-small")
        axes.set(title=name, xlabel="mouth", ylim=(-0.6, len(heights) - 0.4))
    panels[0].set_yticks(range(len(heights)), list(heights))
    shapes = [
        plt.Line2D([], [], color=f"C{k}", marker=MARKERS[s], linestyle="", label=s) for k, s in enumerate(MARKERS)
    ]
    figure.legend(handles=shapes, loc="outside right upper")
    return figure


def more_variety(rows: list[Row]) -> plt.Figure:
    """What the paper does not have: both skills tried in the general setup, and the varied one."""
    figure, panels = plt.subplots(1, 2, figsize=(11, 3.5), layout="constrained", sharey=True)
    draw_returns(panels[0], rows, "general", ["PT0-Rnone", BOTH, f"{BOTH}, one attempt"])
    draw_returns(panels[1], rows, "varied", [BOTH])
    panels[0].set_title("general")
    panels[1].set_title("varied")
    return figure


def converged(run: list[Row]) -> int | None:
    """Return how many episodes came before the first ten of which eight have a return above -1, if there are any."""
    good = column(run, "return") > GOOD_RETURN
    shares = [good[k : k + GOOD_WINDOW].mean() for k in range(len(good) - GOOD_WINDOW + 1)]
    return next((k for k, share in enumerate(shares) if share >= GOOD_SHARE), None)


def converged_plans(run: list[Row]) -> int | None:
    """Return the same if only episodes count in which nothing was drawn: that is what the run knows by then."""
    planned = [(k, row) for k, row in enumerate(run) if not row["explored"]]
    place = converged([row for _, row in planned])
    return None if place is None else planned[place][0]


def fitting_skills(row: Row) -> set[str]:
    """Return the skills that fit a situation, as found by trying many actions in the four materials."""
    if row["material"] in ("wat", "bnc"):
        return {"tip"}
    narrow = {"vsc": 0.18, "vsc+": 0.22}.get(row["material"], 0.0)
    return {"shake"} if float(row["mouth"]) < narrow else {"tip", "shake"}


def runs_freely(row: Row) -> bool:
    """Whether a material is wat, bnc or between them: others leave a wide mouth all at once, whatever one does."""
    return features_of(row["material"])[2] == 0.0


def spread(values: np.ndarray, form: str = ".0f") -> str:
    """Return median and 90th percentile as text."""
    values = values[np.isfinite(values)]
    return f"{np.median(values):{form}} / {np.quantile(values, 0.9):{form}}" if len(values) else ""


def average(rows: list[Row], name: str) -> str:
    """Return mean ± standard error over situations as text; what several runs did in one of them is averaged first."""
    values = [np.nanmean(column(same, name)) for same in grouped(rows, "seed").values()]
    return f"{np.mean(values):.2f} ± {np.std(values, ddof=1) / np.sqrt(len(values)):.2f}" if len(values) > 1 else ""


def summary(rows: list[Row]) -> dict[str, str | int]:
    """Return the columns of a table that describe episodes. Those that broke off have reached nothing."""
    done = [row for row in rows if row["status"] == "done"]
    poured, target = column(rows, "poured"), column(rows, "target")
    over = np.array([max(0.0, float(row["poured"]) - float(row["target"])) for row in done if runs_freely(row)])
    named = [row for row in done if row["material"] in MATERIALS]
    return {
        "episodes": len(rows),
        "failed": len(rows) - len(done),
        "return": average(done, "return"),
        "by run": ", ".join(f"{column(run, 'return').mean():.2f}" for run in grouped(done, "run").values()),
        "median": f"{np.median(column(done, 'return')):.3f}" if done else "",
        "above -1 [%]": share(column(rows, "return") > GOOD_RETURN),
        "first attempt": average(done, "first_return"),
        "first above -1 [%]": share(column(rows, "first_return") > GOOD_RETURN),
        "reached [%]": share(poured >= target - 1e-6),
        "spilled": spread(column(done, "spilled") / SPILL_AMOUNT),
        "too much": spread(over / SPHERE_AMOUNT),
        "skill fits [%]": share(np.array([row["skill"] in fitting_skills(row) for row in named])),
    }


def share(held: np.ndarray) -> str:
    """Return a share in percent as text."""
    return f"{100 * held.mean():.0f}" if len(held) else ""


def last_of_runs(rows: list[Row], setup: str, condition: str) -> list[Row]:
    """Return the last episodes of each run of a condition."""
    mine = [row for row in rows if (row["setup"], row["condition"]) == (setup, condition)]
    return [row for run in grouped(mine, "run").values() for row in run[-LAST:]]


def conditions_table(rows: list[Row]) -> list[dict[str, str | int]]:
    """Return a line per condition: when its runs converged, and what their last episodes are like."""
    lines = []
    for condition in CONDITIONS:
        mine = [row for row in rows if (row["setup"], row["condition"]) == (condition.setup, condition.name)]
        runs = list(grouped(mine, "run").values())
        if not runs:
            continue
        when = [converged(run) for run in runs]
        about = {
            "setup": condition.setup,
            "condition": condition.name,
            "runs": len(runs),
            "converged after": ", ".join("never" if k is None else str(k) for k in when),
            "counting plans only": ", ".join(
                "never" if k is None else str(k) for k in (converged_plans(run) for run in runs)
            ),
        }
        lines.append(about | summary(last_of_runs(rows, condition.setup, condition.name)))
    return lines


def comparison_table(learned: list[Row], baselines: list[Row]) -> list[dict[str, str | int]]:
    """Return a line per way to pour in the same situations, learned ones first."""
    lines = []
    for rows, name in ((learned, "condition"), (baselines, "policy")):
        for (setup, way), mine in grouped(rows, "setup", name).items():
            lines.append({"setup": setup, "way to pour": way} | summary(mine))
    return sorted(lines, key=lambda line: list(SETUPS).index(line["setup"]))


def differences_table(learned: list[Row], baselines: list[Row]) -> list[dict[str, str | int]]:
    """Return a line per policy: how much better the learned plans do, from differences in the same situation."""
    lines = []
    for (setup, condition), mine in grouped(learned, "setup", "condition").items():
        for (policy,), others in grouped([row for row in baselines if row["setup"] == setup], "policy").items():
            line: dict[str, str | int] = {"setup": setup, "condition": condition, "against": policy}
            for name, label in (("return", "return"), ("first_return", "first attempt")):
                pairs = paired(mine, others, name)
                if len(pairs) > 1:
                    error = np.std(pairs, ddof=1) / np.sqrt(len(pairs))
                    line |= {"situations": len(pairs), label: f"{np.mean(pairs):.2f} ± {error:.2f}"}
            lines.append(line)
    return lines


def paired(learned: list[Row], others: list[Row], name: str) -> np.ndarray:
    """Return the difference of a column in each situation that both went through, means over the runs there."""
    means = [
        {seed: column(same, name).mean() for seed, same in grouped(done, "seed").items()}
        for done in ([row for row in rows if row["status"] == "done"] for rows in (learned, others))
    ]
    return np.array([means[0][where] - means[1][where] for where in means[0] if where in means[1]])


FIGURES: dict[str, Callable[[list[Row]], plt.Figure]] = {
    "fig9": figure_9,
    "fig10": figure_10,
    "fig11": figure_11,
    "fig12": figure_12,
    "more_variety": more_variety,
}


def main(folder: Annotated[Path, typer.Option(help="Of the files.")] = FOLDER) -> None:
    """Draw all that there are results for."""
    results, evaluated, baselines = (
        sorted(read(folder / f"{name}.csv"), key=lambda row: int(row.get("episode", 0)))
        for name in ("results", "evaluation", "baselines")
    )
    for name, draw in FIGURES.items():
        figure = draw([row for row in results if row["status"] == "done"])
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
        plt.close(figure)
    fresh, met = ([row for row in baselines if (row["run"] == "fresh") == new] for new in (True, False))
    runs = {row["run"] for row in met}
    tried = [row for row in last_of_runs(results, "general", BOTH) if row["run"] in runs]
    tables = {
        "conditions": conditions_table(results),
        "comparison": comparison_table(evaluated, fresh),
        "differences": differences_table(evaluated, fresh),
        "policies": comparison_table(tried, met),
    }
    for name, lines in tables.items():
        if lines:
            write(folder / f"table_{name}.csv", list(lines[0]), lines)


if __name__ == "__main__":
    typer.run(main)
