"""Novelty: which choice of a selection is known least in a situation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from symgraph.graph import Graph
from symgraph.learned.knowledge import Known, column_of
from symgraph.slots import Array

Try = tuple[Array, Mapping[str, str]]  # a situation (n,), NaN where it is not known, and {selection: choice} made in it
SMALLEST_SPREAD = 1e-9  # standard deviation over the largest number, up to which it is rounding error
FAR = 1e150  # standard deviations beyond which all is equally far: the square is still a number


def situation_of(graph: Graph, labels: Iterable[str], known: Known, at_start: Known) -> Array:
    """Return the elements of states as they are known at a step.

    Args:
        graph: has their sizes.
        labels: of the states.
        known: at the step.
        at_start: what is known where the episode starts; other states are NaN, as they say more about what was done
            before than about the situation.
    """
    parts = [
        column_of(graph, label, known[label]) if label in at_start else np.full(graph.slots[label].size, np.nan)
        for label in labels
    ]
    return np.concatenate([np.empty(0), *parts])


def least_known(selection: str, choices: Sequence[str], situation: Array, tries: Sequence[Try]) -> list[str]:
    """Return the choices that have been tried least in situations like one.

    A try counts exp(-d²/2), with d its distance from the situation, each element in standard deviations over all tries:
    the sum is the density of tries but for a factor. With many elements the nearest tries decide. A skill that has been
    tried a hundred times with paste is still unknown for water. An element that a try does not know counts as two
    independent draws would be expected to, 2 squared deviations; one that is not known in the situation, or that does
    not vary, says nothing.

    Args:
        selection: the selection.
        choices: of it.
        situation: (n,), see `situation_of`.
        tries: so far.
    """
    if not tries:
        return list(choices)
    made = [choices_made.get(selection) for _, choices_made in tries]
    seen = np.array([where for where, _ in tries])
    largest = np.fmax.reduce(np.abs(seen))  # passes over NaN
    unit = np.where(largest > 0.0, largest, 1.0)  # in which no deviation's square overflows
    sd = unit * np.ma.masked_invalid(seen / unit).std(axis=0).filled(0.0)
    tells = (sd > SMALLEST_SPREAD * unit) & ~np.isnan(situation)
    with np.errstate(over="ignore"):
        offsets = np.clip((seen[:, tells] - situation[tells]) / sd[tells], -FAR, FAR)
    squares = np.where(np.isnan(offsets), 2.0, offsets**2).sum(axis=1)
    # Logarithms tell tries apart however far they are; sorted, equal ones count the same to the last bit.
    counted = {
        choice: np.logaddexp.reduce(sorted(-q / 2 for one, q in zip(made, squares, strict=True) if one == choice))
        for choice in choices
    }
    least = min(counted.values())
    return [choice for choice in choices if counted[choice] <= least + 1e-9]
