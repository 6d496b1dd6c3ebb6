"""Graph: the task as nodes, groups of branches and rewards, checked as it is built."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from symgraph.binding import BoundModel, bind
from symgraph.drawing import Diagram, DiagramEdge, DiagramNode, NodeKind
from symgraph.errors import GraphError, did_you_mean, names
from symgraph.model import Model, Propagator
from symgraph.requirement import Requirement, requirement
from symgraph.slots import Action, Selection, Slot, State

Kind = Literal["edge", "choose", "chance", "reward"]


@dataclass(frozen=True)
class Branch:
    """One way out of a node: its label in the group, the node it leads to and the model of the way there."""

    label: str  # choice or branch; "" where the group has only one
    target: str | None  # None: a reward, which ends here
    model: BoundModel | None  # None: the identity


@dataclass(frozen=True)
class Group:
    """Branches of one node that exclude each other; the groups of a node happen side by side (Fig. 1 of the paper)."""

    kind: Kind
    branches: tuple[Branch, ...]
    selection: str | None = None  # of a choose
    probability: BoundModel | tuple[float, ...] | None = None  # of a chance; numbers stand in the order of branches


class Graph:
    """A task as a directed graph: nodes hold labelled slots, edges are models, forks are choices or chance.

    The value of a node is J = Σ over groups Σ over branches P_b · J_b (equation (3) of the paper); a reward is a
    branch that ends. A node that is only a target ends its path with value 0. Loops are allowed.

    Args:
        slots: {label: State, Action or Selection}.
        start: the node where the task begins.

    Raises:
        GraphError: here and in every method, as soon as something does not fit; the graph stays as it was.
    """

    def __init__(self, slots: Mapping[str, Slot], start: str) -> None:
        if not isinstance(slots, Mapping):
            raise GraphError(f"slots is {slots!r}; give {{label: State, Action or Selection}}")
        for label, slot in slots.items():
            if not isinstance(label, str) or not label:
                raise GraphError(f"slot label {label!r} is not a name; labels are non-empty strings")
            if not isinstance(slot, (State, Action, Selection)):
                raise GraphError(f"slot {label!r} is {slot!r}; give State(…), Action(low=…, high=…) or Selection([…])")
        self.slots: dict[str, Slot] = dict(slots)
        self.start = _node(start, "start")
        self.groups: dict[str, list[Group]] = {}  # source → its groups, in the order of the calls
        self.requirements: dict[str, list[Requirement]] = {}  # source → what must hold there
        self._known: dict[tuple[int, str, tuple[str, ...]], tuple[Any, BoundModel]] = {}

    def edge(self, source: str, target: str, model: Any = None) -> None:
        """Add a group with the one branch source → target; without a model nothing changes on the way."""
        source, target = _node(source, "source"), _node(target, "target")
        bound = self._bind(model, f"edge {source!r} → {target!r}")
        self._add(source, Group("edge", (Branch("", target, bound),)))

    def choose(self, source: str, selection: str, choices: Mapping[str, tuple[str, Any]]) -> None:
        """Add a group whose branch the planner chooses.

        Args:
            source: the node.
            selection: label of a Selection; one value of it holds in the whole tree.
            choices: {choice: (target, model)} for every choice of the selection.
        """
        source = _node(source, "source")
        place = f"node {source!r}"
        slot = self.slots.get(selection) if isinstance(selection, str) else None
        if slot is None:
            raise GraphError(
                f"{place}: selection {selection!r} is not a slot{did_you_mean(selection, self._labels(Selection))}"
                f" Selections: {names(self._labels(Selection))}"
            )
        if not isinstance(slot, Selection):
            raise GraphError(f"{place}: {selection!r} is {slot!r}, not a Selection; choose needs one")
        choices = self._branches(choices, place, "choice")
        unknown = [choice for choice in choices if choice not in slot.choices]
        if unknown:
            raise GraphError(
                f"{place}: {unknown[0]!r} is not a choice of {selection!r}{did_you_mean(unknown[0], slot.choices)}"
                f" Choices: {names(slot.choices)}"
            )
        missing = [choice for choice in slot.choices if choice not in choices]
        if missing:
            raise GraphError(
                f"{place}: choice {missing[0]!r} of {selection!r} is missing; list every choice: {names(slot.choices)}"
            )
        branches = [
            Branch(choice, choices[choice][0], self._bind(choices[choice][1], f"{place}, choice {choice!r}"))
            for choice in slot.choices
        ]
        self._add(source, Group("choose", tuple(branches), selection=selection))

    def chance(self, source: str, branches: Mapping[str, tuple[str, Any]], probability: Any) -> None:
        """Add a group whose branch happens by chance.

        Args:
            source: the node.
            branches: {branch: (target, model)}.
            probability: {branch: number} that sums to 1, or a model that returns {branch: expression}.
        """
        source = _node(source, "source")
        place = f"node {source!r}"
        branches = self._branches(branches, place, "branch")
        if not branches:
            raise GraphError(f"{place}: chance has no branches; give at least one")
        if isinstance(probability, Mapping):
            p: Any = _constant_probabilities(probability, branches, place)
        elif not callable(probability) and not isinstance(probability, (Model, Propagator)):
            raise GraphError(f"{place}: probability = {probability!r}; give {{branch: number}} or a model")
        else:
            p = self._bound(probability, "probability", f"{place}, probability", tuple(branches))
        bound = [Branch(b, t, self._bind(m, f"{place}, branch {b!r}")) for b, (t, m) in branches.items()]
        self._add(source, Group("chance", tuple(bound), probability=p))

    def reward(self, source: str, model: Any) -> None:
        """Add a reward that is paid at a node: a model that returns one scalar."""
        source = _node(source, "source")
        bound = self._bound(model, "reward", f"node {source!r}, reward")
        self._add(source, Group("reward", (Branch("", None, bound),)))

    def require(
        self, source: str, model: Any, low: Any = -math.inf, high: Any = math.inf, confidence: float | None = None
    ) -> None:
        """Add a requirement: low ≤ what the model returns ≤ high, wherever the chosen branches lead to a node.

        It counts there whatever the probability, but not where a branch is cut. Plans that meet all requirements come
        before all others; `plan.violation` says by how much one is missed.

        Args:
            source: the node.
            model: returns a scalar or a column, checked element by element; its default propagation is "linear".
            low: a number, or one for each element [unit of what the model returns].
            high: likewise; equal ones demand equality.
            confidence: probability with which each finite side must hold under the Gaussian, mean ± quantile · sd; if
                left out, the mean must lie between the bounds.
        """
        source = _node(source, "source")
        place = f"node {source!r}, requirement"
        bound = self._bound(model, "requirement", place)
        checked = requirement(bound, low, high, confidence, bound.place)
        self.requirements.setdefault(source, []).append(checked)

    @property
    def nodes(self) -> list[str]:
        """All nodes in the order in which they were first named, the start first."""
        found = {self.start: None}
        for source, groups in self.groups.items():
            found[source] = None
            found.update({branch.target: None for group in groups for branch in group.branches if branch.target})
        return list({**found, **dict.fromkeys(self.requirements)})

    def selections(self) -> dict[str, Selection]:
        """Return the slots that are selections, in their order."""
        return {label: slot for label, slot in self.slots.items() if isinstance(slot, Selection)}

    def actions(self) -> dict[str, Action]:
        """Return the slots that are actions, in their order: the order of stacked actions."""
        return {label: slot for label, slot in self.slots.items() if isinstance(slot, Action)}

    def states(self) -> dict[str, State]:
        """Return the slots that are states, in their order."""
        return {label: slot for label, slot in self.slots.items() if isinstance(slot, State)}

    def check_reachable(self) -> None:
        """Raise GraphError when some node cannot be reached from the start."""
        reached, waiting = {self.start}, [self.start]
        while waiting:
            for target in self._targets(waiting.pop()):
                if target not in reached:
                    reached.add(target)
                    waiting.append(target)
        lost = [node for node in self.nodes if node not in reached]
        if lost:
            raise GraphError(
                f"node {lost[0]!r} cannot be reached from the start {self.start!r}{did_you_mean(lost[0], reached)}"
                f" Reached: {names(node for node in self.nodes if node in reached)}"
            )

    def diagram(self) -> Diagram:
        """Return the picture of the graph; `diagram().save("graph.svg")` writes it to a file."""
        nodes, edges = [], []
        for name in self.nodes:
            kind: NodeKind
            kind = "start" if name == self.start else "node" if name in self.groups else "terminal"
            demands = tuple(line for one in self.requirements.get(name, ()) for line in one.lines)
            nodes.append(DiagramNode(key=name, lines=(name, *demands), kind=kind))
            for g, group in enumerate(self.groups.get(name, ())):
                for branch in group.branches:
                    target = branch.target
                    if target is None:
                        target = f"{name} reward {g}"
                        nodes.append(
                            DiagramNode(key=target, lines=(branch.model.name if branch.model else "",), kind="reward")
                        )
                    weight = None
                    if isinstance(group.probability, tuple):
                        weight = group.probability[group.branches.index(branch)]
                    label = edge_label(group, branch)
                    edges.append(DiagramEdge(name, target, label, g, group.kind, weight=weight))
        return Diagram(nodes=tuple(nodes), edges=tuple(edges))

    def _repr_svg_(self) -> str:
        return self.diagram().svg()

    def __repr__(self) -> str:
        return f"Graph({len(self.slots)} slots, {len(self.nodes)} nodes, start {self.start!r})"

    def _labels(self, kind: type) -> list[str]:
        return [label for label, slot in self.slots.items() if isinstance(slot, kind)]

    def _targets(self, source: str) -> Iterator[str]:
        for group in self.groups.get(source, ()):
            for branch in group.branches:
                if branch.target is not None:
                    yield branch.target

    def _bind(self, model: Any, place: str) -> BoundModel | None:
        return None if model is None else self._bound(model, "edge", place)

    def _bound(self, model: Any, role: str, place: str, branches: tuple[str, ...] = ()) -> BoundModel:
        """Check a model, or take over what was found elsewhere: a large graph has the same ones many times."""
        key = id(model), role, branches
        if key in self._known:
            return self._known[key][1].at(place)
        bound = bind(model, self.slots, role, place, branches)
        self._known[key] = model, bound  # the model is kept, so that no other one gets its id
        return bound

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_known": {}}

    def _add(self, source: str, group: Group) -> None:
        self.groups.setdefault(source, []).append(group)

    @staticmethod
    def _branches(given: Any, place: str, what: str) -> dict[str, tuple[str, Any]]:
        if not isinstance(given, Mapping):
            raise GraphError(f"{place}: give {{{what}: (target, model)}}, got {given!r}")
        for label, pair in given.items():
            if not isinstance(label, str) or not label:
                raise GraphError(f"{place}: {what} {label!r} is not a name; give non-empty strings")
            if not isinstance(pair, tuple) or len(pair) != 2:
                raise GraphError(f"{place}, {what} {label!r}: give (target, model), got {pair!r}")
            _node(pair[0], f"{place}, {what} {label!r}: target")
        return dict(given)


def edge_label(group: Group, branch: Branch) -> str:
    """What stands beside a branch in a picture: what is chosen or happens, and the model."""
    if group.kind == "reward":
        return ""
    head = f"{group.selection} = {branch.label}" if group.kind == "choose" else branch.label
    model = branch.model.name if branch.model is not None else ""
    return ": ".join(part for part in (head, model) if part)


def _node(name: object, what: str) -> str:
    if not isinstance(name, str) or not name:
        raise GraphError(f"{what} is {name!r}; nodes are named by non-empty strings")
    return name


def _constant_probabilities(given: Mapping[str, Any], branches: Mapping[str, Any], place: str) -> tuple[float, ...]:
    unknown = [label for label in given if label not in branches]
    if unknown:
        raise GraphError(
            f"{place}: probability names {unknown[0]!r}, which is no branch{did_you_mean(unknown[0], branches)}"
            f" Branches: {names(branches)}"
        )
    missing = [label for label in branches if label not in given]
    if missing:
        raise GraphError(f"{place}: branch {missing[0]!r} has no probability; give one to each of {names(branches)}")
    shares = []
    for label in branches:
        try:
            share = float(given[label])
        except (TypeError, ValueError):
            raise GraphError(f"{place}: probability of {label!r} is {given[label]!r}; give a number") from None
        if not 0.0 <= share <= 1.0:
            raise GraphError(f"{place}: probability of {label!r} is {share:g}; it must lie in [0, 1]")
        shares.append(share)
    total = math.fsum(shares)
    if abs(total - 1.0) > 1e-9:
        raise GraphError(f"{place}: the probabilities of {names(branches)} sum to {total:.9g}; they must sum to 1")
    return tuple(shares)
