"""Knowledge: what is known at each step of an episode, and what the graph pays for it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from symgraph.binding import REWARD
from symgraph.errors import InputError, names
from symgraph.graph import Branch, Graph, Group
from symgraph.learned.records import Visit
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
    """

    def __init__(self, graph: Graph, models: ModelNumbers, decisions: Collection[str]) -> None:
        self._graph = graph
        self._models = models
        self._decisions = decisions
        self.at: dict[int, Known] = {}

    def arrive(self, visit: Visit, parent: Visit | None) -> None:
        """Take over what was observed on the way to a visit.

        Raises:
            InputError: it does not fit the slots.
        """
        for label, value in visit.observed.items():
            slot = self._graph.slots.get(label)
            if isinstance(slot, State) and np.size(value) != slot.size:
                raise InputError(
                    f"node {visit.node!r}: the world observed {np.size(value)} elements of {label!r}, the slot has "
                    f"{slot.size}"
                )
            if isinstance(slot, (Action, Selection)):
                raise InputError(
                    f"node {visit.node!r}: the world observed {label!r}, which is decided and not observed"
                )
        before = {} if parent is None else self.at[parent.step]
        derived = {} if parent is None else self._derived(parent.node, visit, before)
        self.at[visit.step] = {**before, **derived, **visit.observed}

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
        self.at[step] = {**self.at[step], **actions, **selections}

    def reward(self, visit: Visit) -> float:
        """Return what is paid on arrival at a visit."""
        return self._reward(visit, late=False)

    def reward_due(self, visit: Visit) -> float:
        """Return what is paid at a visit as soon as its node is left."""
        return self._reward(visit, late=True)

    def _derived(self, node: str, visit: Visit, before: Known) -> Known:
        found = branch_to(self._graph, node, visit.node, before)
        model = found[1].model if found is not None else None
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


def branch_to(graph: Graph, node: str, target: str, known: Mapping[str, Any]) -> tuple[Group, Branch] | None:
    """Return the branch that led from a node to another, and its group; None if the graph has none.

    Raises:
        InputError: several branches lead there, and it matters which one it was.
    """
    found = [
        (group, branch)
        for group in graph.groups.get(node, ())
        for branch in group.branches
        if branch.target == target and (group.kind != "choose" or branch.label == known.get(str(group.selection)))
    ]
    if len({id(branch.model) for _, branch in found}) > 1 and any(b.model and b.model.learner for _, b in found):
        raise InputError(
            f"node {node!r}: {names(branch.label for _, branch in found)} all lead to {target!r}, so that nobody can "
            f"tell which of them is to learn from it; give each a node of its own"
        )
    return found[0] if found else None
