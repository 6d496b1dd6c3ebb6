"""The structure of a tree: which subtrees are alike, which become functions of their own, and where visits repeat."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from symgraph.binding import BoundModel
from symgraph.slots import State
from symgraph.tree import Tree, TreeBranch, TreeGroup, TreeNode

# Tree nodes that one function holds; what is larger is cut into functions that call each other.
FUNCTION_NODES = 64
# From this size on, subtrees that are alike become one function, written and compiled once.
SHARED_NODES = 16
# From so many rounds on, a chain of equal ones is one function of a round, applied again and again.
CHAIN_ROUNDS = 32
LONGEST_ROUND = 8  # nodes


@dataclass(frozen=True)
class Chain:
    """Rounds through the same few graph nodes, which do the same each time.

    Attributes:
        rounds: how many there are.
        steps: of the first one: tree nodes, and by which group and branch of each it goes on.
        end: the tree node behind the last round.
    """

    rounds: int
    steps: tuple[tuple[int, int, int], ...]
    end: int


class Structure:
    """Which subtrees of a tree are alike, which become functions of their own, and what those read.

    Attributes:
        kinds: for each node, a number that nodes with equal subtrees share.
        apart: for each node, whether the branch that leads to it is a function of its own.
        chains: {node: the chain that begins there}.
    """

    def __init__(self, tree: Tree, chains: bool = True) -> None:
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
        rounds = _Chains(tree, self.kinds) if chains else None
        self.chains = {} if rounds is None else rounds.chains
        self._set_apart(tree, {} if rounds is None else rounds.onward)

    def reads(self, node: int) -> frozenset[str]:
        """Return the states that a subtree reads before writing them."""
        return self._kind_reads[self.kinds[node]]

    def needs(self, branch: TreeBranch) -> tuple[str, ...]:
        """Return the states that a branch reads before writing them, in the order of the slots."""
        key = branch.branch.model, self.kinds[branch.child or 0]
        if key not in self._needs:
            found = self._branch_reads(branch.branch.model, self._kind_reads[key[1]])
            self._needs[key] = tuple(sorted(found, key=self._order.__getitem__))
        return self._needs[key]

    def _set_apart(self, tree: Tree, onward: dict[int, tuple[int, int, bool]]) -> None:
        repeats = Counter(self.kinds)
        size = [1] * len(tree.nodes)  # of the part of a subtree that is not apart
        large = len(tree.nodes) > FUNCTION_NODES
        for node in reversed(tree.nodes):
            inside = onward.get(node.index)
            for g, group in enumerate(node.groups):
                for b, branch in enumerate(group.branches):
                    child = branch.child
                    if child is None:
                        continue
                    if inside is not None and inside[:2] == (g, b):
                        size[node.index] += size[child]
                        continue
                    alike = repeats[self.kinds[child]] > 1 and size[child] >= SHARED_NODES
                    self.apart[child] = is_open(group) or (large and (alike or size[child] >= FUNCTION_NODES))
                    size[node.index] += 1 if self.apart[child] else size[child]
            if inside is not None and not inside[2]:  # of all rounds only the first is written
                g, b, _ = inside
                size[node.index] = size[node.groups[g].branches[b].child or 0]
            elif node.index in self.chains:
                size[node.index] = max(size[node.index], SHARED_NODES)

    def _states(self, model: BoundModel | None) -> set[str]:
        return {label for label in model.reads if label in self._order} if model is not None else set()

    def _branch_reads(self, model: BoundModel | None, below: frozenset[str]) -> set[str] | frozenset[str]:
        return self._states(model) | (below - set(model.writes) if model is not None else below)


def is_open(group: TreeGroup) -> bool:
    """Whether the group is a choice that no choice further up has decided."""
    return group.group.kind == "choose" and all(branch.share is None for branch in group.branches)


class _Chains:
    """Finds chains: where the largest subtree leads, again and again, to nodes that do the same."""

    def __init__(self, tree: Tree, kinds: list[int]) -> None:
        self.chains: dict[int, Chain] = {}
        self.onward: dict[int, tuple[int, int, bool]] = {}  # inside a chain: group, branch, and if it is in round one
        self._next: dict[int, tuple[int, int, int]] = {}  # group, branch and child with the largest subtree
        self._does: dict[int, tuple[Any, ...]] = {}  # what a node does, but for where that leads
        below = [1] * len(tree.nodes)  # nodes of the subtree
        required = [bool(node.requirements) for node in tree.nodes]  # whether it holds a requirement
        for node in reversed(tree.nodes):
            children = [
                (below[branch.child], g, b, branch.child)
                for g, group in enumerate(node.groups)
                for b, branch in enumerate(group.branches)
                if branch.child is not None
            ]
            below[node.index] += sum(size for size, *_ in children)
            aside = [required[child] for *_, child in sorted(children)[:-1]]
            plain = not node.requirements and not any(aside) and not any(is_open(group) for group in node.groups)
            required[node.index] |= any(required[child] for *_, child in children)
            if children and plain:
                _, g, b, child = max(children)
                self._next[node.index] = g, b, child
                self._does[node.index] = (g, b, *_doings(node, kinds, child))
        for period in range(1, LONGEST_ROUND + 1):
            self._find(tree, period)

    def _find(self, tree: Tree, period: int) -> None:
        equal: dict[int, int] = {}  # how many nodes in a row do what the one a period later does
        for node in reversed(tree.nodes):
            later: int | None = node.index
            for _ in range(period):
                later = self._next[later][2] if later in self._next else None
            if later in self._does and self._does[later] == self._does.get(node.index):
                equal[node.index] = 1 + equal.get(self._next[node.index][2], 0)
        for node in tree.nodes:
            rounds = 1 + equal.get(node.index, 0) // period
            if rounds >= CHAIN_ROUNDS and node.index not in self.onward:
                path = [node.index]
                while len(path) <= rounds * period:
                    path.append(self._next[path[-1]][2])
                self._keep(path, period)

    def _keep(self, path: list[int], period: int) -> None:
        """Keep a chain of nodes, the last of which is its end, and what is left of it from each node on."""
        for k, index in enumerate(path[:-1]):
            rounds = (len(path) - 1 - k) // period
            if rounds >= CHAIN_ROUNDS or k == 0:
                steps = tuple((at, *self._next[at][:2]) for at in path[k : k + period])
                self.chains[index] = Chain(rounds, steps, path[k + rounds * period])
            if k < len(path) - 2:
                self.onward[index] = (*self._next[index][:2], k < period)


def _doings(node: TreeNode, kinds: list[int], following: int) -> Iterator[tuple[Any, ...]]:
    for group in node.groups:
        for branch in group.branches:
            below = "end" if branch.child is None else "on" if branch.child == following else kinds[branch.child]
            yield id(group.group), id(branch.branch), branch.share, below
