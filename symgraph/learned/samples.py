"""Samples: what the edges of a graph have to learn from the nodes that were visited."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from symgraph.binding import BoundModel
from symgraph.errors import InputError, names
from symgraph.graph import Branch, Graph, Group
from symgraph.learned.branches import BranchNetwork
from symgraph.slots import Array, Selection

Known = Mapping[str, Any]  # label → number, array, or the choice of a selection


@dataclass(eq=False)
class Lesson:
    """A learned model and the samples of all edges that share it.

    Attributes:
        model: a network.
        x: the inputs, a row per sample.
        y: the outputs, likewise; of a model of branches the name of the one that happened.
    """

    model: Any
    x: list[Array] = field(default_factory=list)
    y: list[Any] = field(default_factory=list)


class Lessons:
    """The learned models of a graph, and what each can learn from a step of an episode.

    Args:
        graph: the task.
        limits: {label: (low, high)} that written values are clipped to before they are learned from.

    Raises:
        InputError: two models of the same name, limits of what is no state.
    """

    def __init__(self, graph: Graph, limits: Mapping[str, tuple[float, float]]) -> None:
        self._graph = graph
        self._limits = dict(limits)
        self.all: dict[str, Lesson] = {}  # by the model's name
        for label in limits:
            if label not in graph.states():
                raise InputError(f"limits: {label!r} is no state. States: {names(graph.states())}")
        for bound in _bound_models(graph):
            model = bound.learner
            if model is None:
                continue
            known = self.all.setdefault(model.name, Lesson(model))
            if known.model.parameters[0] is not model.parameters[0]:  # a view under another rule shares its weights
                raise InputError(f"two learned models are named {model.name!r}; give each a name of its own")

    def take(self, node: str, before: Known, target: str, after: Known) -> list[Lesson]:
        """Add what a step has to teach; return the lessons that have grown.

        Args:
            node: where the step began.
            before: all that was known there, with the actions and selections of the step.
            target: the node that it led to.
            after: all that is known there.

        Raises:
            InputError: something that a model learns from was not observed.
        """
        grown = []
        found = branch_to(self._graph, node, target, before)
        if found is None:  # the world leads back to an earlier node: no edge of the graph
            return []
        group, branch = found
        if isinstance(group.probability, BoundModel) and group.probability.learner is not None:
            lesson = self.all[group.probability.learner.name]
            lesson.x.append(self._stacked(group.probability, lesson.model.reads, before))
            lesson.y.append(branch.label)
            grown.append(lesson)
        if branch.model is not None and branch.model.learner is not None:
            model = branch.model
            lesson = self.all[model.learner.name]
            x = self._stacked(model, lesson.model.reads, before)
            y = [self._clipped(model, model.targets[name], after) for name in lesson.model.writes]
            lesson.x.append(x)
            lesson.y.append(np.concatenate(y))
            grown.append(lesson)
        return grown

    def _stacked(self, bound: BoundModel, reads: Iterable[str], known: Known) -> Array:
        return np.concatenate([self._column(bound, bound.sources[name], known, "reads") for name in reads])

    def _clipped(self, bound: BoundModel, label: str, known: Known) -> Array:
        column = self._column(bound, label, known, "writes")
        return np.clip(column, *self._limits[label]) if label in self._limits else column

    def _column(self, bound: BoundModel, label: str, known: Known, what: str) -> Array:
        if label not in known:
            raise InputError(f"{bound.place} {what} {label!r}, which was not observed; known are {names(known)}")
        slot = self._graph.slots[label]
        if isinstance(slot, Selection):
            return np.array([float(choice == known[label]) for choice in slot.choices])
        return np.atleast_1d(np.asarray(known[label], dtype=float))


def fit(lesson: Lesson, seed: int) -> None:
    """Fit a model to all of its samples."""
    y = lesson.y if isinstance(lesson.model, BranchNetwork) else np.array(lesson.y)
    lesson.model.fit(np.array(lesson.x), y, seed=seed, progress=False)


def branch_to(graph: Graph, node: str, target: str, known: Known) -> tuple[Group, Branch] | None:
    """Return the branch that led from a node to another, and its group; None if the graph has none."""
    found = [
        (group, branch)
        for group in graph.groups.get(node, ())
        for branch in group.branches
        if branch.target == target and (group.kind != "choose" or branch.label == known.get(str(group.selection)))
    ]
    if len(found) > 1 and any(model is not None for model in (b.model and b.model.learner for _, b in found)):
        labels = names(branch.label for _, branch in found)
        raise InputError(
            f"node {node!r}: {labels} all lead to {target!r}, so that nobody can tell which one was learned from; "
            f"give each a node of its own"
        )
    return found[0] if found else None


def _bound_models(graph: Graph) -> Iterable[BoundModel]:
    for groups in graph.groups.values():
        for group in groups:
            if isinstance(group.probability, BoundModel):
                yield group.probability
            yield from (branch.model for branch in group.branches if branch.model is not None)
