"""Pictures of plans: start points as they climb, the value around a plan, and what is planned where."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from symgraph.errors import InputError, MissingExtraError, did_you_mean, names
from symgraph.objective import Objective, stacked_index
from symgraph.plan import Plan, PlanRun
from symgraph.plan_table import PlanTable
from symgraph.slots import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SMALLEST_GAP = 1e-16  # what the logarithmic axis shows for the best value itself
MAP_MARKERS = "o^sDvP*<>h"
SHOWN_COMBINATIONS = 8  # curves that one picture still tells apart


def plot_runs(plan: Plan) -> Figure:
    """Draw how far each start point was below the best value, gradient by gradient.

    Args:
        plan: with the runs that led to it; a colour for each combination of selections.

    Returns:
        a matplotlib figure; `figure.savefig("runs.png")` writes it to a file.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    figure, axes = _figure("plot_runs")
    colours = {_combination(plan.selections): "C0"}
    labelled: set[str] = set()
    for run in sorted(plan.runs, key=lambda run: -run.value):
        name = _combination(run.selections)
        label = None if name in labelled else name or None
        labelled.add(name)
        colours.setdefault(name, f"C{len(colours) % 10}")
        gap = np.maximum(plan.value - np.asarray(run.history), SMALLEST_GAP)
        gap = np.where(np.isfinite(gap), gap, np.nan)
        axes.semilogy(np.arange(1, gap.size + 1), gap, color=colours[name], lw=1, alpha=0.7, label=label)
        axes.plot(gap.size, gap[-1], _MARKERS.get(run.outcome, "x"), color=colours[name], ms=4)
    axes.set_xlabel("gradients")
    axes.set_ylabel("best value − value")
    axes.set_title(f"{len(plan.runs)} runs of {plan.optimizer}, best value {plan.value:.6g}")
    if any(colours):
        axes.legend(frameon=False)
    return figure


_MARKERS = {"converged": "o", "stalled": "s", "iteration limit": ">", "oscillation": "v"}


def plot_value(
    objective: Objective, state: Mapping[str, Any], plan: Plan, actions: str | Sequence[str], points: int | None = None
) -> Figure:
    """Draw the value over one or two actions, with the starts, the ends of the runs and the plan.

    All other actions keep the plan's values. Over one action each combination of selections is a curve; over two, the
    plan's combination is a map.

    Args:
        objective: what was maximised.
        state: the start state, as in `solve`.
        plan: what `solve` returned.
        actions: one or two labels; "label[i]" is element i of a vector action.
        points: grid points per axis; default 400 on a curve, 80 on a map.

    Raises:
        InputError: labels that are no actions, or not one or two.
        MissingExtraError: matplotlib is not installed.
    """
    labels = [actions] if isinstance(actions, str) else list(actions)
    if len(labels) not in (1, 2):
        raise InputError(f"plot_value draws over one or two actions, got {len(labels)}: {names(labels)}")
    where = [_element(objective, label) for label in labels]
    figure, axes = _figure("plot_value")
    grids = [
        np.linspace(objective.bounds[0][i], objective.bounds[1][i], points or (400, 80)[len(where) - 1]) for i in where
    ]
    if len(where) == 1:
        _draw_curves(axes, objective, state, plan, where[0], grids[0])
        axes.set_ylabel("value")
    else:
        _draw_map(axes, objective, state, plan, where, grids)
        axes.set_ylabel(_with_unit(objective, labels[1]))
    axes.set_xlabel(_with_unit(objective, labels[0]))
    return figure


def _draw_curves(axes: Axes, objective: Objective, state: Mapping[str, Any], plan: Plan, i: int, grid: Array) -> None:
    lowest, highest = plan.value, plan.value
    for c, selections in enumerate(_combinations(objective, plan)):
        columns = np.tile(objective.stack_actions(plan.actions)[:, None], (1, grid.size))
        columns[i] = grid
        values = _finite(objective.evaluate(state, columns, selections)[0])
        axes.plot(grid, values, color=f"C{c}", lw=1.2, label=_combination(selections) or None)
        runs = [run for run in plan.runs if run.selections == selections and np.isfinite(run.value)]
        for which, style in (("start", "|"), ("actions", "o")):
            x = [objective.stack_actions(getattr(run, which))[i] for run in runs]
            y = [run.history[0] if which == "start" else run.value for run in runs]
            axes.plot(x, y, style, color=f"C{c}", ms=4, alpha=0.7)
        if np.isfinite(values).any():
            # Values may fall off a cliff: show the upper half in full and let the rest leave the picture.
            lowest = min(lowest, float(np.nanmedian(values)))
            highest = max(highest, float(np.nanmax(values)))
    best = objective.stack_actions(plan.actions)[i]
    axes.plot(best, plan.value, "*", color="black", ms=10, label=f"plan: {plan.value:.4g}")
    room = 0.06 * (highest - lowest or 1.0)
    axes.set_ylim(lowest - room, highest + 2 * room)
    axes.legend(frameon=False)


def _draw_map(
    axes: Axes, objective: Objective, state: Mapping[str, Any], plan: Plan, where: list[int], grids: list[Array]
) -> None:
    first, second = np.meshgrid(*grids)
    columns = np.tile(objective.stack_actions(plan.actions)[:, None], (1, first.size))
    columns[where[0]], columns[where[1]] = first.ravel(), second.ravel()
    values = _finite(objective.evaluate(state, columns, plan.selections)[0]).reshape(first.shape)
    # Levels by rank, so that a cliff does not swallow all colours.
    levels = np.unique(np.nanquantile(values, np.linspace(0.0, 1.0, 25)))
    if levels.size > 1:
        drawn = axes.contourf(first, second, values, levels=levels, cmap="viridis")
        axes.figure.colorbar(drawn, ax=axes, label="value")
    runs: list[PlanRun] = [run for run in plan.runs if run.selections == plan.selections]
    for which, style in (("start", "+"), ("actions", "o")):
        ends = np.array([objective.stack_actions(getattr(run, which))[where] for run in runs]).reshape(-1, 2)
        label = "starts" if which == "start" else "ends"
        axes.plot(
            ends[:, 0], ends[:, 1], style, color="white", mec="black" if style == "o" else "white", ms=5, label=label
        )
    best = objective.stack_actions(plan.actions)[where]
    axes.plot(*best, "*", color="red", mec="white", ms=13, label=f"plan: {plan.value:.4g}")
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, 1.12), ncols=3, frameon=False)


def plot_map(table: PlanTable, x: str | Sequence[float], y: str | Sequence[float]) -> Figure:
    """Draw what is planned where: a marker for each combination of selections, in the colour of the value.

    Crosses are situations without a plan that means something: none was found, or a model lacks samples. Markers are
    hollow where requirements are missed.

    Args:
        table: what `solve_many` returned.
        x: a column of numbers, e.g. "target[0]", or a number for each row.
        y: likewise.

    Returns:
        a matplotlib figure; `figure.axes[0]` holds the map.

    Raises:
        InputError: a column that is not there, or as many numbers as there are no rows.
        MissingExtraError: matplotlib is not installed.
    """
    if not isinstance(table, PlanTable):
        raise InputError(f"plot_map takes a PlanTable, got {type(table).__name__}; give what solve_many returned")
    places = [_place(table, given, name) for given, name in ((x, "x"), (y, "y"))]
    figure, axes = _figure("plot_map")
    from matplotlib.collections import PathCollection

    values = table.column("value")
    planned = np.array([np.isfinite(row.value) and not row.status.startswith("exploring") for row in table], dtype=bool)
    missed = planned & np.array([row.status.startswith("requirements are missed") for row in table], dtype=bool)
    combinations = [_combination(row.selections) for row in table]
    shown = values[planned & ~missed]
    # Ranks rather than values decide the range, so that a single accident does not swallow all colours.
    low, high = np.quantile(shown, (0.05, 1.0)) if shown.size else (0.0, 1.0)
    drawn = None
    for k, combination in enumerate(dict.fromkeys(c for c, ok in zip(combinations, planned, strict=True) if ok)):
        mine = planned & np.array([one == combination for one in combinations])
        marker = MAP_MARKERS[k % len(MAP_MARKERS)]
        first, second = (place[mine & missed] for place in places)
        if first.size:
            name = f"{combination or 'plan'}, requirements missed"
            axes.scatter(first, second, facecolors="none", edgecolors="grey", marker=marker, label=name)
        rows = mine & ~missed
        if not rows.any():
            continue
        label = combination or None
        first, second = (place[rows] for place in places)
        drawn = axes.scatter(first, second, c=values[rows], marker=marker, vmin=low, vmax=high, label=label)
    if not planned.all():
        first, second = (place[~planned] for place in places)
        axes.scatter(first, second, color="grey", marker="x", label="no plan")
    if drawn is not None:
        figure.colorbar(drawn, ax=axes, label="value", extend="min" if (shown < low).any() else "neither")
    axes.set_xlabel(table.with_unit(x) if isinstance(x, str) else "")
    axes.set_ylabel(table.with_unit(y) if isinstance(y, str) else "")
    if any(combinations):
        legend = figure.legend(loc="outside upper center", ncols=2, frameon=False)
        for handle in legend.legend_handles:  # colours mean values, also those that stand in the legend by chance
            if isinstance(handle, PathCollection) and handle.get_array() is not None:
                handle.set_array(None)
                handle.set_color("grey")
    return figure


def _place(table: PlanTable, given: str | Sequence[float], name: str) -> Array:
    column = table.column(given) if isinstance(given, str) else np.asarray(given)
    if column.shape != (len(table),) or column.dtype.kind not in "buif":
        raise InputError(f"plot_map: {name} = {given!r} gives no number for each of {len(table)} rows")
    return column.astype(float)


def _figure(what: str) -> tuple[Figure, Axes]:
    try:
        import matplotlib.pyplot as plt
    except ImportError:
        raise MissingExtraError("matplotlib", "plots", what) from None
    figure, axes = plt.subplots(figsize=(6.4, 4.2), layout="constrained")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return figure, axes


def _element(objective: Objective, name: str) -> int:
    """Return where "label" or "label[i]" stands in the stacked actions."""
    label, _, rest = name.partition("[")
    slots = objective.graph.actions()
    if label not in slots:
        raise InputError(f"{label!r} is no action{did_you_mean(label, slots)} Actions: {names(slots)}")
    size = slots[label].size
    element = rest.rstrip("]") if rest else "0"
    if not element.isdigit() or int(element) >= size or (not rest and size > 1):
        last = size - 1
        raise InputError(f"{name!r}: action {label!r} has {size} elements; name one, '{label}[0]' to '{label}[{last}]'")
    return int(stacked_index(slots)[label].start) + int(element)


def _with_unit(objective: Objective, name: str) -> str:
    unit = objective.graph.actions()[name.partition("[")[0]].unit
    return f"{name} [{unit}]" if unit else name


def _combinations(objective: Objective, plan: Plan) -> list[dict[str, str]]:
    """Return the combinations of selections to draw, the plan's first."""
    slots = objective.graph.selections()
    every = [dict(zip(slots, choices, strict=True)) for choices in product(*(s.choices for s in slots.values()))]
    every.sort(key=lambda selections: selections != plan.selections)
    return every[:SHOWN_COMBINATIONS]


def _combination(selections: Mapping[str, str]) -> str:
    return ", ".join(f"{label} = {choice}" for label, choice in selections.items())


def _finite(values: Array) -> Array:
    return np.where(np.isfinite(values), values, np.nan)
