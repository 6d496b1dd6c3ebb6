"""Samples: what the edges of a graph have to learn from the nodes that were visited."""

from __future__ import annotations

import itertools
import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from symgraph.binding import BoundModel
from symgraph.errors import InputError, StorageError, did_you_mean, names
from symgraph.graph import Branch, Graph, Group
from symgraph.learned.branches import BranchNetwork
from symgraph.learned.knowledge import Knowledge, Known, branches_to, column_of
from symgraph.learned.records import Visit
from symgraph.slots import Array

# What a model that can be fitted must have beside `fit`, `reads`, `writes` and `propagate`.
NEEDED = ("name", "parameters", "samples", "save", "restore", "settings")


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

    Attributes:
        all: {name of the model: its lesson}.
        reads: the states that learned models read.

    Raises:
        InputError: two models of the same name or file, a model that lacks something, branches that nobody can tell
            apart, limits that do not fit.
    """

    def __init__(self, graph: Graph, limits: Mapping[str, tuple[float, float]], folder: Path, seed: int) -> None:
        self._graph = graph
        self._limits = _checked_limits(limits, graph)
        self._folder = folder
        self._seed = seed
        self.all: dict[str, Lesson] = {}
        reads: list[str] = []
        for bound in _bound_models(graph):
            model = bound.learner
            if model is None:
                continue
            lacks = [name for name in NEEDED if not hasattr(model, name)]
            if lacks or not model.parameters:
                raise InputError(
                    f"{bound.place} has a method 'fit' but no {(lacks or ['parameters'])[0]!r}; see StochasticNetwork, "
                    f"or take 'fit' away to use it as it is"
                )
            for spread in getattr(model, "spreads", ()):
                if not any(spread is parameter for parameter in model.parameters):
                    raise InputError(f"{bound.place}: its 'spreads' hold {spread!r}; give some of its 'parameters'")
            reads += bound.reads
            known = self.all.setdefault(model.name, Lesson(model))
            if known.model.parameters[0] is not model.parameters[0]:  # a view under another rule shares its weights
                raise InputError(f"two learned models are named {model.name!r}; give each a name of its own")
        files = {self.file_of(name): name for name in self.all}
        for name in self.all:
            if files[self.file_of(name)] != name:
                raise InputError(
                    f"learned models {name!r} and {files[self.file_of(name)]!r} would both be kept in "
                    f"{self.file_of(name).name}; give them names that differ in letters or digits"
                )
        _check_told_apart(graph)
        self.reads = [label for label in dict.fromkeys(reads) if label in graph.states()]

    def restore(self) -> None:
        """Take over the models that the folder holds.

        Raises:
            StorageError: a file cannot be read, is damaged, or holds something else.
        """
        for name, lesson in self.all.items():
            if not self.file_of(name).exists():
                continue
            try:
                lesson.model.restore(self.file_of(name))
            except StorageError as error:
                if not error.damage:
                    raise
                remedy = "delete the file, and the loop fits the model to its episodes"
                raise StorageError(f"{error.damage}; {remedy}") from None

    def check_seen(self) -> None:
        """Fit anew the models whose file has seen more samples than there are; raise InputError where others have.

        A power cut may take visits that a file has learned from. A fit to those that are left goes on from there.
        """
        for name, lesson in self.all.items():
            seen, count, file = lesson.model.samples, len(lesson.x), self.file_of(name)
            if seen > count and not (count and file.exists()):
                raise InputError(
                    f"model {name!r} has seen {seen} samples, of which the episodes in {self._folder} know "
                    f"{count or 'nothing'}; give a new model, and take {file.name} away if it is in that folder"
                )
            if seen > count:
                self._refit(lesson)

    def counts(self) -> dict[str, int]:
        """Return how many samples each model has."""
        return {name: len(lesson.x) for name, lesson in self.all.items()}

    def rewind(self, counts: Mapping[str, int]) -> None:
        """Forget all samples but the first so many of each model."""
        for name, lesson in self.all.items():
            del lesson.x[counts[name] :], lesson.y[counts[name] :]

    def fit(self, lessons: Iterable[Lesson]) -> None:
        """Fit the models that have not seen all of their samples, and keep each in its file."""
        for lesson in lessons:
            if lesson.model.samples < len(lesson.x):
                self._refit(lesson)

    def _refit(self, lesson: Lesson) -> None:
        name = lesson.model.name
        lesson.fit(zlib.crc32(repr((self._seed, name, len(lesson.x))).encode()))
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
        found = branches_to(self._graph, node, target, before)
        if not found:  # the world leads back to an earlier node: no edge of the graph
            return []
        group, branch = found[0]  # if it learns, there is no other, see _check_told_apart
        if isinstance(group.probability, BoundModel) and group.probability.learner is not None:
            lesson = self.all[group.probability.learner.name]
            lesson.x.append(self._stacked(group.probability, lesson.model.reads, before))
            lesson.y.append(branch.label)
            grown.append(lesson)
        if branch.model is not None and branch.model.learner is not None:
            model = branch.model
            lesson = self.all[model.learner.name]
            x = self._stacked(model, lesson.model.reads, before)
            y = [self._clipped(model.targets[name], after) for name in lesson.model.writes]
            lesson.x.append(x)
            lesson.y.append(np.concatenate(y))
            grown.append(lesson)
        return grown

    def _stacked(self, bound: BoundModel, reads: Iterable[str], known: Known) -> Array:
        labels = [bound.sources[name] for name in reads]
        return np.concatenate([column_of(self._graph, label, known[label]) for label in labels])

    def _clipped(self, label: str, known: Known) -> Array:
        column = column_of(self._graph, label, known[label])
        return np.clip(column, *self._limits[label]) if label in self._limits else column


def _bound_models(graph: Graph) -> Iterable[BoundModel]:
    """Return the models that can be taught: rewards are computed, not observed."""
    for groups in graph.groups.values():
        for group in groups:
            if group.kind == "reward":
                continue
            if isinstance(group.probability, BoundModel):
                yield group.probability
            yield from (branch.model for branch in group.branches if branch.model is not None)


def _checked_limits(limits: Any, graph: Graph) -> dict[str, tuple[Any, Any]]:
    """Return {label: (low, high)}; raise InputError where it is none of the graph's states."""
    if not isinstance(limits, Mapping):
        raise InputError(f"limits = {limits!r}; give {{label: (low, high)}}")
    for label, pair in limits.items():
        states = graph.states()
        if label not in states:
            raise InputError(f"limits: {label!r} is no state{did_you_mean(label, states)} States: {names(states)}")
        try:
            low, high = (np.broadcast_to(np.asarray(bound, dtype=float), states[label].size) for bound in pair)
            fits = bool((low <= high).all())
        except (TypeError, ValueError):
            fits = False
        if not fits:
            raise InputError(f"limits of {label!r} = {pair!r}; give (low, high), numbers or one for each element")
    return dict(limits)


def _check_told_apart(graph: Graph) -> None:
    """Raise InputError where several branches lead to one node and it matters to a model which one it was."""
    for node, groups in graph.groups.items():
        branches = [(group, branch) for group in groups for branch in group.branches if branch.target is not None]
        for (group, one), (other_group, other) in itertools.combinations(branches, 2):
            exclusive = group.selection is not None and group.selection == other_group.selection
            if one.target != other.target or (exclusive and one.label != other.label):
                continue
            if _learned_from(group, one) != _learned_from(other_group, other):
                raise InputError(
                    f"node {node!r}: {names((one.label, other.label))} lead to {one.target!r}, so that nobody can tell "
                    f"which of them is to learn from it; give each a node of its own"
                )


def _learned_from(group: Group, branch: Branch) -> tuple[Any, ...]:
    """Return what is learned where a branch happens."""
    chance = group.probability
    taught = branch.label if isinstance(chance, BoundModel) and chance.learner is not None else None
    return taught, branch.model if branch.model is not None and branch.model.learner is not None else None
