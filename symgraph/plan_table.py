"""PlanTable: what was planned for many situations, as rows, as columns of numbers, and as a map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, overload

import numpy as np

from symgraph.errors import InputError, did_you_mean, names
from symgraph.graph import Graph
from symgraph.slots import Array, Gaussian

NUMBERS = "value", "deviation", "violation", "seconds"  # of a row


@dataclass(frozen=True, eq=False)
class PlanRow:
    """What was planned for a situation.

    Attributes:
        actions: {label: float or (size,)} [unit]; empty where nothing was planned.
        selections: {label: choice}.
        value: as that of a `Plan`, like all that follows; NaN where nothing was planned.
        deviation: likewise.
        violation: likewise.
        status: "not planned: …" where nothing was.
        notes: what makes the value less than it seems.
        seconds: that it took [s].
    """

    actions: dict[str, Any]
    selections: dict[str, str]
    value: float
    deviation: float
    violation: float
    status: str
    notes: tuple[str, ...]
    seconds: float

    def plain(self) -> dict[str, Any]:
        """Return it as dictionaries, lists, strings and numbers, fit for JSON: None stands for NaN."""
        actions = {label: np.asarray(x).tolist() for label, x in self.actions.items()}
        numbers = {name: x if np.isfinite(x) else None for name, x in self.__dict__.items() if name in NUMBERS}
        return {**self.__dict__, "actions": actions, **numbers}

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> PlanRow:
        """Return the row that `plain` wrote."""
        actions = {label: np.array(x) if isinstance(x, list) else x for label, x in plain["actions"].items()}
        numbers = {name: np.nan if plain[name] is None else plain[name] for name in NUMBERS}
        return cls(**{**plain, "actions": actions, "notes": tuple(plain["notes"]), **numbers})


class PlanTable(Sequence[PlanRow]):
    """What was planned for many situations: a row for each, in their order.

    `pandas.DataFrame(table.columns)` makes it a data frame, `symgraph.plot_map(table, x, y)` a picture.

    Args:
        graph: the task.
        states: {label: number, array or Gaussian} of each situation.
        rows: what was planned for it.
    """

    def __init__(self, graph: Graph, states: Sequence[Mapping[str, Any]], rows: Sequence[PlanRow]) -> None:
        self.states = tuple(states)
        self.rows = tuple(rows)
        self._graph = graph

    def __len__(self) -> int:
        return len(self.rows)

    @overload
    def __getitem__(self, index: int) -> PlanRow: ...
    @overload
    def __getitem__(self, index: slice) -> list[PlanRow]: ...
    def __getitem__(self, index: int | slice) -> PlanRow | list[PlanRow]:
        return list(self.rows[index]) if isinstance(index, slice) else self.rows[index]

    def __iter__(self) -> Iterator[PlanRow]:
        return iter(self.rows)

    @cached_property
    def columns(self) -> dict[str, Array]:
        """{name: (rows,)}: each element of each state, action and selection, and what became of the plan.

        A slot of one element is named by its label, others as "label[0]"; the standard deviation of an uncertain state
        has " sd" behind that. Numbers that a row lacks are NaN, selections "".
        """
        found: dict[str, list[Any]] = {}
        slots = self._graph.slots
        elements = [f"{label}[{i}]" for label, slot in slots.items() if slot.size > 1 for i in range(slot.size)]
        clash = [label for label in slots if label in elements or label.removesuffix(" sd") in (slots.keys() - {label})]
        if clash:
            raise InputError(f"slot {clash[0]!r} is named like a column of another slot; rename it")
        for k, (state, row) in enumerate(zip(self.states, self.rows, strict=True)):
            for label, value in state.items():
                gaussian = value if isinstance(value, Gaussian) else Gaussian(value)
                deviations = np.sqrt(np.diag(np.atleast_2d(gaussian.covariance)))
                _put(found, k, label, slots[label].size, gaussian.mean)
                if deviations.any():
                    _put(found, k, f"{label} sd", slots[label].size, deviations)
            for label, action in self._graph.actions().items():
                _put(found, k, label, action.size, row.actions.get(label, np.full(action.size, np.nan)))
        columns = {name: np.array([*cells, *[np.nan] * (len(self) - len(cells))]) for name, cells in found.items()}
        for label in self._graph.selections():
            columns[label] = np.array([row.selections.get(label, "") for row in self.rows], dtype=str)
        results = {name: np.array([getattr(row, name) for row in self.rows], dtype=float) for name in NUMBERS}
        results |= {
            "status": np.array([row.status for row in self.rows], dtype=str),
            "notes": np.array(["; ".join(row.notes) for row in self.rows], dtype=str),
        }
        taken = [name for name in results if name in columns]
        if taken:
            raise InputError(
                f"the table has columns {names(results)}, and the graph has a slot {taken[0]!r}; rename it"
            )
        return columns | results

    def column(self, name: str) -> Array:
        """Return a column; raise InputError where there is none of that name."""
        if name not in self.columns:
            raise InputError(
                f"the table has no column {name!r}{did_you_mean(name, self.columns)} Columns: {names(self.columns)}"
            )
        return self.columns[name]

    def with_unit(self, name: str) -> str:
        """Return a column's name with the unit of its slot, if it has one."""
        slot = self._graph.slots.get(name.removesuffix(" sd").partition("[")[0])
        unit = getattr(slot, "unit", "")
        return f"{name} [{unit}]" if unit else name

    def __repr__(self) -> str:
        planned = sum(np.isfinite(row.value) for row in self.rows)
        return f"<plans for {planned} of {len(self)} situations>"


def _put(found: dict[str, list[Any]], row: int, label: str, size: int, value: Any) -> None:
    """Write the elements of a slot into their columns; rows that lacked it before get NaN."""
    for i, number in enumerate(np.ravel(value)):
        cells = found.setdefault(label if size == 1 else f"{label}[{i}]", [])
        cells += [np.nan] * (row - len(cells))
        cells.append(float(number))
