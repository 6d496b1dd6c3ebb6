"""Tree: a graph unrolled from a node, breadth-first, loops cut after a number of visits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from symgraph.binding import BoundModel
from symgraph.drawing import Diagram, DiagramEdge, DiagramNode, NodeKind
from symgraph.errors import GraphError, did_you_mean, names
from symgraph.graph import Branch, Graph, Group, edge_label
from symgraph.requirement import Requirement
from symgraph.slots import State

MOST_SHOWN = 300  # nodes that a notebook draws unasked; more take long and nobody can read them
MAX_NODES = 300_000  # beyond it memory runs out before the user learns why


@dataclass(frozen=True)
class TreeBranch:
    """A branch of a tree node; `child` is the index of the node it leads to, None for a reward."""

    branch: Branch
    share: float | None  # constant probability; None where the plan or a model decides
    child: int | None


@dataclass(frozen=True)
class TreeGroup:
    """A group of a tree node, with the branches that can still happen on the way here."""

    group: Group
    branches: tuple[TreeBranch, ...]


@dataclass(frozen=True)
class TreeNode:
    """One visit of a graph node on one path."""

    index: int
    name: str  # of the graph node
    parent: int | None
    step: str  # what leads here from the parent: "landed" or "landed[lower]"
    cut: bool  # visited too often on this path: ends here with the cut value
    groups: tuple[TreeGroup, ...] = ()
    requirements: tuple[Requirement, ...] = ()


class Tree:
    """The paths of a graph from one node; make it with `unroll`."""

    def __init__(self, graph: Graph, nodes: tuple[TreeNode, ...], max_visits: int, cut_value: float) -> None:
        self.graph = graph
        self.nodes = nodes  # breadth-first: parents stand before their children
        self.max_visits = max_visits
        self.cut_value = cut_value

    def path(self, index: int) -> str:
        """Return the way from the root to a node, e.g. "aim/landed[lower]"."""
        steps = []
        at: int | None = index
        while at is not None:
            steps.append(self.nodes[at].step)
            at = self.nodes[at].parent
        return "/".join(reversed(steps))

    @cached_property
    def needed_states(self) -> dict[str, str]:
        """{state that some path reads before writing it: the place that reads it}, in the order of the slots."""
        needed: dict[str, str] = {}

        def read(model: BoundModel | None, written: frozenset[str]) -> None:
            for label in model.reads if model is not None else ():
                if label not in written and isinstance(slots[label], State):
                    needed.setdefault(label, model.place if model is not None else "")

        slots = self.graph.slots
        written = {0: frozenset[str]()}
        for node in self.nodes:
            here = written.pop(node.index)
            for requirement in node.requirements:
                read(requirement.model, here)
            for tree_group in node.groups:
                if isinstance(tree_group.group.probability, BoundModel):
                    read(tree_group.group.probability, here)
                for tree_branch in tree_group.branches:
                    model = tree_branch.branch.model
                    read(model, here)
                    if tree_branch.child is not None:
                        written[tree_branch.child] = here.union(model.writes) if model is not None else here
        return {label: needed[label] for label in slots if label in needed}

    @cached_property
    def models(self) -> tuple[BoundModel, ...]:
        """Every model of the tree once, in the order of the nodes."""
        found: dict[BoundModel, None] = {}
        for node in self.nodes:
            found.update({requirement.model: None for requirement in node.requirements})
            for tree_group in node.groups:
                if isinstance(tree_group.group.probability, BoundModel):
                    found[tree_group.group.probability] = None
                found.update({b.branch.model: None for b in tree_group.branches if b.branch.model is not None})
        return tuple(found)

    def chosen(self, selections: Mapping[str, str]) -> Tree:
        """Return the tree without the branches that selections rule out; its paths are those of this one.

        Args:
            selections: {label: choice} of all selections.
        """
        kept = [0]  # grows while it is walked; the new index of a node is its place
        nodes: list[TreeNode] = []
        parents: list[int | None] = [None]
        for old in kept:
            node = self.nodes[old]
            groups = []
            for group in node.groups:
                choice = None if group.group.selection is None else selections[group.group.selection]
                branches = []
                for branch in group.branches:
                    if choice is not None and branch.branch.label != choice:
                        continue
                    child = branch.child
                    if child is not None:
                        kept.append(child)
                        parents.append(len(nodes))
                        child = len(kept) - 1
                    branches.append(TreeBranch(branch.branch, branch.share if choice is None else 1.0, child))
                groups.append(TreeGroup(group.group, tuple(branches)))
            nodes.append(replace(node, index=len(nodes), parent=parents[len(nodes)], groups=tuple(groups)))
        return Tree(self.graph, tuple(nodes), self.max_visits, self.cut_value)

    def diagram(
        self,
        notes: Mapping[int, tuple[str, ...]] | None = None,
        reach: Mapping[int, float] | None = None,
        shares: Mapping[int, float] | None = None,
    ) -> Diagram:
        """Return the picture of the tree; `diagram().save("tree.svg")` writes it to a file.

        Args:
            notes: {node index: further lines in its box}.
            reach: {node index: probability of getting there}; what has probability 0 is drawn pale.
            shares: {node index: probability of getting there from its parent}, shown where chance decides.
        """
        notes, reach, shares = notes or {}, reach or {}, shares or {}
        nodes, edges = [], []
        for node in self.nodes:
            kind: NodeKind
            kind = "cut" if node.cut else "start" if node.parent is None else "node" if node.groups else "terminal"
            pale = reach.get(node.index) == 0.0
            key, path = str(node.index), self.path(node.index)
            lines = (node.name, *notes.get(node.index, ()))
            nodes.append(DiagramNode(key=key, lines=lines, kind=kind, muted=pale, tooltip=path))
            for g, group in enumerate(node.groups):
                for branch in group.branches:
                    weight = None
                    if branch.child is None:
                        target, muted = f"{key} reward {g}", pale
                        name = branch.branch.model.name if branch.branch.model is not None else ""
                        nodes.append(DiagramNode(key=target, lines=(name,), kind="reward", muted=pale))
                    else:
                        target, muted = str(branch.child), reach.get(branch.child) == 0.0
                        if group.group.kind == "chance":
                            weight = shares.get(branch.child, branch.share)
                    label = edge_label(group.group, branch.branch)
                    edges.append(DiagramEdge(key, target, label, g, group.group.kind, muted, weight))
        return Diagram(nodes=tuple(nodes), edges=tuple(edges))

    def _repr_svg_(self) -> str | None:
        return self.diagram().svg() if len(self.nodes) <= MOST_SHOWN else None

    def __repr__(self) -> str:
        cuts = sum(node.cut for node in self.nodes)
        return f"Tree({len(self.nodes)} nodes, {cuts} of them cut, from {self.nodes[0].name!r})"


def unroll(graph: Graph, max_visits: int = 3, start: str | None = None, cut_value: float = 0.0) -> Tree:
    """Unroll a graph to the tree of its paths, breadth-first.

    A selection has one value in the whole tree: below a choice of it only that choice is followed. Branches whose
    probability is the constant 0 are left out.

    Args:
        graph: the task.
        max_visits: times one node may recur on a path from the start; one more visit is cut.
        start: plan from this node on instead of the graph's start.
        cut_value: worth of a cut branch [reward]; 0 beats every negative reward, so plans say when they can be cut.

    Raises:
        GraphError: a start that no call mentions, unreachable nodes, settings that are not numbers, a tree too large.

    Source: Yamaguchi & Atkeson, Humanoids 2016, section II-B; visits count per path instead of over the whole search,
        since siblings that share nodes would otherwise cut each other.
    """
    if not isinstance(graph, Graph):
        raise GraphError(f"unroll takes a Graph, got {type(graph).__name__}")
    if isinstance(max_visits, bool) or not isinstance(max_visits, (int, np.integer)) or max_visits < 1:
        raise GraphError(f"max_visits = {max_visits!r}; give a whole number of at least 1")
    if not isinstance(cut_value, (int, float, np.number)) or not math.isfinite(cut_value):
        raise GraphError(f"cut_value = {cut_value!r}; give a finite number")
    known = [node for node in graph.nodes if node != graph.start or _mentioned(graph, node)]
    for name in dict.fromkeys((graph.start, graph.start if start is None else start)):
        if name not in known:
            raise GraphError(
                f"start node {name!r} is in no edge, choose, chance, reward or requirement{did_you_mean(name, known)}"
                f" Nodes: {names(known)}"
            )
    graph.check_reachable()
    return _Unroller(graph, int(max_visits), float(cut_value)).run(graph.start if start is None else start)


def _mentioned(graph: Graph, node: str) -> bool:
    targets = {branch.target for groups in graph.groups.values() for group in groups for branch in group.branches}
    return node in graph.groups or node in targets or node in graph.requirements


@dataclass(frozen=True)
class _Arrival:
    """What the search knows of a node it has still to visit."""

    name: str
    parent: int | None
    step: str
    decided: tuple[tuple[str, str], ...]  # selection → choice on the way here


class _Unroller:
    def __init__(self, graph: Graph, max_visits: int, cut_value: float) -> None:
        self._graph = graph
        self._max_visits = max_visits
        self._cut_value = cut_value
        self._arrivals: list[_Arrival] = []  # grows while it is walked: a queue that keeps the indices

    def run(self, start: str) -> Tree:
        nodes: list[TreeNode] = []
        visits: list[dict[str, int]] = []
        self._arrivals.append(_Arrival(start, None, start, ()))
        while len(nodes) < len(self._arrivals):
            arrival = self._arrivals[len(nodes)]
            before = visits[arrival.parent] if arrival.parent is not None else {}
            times = before.get(arrival.name, 0) + 1
            cut = times > self._max_visits
            visits.append({**before, arrival.name: times} if not cut else before)
            index = len(nodes)
            here = () if cut else self._graph.groups.get(arrival.name, ())
            groups = tuple(self._group(group, index, arrival) for group in here)
            requirements = () if cut else tuple(self._graph.requirements.get(arrival.name, ()))
            nodes.append(TreeNode(index, arrival.name, arrival.parent, arrival.step, cut, groups, requirements))
            if len(self._arrivals) > MAX_NODES:
                raise GraphError(
                    f"the tree has more than {MAX_NODES:,} nodes at max_visits = {self._max_visits}; lower max_visits "
                    f"or loop through fewer branches"
                )
        return Tree(self._graph, tuple(nodes), self._max_visits, self._cut_value)

    def _group(self, group: Group, parent: int, arrival: _Arrival) -> TreeGroup:
        decided = dict(arrival.decided)
        branches = []
        for i, branch in enumerate(group.branches):
            share = None
            if group.kind == "choose" and group.selection in decided:
                if decided[group.selection] != branch.label:
                    continue
                share = 1.0
            elif isinstance(group.probability, tuple):
                share = group.probability[i]
                if share == 0.0:
                    continue
            elif group.kind in ("edge", "reward"):
                share = 1.0
            child = None
            if branch.target is not None:
                child = len(self._arrivals)
                step = f"{branch.target}[{branch.label}]" if branch.label else branch.target
                further = arrival.decided
                if group.kind == "choose" and group.selection is not None and group.selection not in decided:
                    further = (*further, (group.selection, branch.label))
                self._arrivals.append(_Arrival(branch.target, parent, step, further))
            branches.append(TreeBranch(branch, share, child))
        return TreeGroup(group, tuple(branches))
