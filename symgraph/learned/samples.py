"""Samples: what the edges of a graph have to learn from the nodes that were visited."""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from symgraph.binding import BoundModel
from symgraph.errors import InputError, names
from symgraph.graph import Graph
from symgraph.learned.branches import BranchNetwork
from symgraph.learned.knowledge import Knowledge, Known, branch_to, column_of
from symgraph.learned.records import Visit
from symgraph.slots import Array


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

    def fit(self, seed: int) -> None:
        """Fit the model to all samples."""
        y = self.y if isinstance(self.model, BranchNetwork) else np.array(self.y)
        self.model.fit(np.array(self.x), y, seed=seed, progress=False)


class Lessons:
    """The learned models of a graph, what each can learn from the steps of episodes, and the files they are kept in.

    Args:
        graph: the task.
        limits: {label: (low, high)} that written values are clipped to before they are learned from.
        folder: of the files `<name>.safetensors`.
        seed: of the fits.

    Raises:
        InputError: two models of the same name, limits of what is no state.
    """

    def __init__(self, graph: Graph, limits: Mapping[str, tuple[float, float]], folder: Path, seed: int) -> None:
        self._graph = graph
        self._limits = dict(limits)
        self._folder = folder
        self._seed = seed
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

    def restore(self) -> None:
        """Take over the models that the folder holds."""
        for name, lesson in self.all.items():
            if self.file_of(name).exists():
                lesson.model.restore(self.file_of(name))

    def fit(self, lessons: Iterable[Lesson]) -> None:
        """Fit the models that have not seen all of their samples, and keep each in its file."""
        for lesson in lessons:
            name, count = lesson.model.name, len(lesson.x)
            if lesson.model.samples < count:
                lesson.fit(zlib.crc32(repr((self._seed, name, count)).encode()))
                lesson.model.save(self.file_of(name))

    def file_of(self, name: str) -> Path:
        """Return the file in which the model of this name is kept."""
        return self._folder / f"{re.sub(r'[^A-Za-z0-9_+.-]', '_', name)}.safetensors"

    def take(self, visits: Sequence[Visit], new: Sequence[Visit], knowledge: Knowledge) -> list[Lesson]:
        """Add what new visits of an episode have to teach; return the lessons that have grown, each once.

        Args:
            visits: of the episode so far, by their steps.
            new: those to learn from.
            knowledge: of the episode.

        Raises:
            InputError: something that a model learns from was not observed.
        """
        grown: dict[int, Lesson] = {}
        for visit in new:
            if visit.parent is not None:
                before, after = knowledge.at[visit.parent], knowledge.at[visit.step]
                for lesson in self._take(visits[visit.parent].node, before, visit.node, after):
                    grown[id(lesson)] = lesson
        return list(grown.values())

    def _take(self, node: str, before: Known, target: str, after: Known) -> list[Lesson]:
        """Add what the step from one node to another has to teach; return the lessons that have grown."""
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
        return column_of(self._graph, label, known[label])


def _bound_models(graph: Graph) -> Iterable[BoundModel]:
    for groups in graph.groups.values():
        for group in groups:
            if isinstance(group.probability, BoundModel):
                yield group.probability
            yield from (branch.model for branch in group.branches if branch.model is not None)
