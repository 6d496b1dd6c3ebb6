"""Novelty: which choice of a selection is known least in a situation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from symgraph.graph import Graph
from symgraph.learned.knowledge import Known, column_of
from symgraph.slots import Array

Try = tuple[Array, Mapping[str, str]]  # a situation (n,), NaN where it is not known, and {selection: choice} made in it


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
    """Return the choices whose nearest try lies farthest from a situation; of equals, those made least often.

    Nearness is the distance of the situations, each element in standard deviations over all tries. A skill that has
    been tried a hundred times with paste is still unknown for water.

    Args:
        selection: the selection.
        choices: of it.
        situation: (n,), see `situation_of`.
        tries: so far.
    """
    made = [choices_made.get(selection) for _, choices_made in tries]
    if not tries:
        return list(choices)
    seen = np.array([where for where, _ in tries])
    offsets = seen - situation
    known = ~np.isnan(offsets)
    offsets[~known] = 0.0
    count = np.maximum(known.sum(axis=0), 1)
    mean = np.where(known, seen, 0.0).sum(axis=0) / count
    sd = np.sqrt((np.where(known, seen - mean, 0.0) ** 2).sum(axis=0) / count)
    distances = np.sqrt(((offsets / np.where(sd > 0.0, sd, 1.0)) ** 2).sum(axis=1))

    def unknown(choice: str) -> tuple[float, int]:
        at = [i for i, one in enumerate(made) if one == choice]
        return min((float(distances[i]) for i in at), default=np.inf), -len(at)

    most = max(map(unknown, choices))
    return [choice for choice in choices if unknown(choice) == most]
