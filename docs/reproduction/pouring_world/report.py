"""Turn the measured attempts into the tables and pictures of the page.

Run from the repository's root after `measure.py`:
`PYTHONPATH=. python docs/reproduction/pouring_world/report.py`.
"""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
mpl.rcParams["svg.hashsalt"] = "pouring world"  # the same drawing gives the same file

import matplotlib.pyplot as plt
import numpy as np
from measure import ACTION_SET, TARGET, keeps

FOLDER = Path(__file__).parent
COLOURS = {"tip": "tab:blue", "shake": "tab:orange"}
Row = dict[str, str]


def read(name: str) -> list[Row]:
    """Return the rows of a measured file."""
    with (FOLDER / f"{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def write(name: str, header: list[str], rows: Iterable[Iterable[object]]) -> None:
    """Write a summary beside the measured files."""
    with (FOLDER / f"{name}.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)


def group(rows: Iterable[Row], key: Callable[[Row], tuple]) -> dict[tuple, list[Row]]:
    """Return the rows by key, in order of appearance."""
    groups: dict[tuple, list[Row]] = defaultdict(list)
    for row in rows:
        groups[key(row)].append(row)
    return groups


def column(rows: Iterable[Row], name: str) -> np.ndarray:
    """Return a column as numbers."""
    return np.array([float(row[name]) for row in rows])


def span(values: np.ndarray) -> str:
    """Return mean and range as text."""
    return f"{values.mean():.0f} ({values.min():.0f}-{values.max():.0f})"


def table() -> None:
    """Received and spilled spheres by material, mouth and skill."""
    groups = group(read("table"), lambda row: (row["material"], float(row["mouth"]), row["skill"]))
    materials = ("wat", "bnc", "vsc", "vsc+")
    mouths = sorted({key[1] for key in groups})
    rows = []
    for material in materials:
        for mouth in mouths:
            line: list[object] = [material, mouth]
            for skill in COLOURS:
                found = groups[material, mouth, skill]
                line += [span(column(found, "received")), span(column(found, "spilled"))]
            rows.append(line)
    header = ["material", "mouth", "tip: received", "tip: spilled", "shake: received", "shake: spilled"]
    write("table_summary", header, rows)

    figure, axes = plt.subplots(2, len(materials), figsize=(12, 5), sharex=True, sharey="row")
    for axis, material in zip(axes.T, materials, strict=True):
        for skill, colour in COLOURS.items():
            for part, name in zip(axis, ("received", "spilled"), strict=True):
                values = [column(groups[material, mouth, skill], name) for mouth in mouths]
                mean = [value.mean() for value in values]
                part.plot(mouths, mean, color=colour, label=skill)
                part.fill_between(mouths, [v.min() for v in values], [v.max() for v in values], color=colour, alpha=0.2)
        axis[0].axhline(TARGET, color="grey", linewidth=0.8)
        axis[0].set_title(material)
        axis[1].set_xlabel("mouth")
    axes[0, 0].set_ylabel("received spheres")
    axes[1, 0].set_ylabel("spilled spheres")
    axes[0, 0].legend()
    save(figure, "table")


def jamming() -> None:
    """Flow under tipping as attraction, friction or the mouth is changed."""
    groups = group(read("jamming"), lambda row: tuple(row["label"].split()))
    figure, axes = plt.subplots(1, 3, figsize=(10, 3.2), sharey=True)
    rows = []
    titles = {"attraction": "attraction / vsc's", "friction": "friction / vsc's", "mouth": "mouth"}
    for axis, (what, title) in zip(axes, titles.items(), strict=True):
        shares = sorted(float(key[1]) for key in groups if key[0] == what)
        values = [column(groups[what, str(share)], "released") for share in shares]
        axis.plot(shares, [v.mean() for v in values], "o-")
        for share, value in zip(shares, values, strict=True):
            axis.plot([share] * len(value), value, "k.", markersize=3)
            rows.append([what, share, len(value), round(value.mean(), 1), int(value.min()), int(value.max())])
        axis.set_xlabel(title)
    axes[0].set_ylabel("released spheres")
    write("jamming_summary", ["changed", "value", "seeds", "released", "least", "most"], rows)
    save(figure, "jamming")


ACTION_COLUMNS = {
    "tip": ("tilt_rate", "search_rate", "px", "pz"),
    "shake": ("shake_speed", "shake_length", "shake_angle", "px"),
}


def dependence() -> None:
    """Received and spilled spheres as one action is varied."""
    rows = read("dependence")
    figure, axes = plt.subplots(2, 4, figsize=(12, 5.5), sharey=True)
    lines = []
    for line, (skill, names) in zip(axes, ACTION_COLUMNS.items(), strict=True):
        mine = [row for row in rows if row["skill"] == skill]
        groups = group(mine, action_set)
        centre = next(iter(groups))
        for axis, name in zip(line, names, strict=True):
            place = ACTION_SET.index(name)
            chosen = {
                float(key[place]): found
                for key, found in groups.items()
                if key[:place] + key[place + 1 :] == centre[:place] + centre[place + 1 :]
            }
            at = sorted(chosen)
            for what, colour in (("received", "tab:green"), ("spilled", "tab:red")):
                values = [column(chosen[value], what) for value in at]
                spread = [v.std(ddof=1) if len(v) > 1 else 0.0 for v in values]
                axis.errorbar(at, [v.mean() for v in values], spread, color=colour, capsize=2, label=what)
            axis.axhline(TARGET, color="grey", linewidth=0.8)
            axis.set_xlabel(f"{skill}: {name}")
            axis.locator_params(axis="x", nbins=4)
            for value in at:
                found = chosen[value]
                received, spilled = column(found, "received"), column(found, "spilled")
                lines.append(
                    [
                        skill,
                        name,
                        value,
                        len(found),
                        round(received.mean(), 1),
                        round(received.std(ddof=1), 1) if len(found) > 1 else "",
                        round(spilled.mean(), 1),
                        round(spilled.std(ddof=1), 1) if len(found) > 1 else "",
                    ]
                )
        line[0].set_ylabel("spheres")
    axes[0, 0].legend()
    header = ["skill", "action", "value", "seeds", "received", "sd", "spilled", "sd"]
    write("dependence_summary", header, lines)
    save(figure, "dependence")


def best() -> None:
    """What the best action sets keep to in 8 of 10 attempts, where they were chosen and on fresh seeds.

    The last columns tell, on average, how many spheres were out but not yet received when the skill stopped at
    the target, and how many left the source afterwards.
    """
    before = group(read("finals") + read("dependence") + read("refined"), action_set)
    lines = []
    for key, rows in group(read("fresh"), action_set).items():
        chosen, fresh = keeps(before[key]), keeps(rows)
        stopped = [row for row in rows if row["stop"] == "target"]
        seen, out = column(stopped, "received_at_stop"), column(stopped, "released_at_stop")
        kept = (fresh.short, fresh.over, fresh.spilled)
        means = (round((out - seen).mean(), 1), round((column(stopped, "released") - out).mean(), 1))
        lines.append([*key, chosen.short, chosen.over, chosen.spilled, *kept, *means])
    kept_names = ("short", "over", "spilled")
    header = [*ACTION_SET, *(f"chosen: {name}" for name in kept_names), *(f"fresh: {name}" for name in kept_names)]
    write("best_summary", [*header, "in the air", "leave late"], lines)


def action_set(row: Row) -> tuple[str, ...]:
    """Return the skill and actions of a row."""
    return tuple(row[name] for name in ACTION_SET)


def extremes() -> None:
    """Leaks, failures, limits and agreement between processes of the random attempts."""
    first = read("extremes")
    digests = {(row["label"], row["skill"]): row["digest"] for row in first}
    second = read("again")
    same = sum(digests[row["label"], row["skill"]] == row["digest"] for row in second)
    rows = []
    for skill in COLOURS:
        mine = [row for row in first if row["skill"] == skill]
        rows.append(
            [
                skill,
                len(mine),
                int(column(mine, "leaked").sum()),
                int(column(mine, "failed").sum()),
                int((column(mine, "slowed") > 0).sum()),
                int((column(mine, "lift") > 0).sum()),
                f"{same} of {len(second)} (both skills)",
            ]
        )
    header = [
        "skill",
        "attempts",
        "leaked",
        "failed",
        "sphere slowed",
        "source lifted",
        "same in another process",
    ]
    write("extremes_summary", header, rows)


def cost() -> None:
    """CPU time of an attempt by material and skill."""
    rows = []
    for key, found in group(read("table"), lambda row: (row["material"], row["skill"])).items():
        cpu, simulated = column(found, "cpu"), column(found, "simulated_time")
        rows.append(
            [
                *key,
                round(simulated.mean(), 1),
                round(cpu.mean(), 2),
                round(cpu.max(), 2),
                round(cpu.sum() / simulated.sum(), 3),
            ]
        )
    write("cost_summary", ["material", "skill", "simulated time", "cpu", "most", "cpu per time unit"], rows)


def save(figure: plt.Figure, name: str) -> None:
    """Write a picture for the page."""
    figure.tight_layout()
    figure.savefig(FOLDER / f"{name}.svg", metadata={"Date": None})
    figure.savefig(FOLDER / f"{name}.png", dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    for part in (table, jamming, dependence, best, extremes, cost):
        part()
