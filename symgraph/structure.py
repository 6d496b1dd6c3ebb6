"""The structure of a tree: which subtrees are alike, and which become functions of their own."""

from __future__ import annotations

from collections import Counter
from typing import Any

from symgraph.binding import BoundModel
from symgraph.slots import State
from symgraph.tree import Tree, TreeBranch, TreeGroup

# Tree nodes that one function holds; what is larger is cut into functions that call each other.
FUNCTION_NODES = 64
# From this size on, subtrees that are alike become one function, written and compiled once.
SHARED_NODES = 16


class Structure:
    """Which subtrees of a tree are alike, which become functions of their own, and what those read.

    Attributes:
        kinds: for each node, a number that nodes with equal subtrees share.
        apart: for each node, whether the branch that leads to it is a function of its own.
    """

    def __init__(self, tree: Tree) -> None:
        self._order = {label: i for i, (label, s) in enumerate(tree.graph.slots.items()) if isinstance(s, State)}
        count = len(tree.nodes)
        self.kinds = [0] * count
        self.apart = [False] * count
        self._needs: dict[tuple[BoundModel | None, int], tuple[str, ...]] = {}
        numbers: dict[tuple[Any, ...], int] = {}
        reads: dict[int, frozenset[str]] = {}  # by kind
        for node in reversed(tree.nodes):
            key: list[Any] = [node.cut, *(id(requirement) for requirement in node.requirements)]
            found = set[str]().union(*(self._states(requirement.model) for requirement in node.requirements))
            for group in node.groups:
                probability = group.group.probability
                found |= self._states(probability if isinstance(probability, BoundModel) else None)
                for branch in group.branches:
                    below = None if branch.child is None else self.kinds[branch.child]
                    key.append((id(group.group), id(branch.branch), branch.share, below))
                    found |= self._branch_reads(branch.branch.model, frozenset() if below is None else reads[below])
            kind = numbers.setdefault(tuple(key), len(numbers))
            self.kinds[node.index] = kind
            reads[kind] = frozenset(found)
        self._kind_reads = reads
        self._set_apart(tree)

    def needs(self, branch: TreeBranch) -> tuple[str, ...]:
        """Return the states that a branch reads before writing them, in the order of the slots."""
        key = branch.branch.model, self.kinds[branch.child or 0]
        if key not in self._needs:
            found = self._branch_reads(branch.branch.model, self._kind_reads[key[1]])
            self._needs[key] = tuple(sorted(found, key=self._order.__getitem__))
        return self._needs[key]

    def _set_apart(self, tree: Tree) -> None:
        repeats = Counter(self.kinds)
        size = [1] * len(tree.nodes)  # of the part of a subtree that is not apart
        large = len(tree.nodes) > FUNCTION_NODES
        for node in reversed(tree.nodes):
            for group in node.groups:
                for branch in group.branches:
                    child = branch.child
                    if child is None:
                        continue
                    alike = repeats[self.kinds[child]] > 1 and size[child] >= SHARED_NODES
                    self.apart[child] = is_open(group) or (large and (alike or size[child] >= FUNCTION_NODES))
                    size[node.index] += 1 if self.apart[child] else size[child]

    def _states(self, model: BoundModel | None) -> set[str]:
        return {label for label in model.reads if label in self._order} if model is not None else set()

    def _branch_reads(self, model: BoundModel | None, below: frozenset[str]) -> set[str] | frozenset[str]:
        return self._states(model) | (below - set(model.writes) if model is not None else below)


def is_open(group: TreeGroup) -> bool:
    """Whether the group is a choice that no choice further up has decided."""
    return group.group.kind == "choose" and all(branch.share is None for branch in group.branches)
