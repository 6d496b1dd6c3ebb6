"""Knowledge: what is known at each step of an episode, and what the graph pays for it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from symgraph.binding import REWARD, BoundModel
from symgraph.errors import InputError, names
from symgraph.graph import Branch, Graph, Group
from symgraph.learned.records import Visit, shown
from symgraph.outcomes import ModelNumbers, Moments
from symgraph.slots import Action, Array, Selection, State

Known = dict[str, Any]  # label → float or (n,) array of a state or an action, or the choice of a selection


class Knowledge:
    """What is known at the steps of one episode: what was observed on the way there, decided, and follows from it.

    Slots that the world does not observe are filled in with what the model of the edge says, if it is not learned.

    Args:
        graph: the task.
        models: evaluates its models.
        decisions: nodes at which is decided. Their rewards that depend on what is decided are paid on the way to the
            first node that follows.

    Attributes:
        at: step → all that is known there.
        latest: the latest of all that was observed, decided or follows from it, at whatever step.
    """

    def __init__(self, graph: Graph, models: ModelNumbers, decisions: Collection[str]) -> None:
        self._graph = graph
        self._models = models
        self._decisions = decisions
        self.at: dict[int, Known] = {}
        self.latest: Known = {}

    def arrive(self, visit: Visit, parent: Visit | None) -> None:
        """Take over what was observed on the way to a visit.

        Raises:
            InputError: it does not fit the slots, or lacks what a learned model is to learn from.
        """
        for label, value in visit.observed.items():
            slot, place = self._graph.slots.get(label), f"node {visit.node!r}: the world observed {label!r}"
            if isinstance(slot, (Action, Selection)):
                raise InputError(f"{place} = {shown(value)}, which is decided and not observed; leave it out")
            if isinstance(slot, State) and np.size(value) != slot.size:
                raise InputError(
                    f"{place} with {np.size(value)} elements, the slot has {slot.size}; observe as many, or change "
                    f"the slot"
                )
            if isinstance(slot, State) and not np.isfinite(value).all():
                raise InputError(
                    f"{place} = {shown(value)}, which is not finite; if that was a failure, raise an exception with an "
                    f"attribute 'observed', {{label: value}}"
                )
        before = {} if parent is None else self.at[parent.step]
        derived = {} if parent is None else self._derived(parent.node, visit, before)
        new = {**derived, **visit.observed}
        self.at[visit.step] = {**before, **new}
        self.latest |= new

    def take_over(self, visits: Sequence[Visit]) -> None:
        """Take over an episode, or what there is of it."""
        for visit in visits:
            if visit.parent is None:
                self.arrive(visit, None)
            else:
                self.decide(visit.parent, visit.actions, visit.selections)
                self.arrive(visit, visits[visit.parent])

    def decide(self, step: int, actions: Mapping[str, Any], selections: Mapping[str, str]) -> None:
        """Take over what was decided at a step."""
        new = {**actions, **selections}
        self.at[step] = {**self.at[step], **new}
        self.latest |= new

    def reward(self, visit: Visit) -> float:
        """Return what is paid on arrival at a visit."""
        return self._reward(visit, late=False)

    def reward_due(self, visit: Visit) -> float:
        """Return what is paid at a visit as soon as its node is left."""
        return self._reward(visit, late=True)

    def _derived(self, node: str, visit: Visit, before: Known) -> Known:
        found = branches_to(self._graph, node, visit.node, before)
        for group, branch in found:
            if isinstance(group.probability, BoundModel) and group.probability.learner is not None:
                _check_sample(group.probability, before, (), visit)
            if branch.model is not None and branch.model.learner is not None:
                _check_sample(branch.model, before, tuple(branch.model.writes), visit)
        if len({id(branch.model) for _, branch in found}) != 1:  # of several nobody knows which one it was
            return {}
        model = found[0][1].model
        if model is None or model.learner is not None or all(label in visit.observed for label in model.writes):
            return {}
        if any(label not in before for label in model.reads):
            return {}
        written = self._models(model, self._columns(before, model.reads))
        return {label: float(mean[0]) if mean.size == 1 else mean for label, (mean, _) in written.items()}

    def _reward(self, visit: Visit, late: bool) -> float:
        total, known = 0.0, self.at[visit.step]
        for group in self._graph.groups.get(visit.node, ()):
            model = group.branches[0].model
            if group.kind != "reward" or model is None:
                continue
            if late != (visit.node in self._decisions and any(self._decided(label) for label in model.reads)):
                continue
            missing = [label for label in model.reads if label not in known]
            if missing:
                raise InputError(
                    f"{model.place} reads {missing[0]!r}, which was not observed on the way to {visit.node!r}; known "
                    f"are {names(known)}"
                )
            total += float(self._models(model, self._columns(known, model.reads))[REWARD][0][0])
        return total

    def _decided(self, label: str) -> bool:
        return isinstance(self._graph.slots[label], (Action, Selection))

    def _columns(self, known: Known, labels: Sequence[str]) -> dict[str, Moments]:
        return {label: (column_of(self._graph, label, known[label]), None) for label in labels}


def column_of(graph: Graph, label: str, value: Any) -> Array:
    """Return a value as the column of its slot, a choice as a one-hot one."""
    slot = graph.slots[label]
    if isinstance(slot, Selection):
        return np.array([float(choice == value) for choice in slot.choices])
    return np.atleast_1d(np.asarray(value, dtype=float))


def branches_to(graph: Graph, node: str, target: str, known: Mapping[str, Any]) -> list[tuple[Group, Branch]]:
    """Return the branches, each with its group, that can have led from a node to another under what was selected."""
    return [
        (group, branch)
        for group in graph.groups.get(node, ())
        for branch in group.branches
        if branch.target == target and (group.kind != "choose" or branch.label == known.get(str(group.selection)))
    ]


def _check_sample(model: BoundModel, before: Known, written: Sequence[str], visit: Visit) -> None:
    """Raise InputError where a learned model that has led to a visit cannot learn from it."""
    for label in model.reads:
        if label not in before:
            raise InputError(
                f"{model.place} learns from {label!r}, which was not observed before; known are {names(before)}"
            )
        if not isinstance(before[label], str) and not np.isfinite(before[label]).all():
            raise InputError(
                f"{model.place} cannot learn from {label!r} = {shown(before[label])}; observe it, or mend the model it "
                f"follows from"
            )
    for label in written:
        if label not in visit.observed:  # what was known before says nothing of what the edge did
            raise InputError(
                f"{model.place} learns {label!r}, which was not observed on the way to {visit.node!r}; observed were "
                f"{names(visit.observed)}"
            )
