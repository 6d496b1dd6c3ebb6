"""What a plan leads to, node by node: probabilities, the slots' means and covariances, expected rewards."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from symgraph.binding import REWARD, BoundModel
from symgraph.compile.interpreted import FlatFunction
from symgraph.expectation import Dictionary, Inputs
from symgraph.slots import Array, Gaussian, unchecked_gaussian
from symgraph.tree import Tree


@dataclass(frozen=True, eq=False)
class NodeOutcome:
    """The expected outcome at one visit of a node.

    Attributes:
        path: the way from the root, e.g. "aim/landed[lower]".
        node: the graph node.
        probability: of getting here under the plan; 0 for what is not selected.
        states: {label: Gaussian} of the states known here [unit].
        reward: expected reward paid here, given that one gets here [reward].
        value: expected sum of the rewards from here on, given that one gets here [reward].
        cut: whether the path ends here because a node recurred too often.
    """

    path: str
    node: str
    probability: float
    states: dict[str, Gaussian]
    reward: float
    value: float
    cut: bool


@dataclass(frozen=True)
class _Layout:
    """Where in the flat vector of outcomes things stand, per tree node."""

    states: dict[str, tuple[int, int, int]]  # label → offset of the mean, of the covariance (-1: exact), size
    rewards: tuple[int, ...]
    shares: dict[int, int]  # child → offset of its branch's probability, where a model computes it


class Outcomes:
    """Computes the outcomes of all nodes of a tree; unselected branches too, which may be NaN without harm.

    Args:
        tree: the unrolled graph.
        uncertain: the start states that come with a covariance.
    """

    def __init__(self, tree: Tree, uncertain: frozenset[str]) -> None:
        self.tree = tree
        inputs = Inputs(tree, uncertain)
        self._layouts: list[_Layout] = []
        pieces: list[ca.MX] = []
        length = 0

        def put(piece: ca.MX) -> int:
            nonlocal length
            pieces.append(ca.densify(ca.vec(piece)))
            length += piece.numel()
            return length - piece.numel()

        waiting: dict[int, tuple[Dictionary, dict[str, tuple[int, int, int]]]] = {}
        states = {label: g for label, g in inputs.root.items() if label in tree.graph.states()}
        waiting[0] = inputs.root, {label: self._state(g, put) for label, g in states.items()}
        for node in tree.nodes:
            here, layout = waiting.pop(node.index)
            rewards, shares = [], {}
            for tree_group in node.groups:
                model = tree_group.group.probability
                chances = model.apply(here) if isinstance(model, BoundModel) else {}
                for tree_branch in tree_group.branches:
                    model = tree_branch.branch.model
                    written = model.apply(here) if model is not None else {}
                    if tree_branch.child is None:
                        rewards.append(put(written[REWARD].mean))
                        continue
                    if chances:
                        shares[tree_branch.child] = put(chances[tree_branch.branch.label].mean)
                    new = {label: self._state(g, put) for label, g in written.items()}
                    waiting[tree_branch.child] = {**here, **written}, {**layout, **new}
            self._layouts.append(_Layout(layout, tuple(rewards), shares))
        self._function = FlatFunction(ca.Function("outcomes", inputs.symbols, [ca.vertcat(*pieces)]))
        # Which start states the expression does not know: given, but written before they are read, or never read.
        self._root_states = frozenset(states)

    @staticmethod
    def _state(gaussian: Gaussian, put: object) -> tuple[int, int, int]:
        exact = gaussian.covariance.nnz() == 0
        return put(gaussian.mean), -1 if exact else put(gaussian.covariance), gaussian.mean.numel()  # type: ignore[operator]

    def __call__(
        self, columns: Sequence[Array], selections: Mapping[str, str], given: Mapping[str, Gaussian]
    ) -> NodeOutcomes:
        """Evaluate the outcomes.

        Args:
            columns: the objective's inputs in their order, each flat.
            selections: {label: choice}.
            given: all start states, those too that nothing reads.
        """
        flat = self._function(columns)[0]
        extra = {label: gaussian for label, gaussian in given.items() if label not in self._root_states}
        return NodeOutcomes(self.tree, tuple(self._layouts), flat, dict(selections), extra)


class NodeOutcomes(Sequence[NodeOutcome]):
    """The outcomes of all tree nodes in tree order; each is put together when it is looked at."""

    def __init__(
        self,
        tree: Tree,
        layouts: tuple[_Layout, ...],
        flat: Array,
        selections: dict[str, str],
        extra: dict[str, Gaussian],
    ) -> None:
        self.tree = tree
        self._layouts = layouts
        self._flat = flat
        self._selections = selections
        self._extra = extra

    def __len__(self) -> int:
        return len(self._layouts)

    def __getitem__(self, index):  # type: ignore[no-untyped-def]  # as in Sequence: int → outcome, slice → list
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        node = self.tree.nodes[range(len(self))[index]]
        layout = self._layouts[node.index]
        states = {**self._extra, **{label: self._gaussian(*where) for label, where in layout.states.items()}}
        order = self.tree.graph.states()
        return NodeOutcome(
            path=self.tree.path(node.index),
            node=node.name,
            probability=float(self.probabilities[node.index]),
            states={label: states[label] for label in order if label in states},
            reward=self._reward(node.index),
            value=float(self._values[node.index]),
            cut=node.cut,
        )

    def __iter__(self) -> Iterator[NodeOutcome]:
        return (self[i] for i in range(len(self)))

    def __reduce__(self) -> tuple[Any, ...]:  # a tree holds the user's functions, which need not pickle
        return tuple, (list(self),)

    def __repr__(self) -> str:
        return f"<outcomes of {len(self)} nodes>"

    @cached_property
    def shares(self) -> Array:
        """(nodes,) probability of each node given its parent."""
        shares = np.ones(len(self))
        for node in self.tree.nodes:
            for tree_group in node.groups:
                for branch in tree_group.branches:
                    if branch.child is None:
                        continue
                    if tree_group.group.kind == "choose":
                        chosen = self._selections[str(tree_group.group.selection)]
                        shares[branch.child] = float(branch.branch.label == chosen)
                    elif branch.child in self._layouts[node.index].shares:
                        shares[branch.child] = self._flat[self._layouts[node.index].shares[branch.child]]
                    elif branch.share is not None:
                        shares[branch.child] = branch.share
        return shares

    @cached_property
    def probabilities(self) -> Array:
        """(nodes,) probability of getting to each node."""
        reach = np.ones(len(self))
        for node in self.tree.nodes[1:]:
            before = reach[node.parent or 0]
            reach[node.index] = before * self.shares[node.index] if before else 0.0  # not 0 · NaN
        return reach

    @cached_property
    def _values(self) -> Array:
        values = np.zeros(len(self))
        for node in reversed(self.tree.nodes):
            values[node.index] += self.tree.cut_value if node.cut else self._reward(node.index)
            if node.parent is not None and self.shares[node.index]:
                values[node.parent] += self.shares[node.index] * values[node.index]
        return values

    @property
    def _cut_probability(self) -> float:
        """Probability that some path is cut: branches of a group exclude each other, groups are independent."""
        cut = np.zeros(len(self))
        for node in reversed(self.tree.nodes):
            escape = 1.0 - float(node.cut)
            for tree_group in node.groups:
                children = [b.child for b in tree_group.branches if b.child is not None and self.shares[b.child]]
                escape *= 1.0 - sum(self.shares[child] * cut[child] for child in children)
            cut[node.index] = 1.0 - escape
        return float(cut[0])

    def _reward(self, index: int) -> float:
        return float(sum(self._flat[offset] for offset in self._layouts[index].rewards))

    def _gaussian(self, mean: int, covariance: int, n: int) -> Gaussian:
        m = self._flat[mean : mean + n]
        s = np.zeros((n, n)) if covariance < 0 else self._flat[covariance : covariance + n * n].reshape(n, n, order="F")
        return unchecked_gaussian(m, s)

    def notes(self) -> list[str]:
        """Say what makes the numbers less than they seem: probabilities that do not sum to 1, paths that are cut."""
        found = []
        for node in self.tree.nodes:
            if not self.probabilities[node.index]:
                continue
            for tree_group in node.groups:
                if isinstance(tree_group.group.probability, BoundModel):
                    for branch in tree_group.branches:
                        share = self.shares[branch.child or 0]
                        if not -1e-6 <= share <= 1.0 + 1e-6:
                            name = branch.branch.label
                            where = self.tree.path(node.index)
                            found.append(f"the probability of {name!r} at {where!r} is {share:.3g}, outside [0, 1]")
                    total = sum(self.shares[b.child] for b in tree_group.branches if b.child is not None)
                    if not abs(total - 1.0) <= 1e-6:
                        found.append(
                            f"the probabilities at {self.tree.path(node.index)!r} sum to {total:.6g}, not to 1"
                        )
        cut = self._cut_probability
        if cut:
            found.append(
                f"a node recurs more than {self.tree.max_visits} times with probability {cut:.3g}; such a path counts "
                f"as {self.tree.cut_value:g} from there (unroll with more max_visits, or another cut_value)"
            )
        return found
