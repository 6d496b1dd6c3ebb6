"""What a plan leads to, node by node, as one symbolic function: what symgraph/outcomes.py computes in numbers."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate

import casadi as ca

from symgraph.binding import REWARD, BoundModel
from symgraph.expectation import Inputs
from symgraph.slots import Gaussian
from symgraph.tree import Tree
from symgraph.worth import Dictionary


@dataclass(frozen=True)
class Write:
    """Where the moments of a state begin that is known from a node on.

    Attributes:
        node: index of the tree node.
        label: of the state.
        mean: where its mean begins among all moments.
        covariance: where its covariance begins, in column-major order; -1 where it is exact.
    """

    node: int
    label: str
    mean: int
    covariance: int


def foresight(tree: Tree, inputs: Inputs) -> tuple[ca.Function, tuple[Write, ...]]:
    """Write down the outcomes of all nodes.

    Returns:
        the function inputs → (nodes,) probability of each node given its parent, (nodes,) expected reward paid there,
        (nodes,) its variance, moments of all states; and where these stand, by node.
    """
    count = len(tree.nodes)
    dictionaries: list[Dictionary] = [inputs.root] * count
    shares, rewards, variances = ([ca.MX(number)] * count for number in (1.0, 0.0, 0.0))
    given = {label: inputs.root[label] for label in tree.needed_states}
    written: list[Dictionary] = [given, *({} for _ in range(count - 1))]
    for node in tree.nodes:
        here = dictionaries[node.index]
        for group in node.groups:
            probability = group.group.probability
            chances = probability.apply(here) if isinstance(probability, BoundModel) else {}
            for branch in group.branches:
                model = branch.branch.model
                made = model.apply(here) if model is not None else {}
                if branch.child is None:
                    rewards[node.index] += made[REWARD].mean
                    if made[REWARD].covariance.nnz():
                        variances[node.index] += made[REWARD].covariance
                    continue
                written[branch.child] = made
                dictionaries[branch.child] = {**here, **made} if made else here
                if group.group.kind == "choose":
                    selection = str(group.group.selection)
                    choice = tree.graph.selections()[selection].choices.index(branch.branch.label)
                    shares[branch.child] = inputs.root[selection].mean[choice]
                elif chances:
                    shares[branch.child] = chances[branch.branch.label].mean
                elif branch.share is not None:
                    shares[branch.child] = ca.MX(branch.share)
    moments = [part for made in written for gaussian in made.values() for part in _parts(gaussian)]
    results = [ca.densify(ca.vertcat(*column)) for column in (shares, rewards, variances, [ca.MX(0, 1), *moments])]
    function = ca.Function("outcomes", inputs.symbols, results, {"cse": True})
    return function, tuple(_places(written))


def _parts(gaussian: Gaussian) -> list[ca.MX]:
    mean, covariance = ca.MX(gaussian.mean), ca.MX(gaussian.covariance)
    return [ca.densify(mean), *([ca.densify(ca.vec(covariance))] if covariance.nnz() else [])]


def _places(written: list[Dictionary]) -> list[Write]:
    labels = [(node, label, gaussian) for node, made in enumerate(written) for label, gaussian in made.items()]
    sizes = [sum(part.numel() for part in _parts(gaussian)) for _, _, gaussian in labels]
    begins = accumulate(sizes, initial=0)
    found = []
    for (node, label, gaussian), begin in zip(labels, begins, strict=False):
        parts = _parts(gaussian)
        found.append(Write(node, label, begin, begin + parts[0].numel() if len(parts) > 1 else -1))
    return found
