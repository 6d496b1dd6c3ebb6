"""What a plan leads to, node by node: probabilities, the slots' means and covariances, expected rewards."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, overload

import numpy as np

from symgraph.binding import REWARD, BoundModel
from symgraph.compile.interpreted import FlatFunction
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
        deviation: its standard deviation, with rewards on the way independent of each other [reward].
        cut: whether the path ends here because a node recurred too often.
    """

    path: str
    node: str
    probability: float
    states: dict[str, Gaussian]
    reward: float
    value: float
    deviation: float
    cut: bool


Moments = tuple[Array, Array | None]  # mean (n,), covariance (n²,) in column-major order or None: exact


class ModelNumbers:
    """Evaluates models in numbers, each with the function that its expression is made of."""

    def __init__(self) -> None:
        self._functions: dict[tuple[BoundModel, tuple[str, ...]], FlatFunction] = {}

    def __call__(self, model: BoundModel, here: Mapping[str, Moments]) -> dict[str, Moments]:
        """Return what a model writes; NaN where it fails."""
        uncertain = tuple(label for label in model.reads if here[label][1] is not None)
        if (model, uncertain) not in self._functions:
            self._functions[model, uncertain] = FlatFunction(model.function_for(uncertain))
        columns = [here[label][0] for label in model.reads]
        columns += [covariance for label in uncertain if (covariance := here[label][1]) is not None]
        results = self._functions[model, uncertain](
            [*columns, *(parameter.value.ravel(order="F") for parameter in model.parameters)]
        )
        n = len(model.writes)
        return {
            label: (results[i], results[n + i] if results[n + i].size else None) for i, label in enumerate(model.writes)
        }


def walk(tree: Tree, start: Mapping[str, Moments], selections: dict[str, str], models: ModelNumbers) -> NodeOutcomes:
    """Compute the outcomes of all nodes, from the root down; unselected branches too, which may be NaN without harm.

    Args:
        tree: the unrolled graph.
        start: {label: moments} of all actions, selections (one-hot) and given states.
        selections: {label: choice}.
        models: evaluates the models.
    """
    count = len(tree.nodes)
    dictionaries: list[Mapping[str, Moments]] = [start] * count
    rewards, variances, shares = np.zeros(count), np.zeros(count), np.ones(count)
    for node in tree.nodes:
        here = dictionaries[node.index]
        for group in node.groups:
            probability = group.group.probability
            chances = models(probability, here) if isinstance(probability, BoundModel) else {}
            for branch in group.branches:
                model = branch.branch.model
                written = models(model, here) if model is not None else {}
                if branch.child is None:
                    mean, variance = written[REWARD]
                    rewards[node.index] += mean[0]
                    variances[node.index] += 0.0 if variance is None else variance[0]
                    continue
                dictionaries[branch.child] = {**here, **written} if written else here
                if group.group.kind == "choose":
                    shares[branch.child] = float(branch.branch.label == selections[str(group.group.selection)])
                elif chances:
                    shares[branch.child] = chances[branch.branch.label][0][0]
                elif branch.share is not None:
                    shares[branch.child] = branch.share
    return NodeOutcomes(tree, dictionaries, rewards, variances, shares)


class NodeOutcomes(Sequence[NodeOutcome]):
    """The outcomes of all tree nodes in tree order; each is put together when it is looked at.

    Attributes:
        tree: whose nodes they are of.
        shares: (nodes,) probability of each node given its parent.
    """

    def __init__(
        self,
        tree: Tree,
        dictionaries: list[Mapping[str, Moments]],
        rewards: Array,
        variances: Array,
        shares: Array,
    ) -> None:
        self.tree = tree
        self.shares = shares
        self._dictionaries = dictionaries
        self._rewards = rewards
        self._reward_variances = variances

    def __len__(self) -> int:
        return len(self._dictionaries)

    @overload
    def __getitem__(self, index: int) -> NodeOutcome: ...
    @overload
    def __getitem__(self, index: slice) -> list[NodeOutcome]: ...
    def __getitem__(self, index: int | slice) -> NodeOutcome | list[NodeOutcome]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        node = self.tree.nodes[range(len(self))[index]]
        here = self._dictionaries[node.index]
        return NodeOutcome(
            path=self.tree.path(node.index),
            node=node.name,
            probability=float(self.probabilities[node.index]),
            states={label: _gaussian(here[label]) for label in self.tree.graph.states() if label in here},
            reward=float(self._rewards[node.index]),
            value=float(self._values[node.index]),
            deviation=float(np.sqrt(np.maximum(0.0, self._variances[node.index]))),
            cut=node.cut,
        )

    def __iter__(self) -> Iterator[NodeOutcome]:
        return (self[i] for i in range(len(self)))

    def __reduce__(self) -> tuple[Any, ...]:  # a tree holds the user's functions, which need not pickle
        return tuple, (list(self),)

    def __repr__(self) -> str:
        return f"<outcomes of {len(self)} nodes>"

    @cached_property
    def probabilities(self) -> Array:
        """(nodes,) probability of getting to each node."""
        reach = np.ones(len(self))
        for node in self.tree.nodes[1:]:
            before = reach[node.parent or 0]
            reach[node.index] = before * self.shares[node.index] if before else 0.0  # not 0 · NaN
        return reach

    def worth(self, risk: float) -> float:
        """Return the expected sum of rewards, less so many of its standard deviations."""
        deviation = np.sqrt(np.maximum(0.0, self._variances[0])) if risk else 0.0
        return float(self._values[0] - risk * deviation)

    @cached_property
    def _values(self) -> Array:
        values = np.zeros(len(self))
        with np.errstate(invalid="ignore", over="ignore"):  # rewards need not be finite
            for node in reversed(self.tree.nodes):
                values[node.index] += self.tree.cut_value if node.cut else self._rewards[node.index]
                if node.parent is not None and self.shares[node.index]:
                    values[node.parent] += self.shares[node.index] * values[node.index]
        return values

    @cached_property
    def _variances(self) -> Array:
        """(nodes,) of the sum of rewards from each node on: groups are independent, branches a mixture."""
        variances = np.zeros(len(self))
        for node in reversed(self.tree.nodes):
            variances[node.index] = 0.0 if node.cut else self._reward_variances[node.index]
            for group in node.groups:
                children = [b.child for b in group.branches if b.child is not None and self.shares[b.child]]
                shares, values = self.shares[children], self._values[children]
                with np.errstate(invalid="ignore", over="ignore"):  # values need not be finite
                    spread = variances[children] + (values - shares @ values) ** 2
                    variances[node.index] += shares @ spread
        return variances

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

    def notes(self) -> list[str]:
        """Say what makes the numbers less than they seem: probabilities that do not sum to 1, paths that are cut."""
        found = []
        kinds = {group.group.kind for node in self.tree.nodes for group in node.groups}
        if "reward" not in kinds and not any(node.cut for node in self.tree.nodes):
            found.append(
                "no reward is paid anywhere in the tree, so every plan is worth 0; add graph.reward(node, model)"
            )
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


def _gaussian(moments: Moments) -> Gaussian:
    mean, covariance = moments
    n = mean.size
    return unchecked_gaussian(mean, np.zeros((n, n)) if covariance is None else covariance.reshape(n, n, order="F"))
