"""From tree to ONE symbolic expression: the expected sum of rewards as a function of actions, selections and states.

Node values follow equation (3) of the paper, J_k = Σ over groups Σ_b P_b · J_b, written down once over the whole tree;
the gradient is CasADi's derivative of that expression, so it contains equation (6) and how actions change variances.

A choice becomes a CasADi switch over one function per branch: only the selected branch is evaluated, in the value and
in every derivative. A product with a one-hot factor would evaluate them all, and 0 · NaN would poison the sum.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import accumulate

import casadi as ca

from symgraph.binding import REWARD, BoundModel
from symgraph.model import Parameter
from symgraph.slots import Gaussian
from symgraph.tree import Tree, TreeGroup

# Scalar instructions up to which an expression is flattened: flat code runs several times faster, but the C compiler's
# time grows faster than its length.
FLATTEN_LIMIT = 5_000

Dictionary = dict[str, Gaussian]  # the super-state-action dictionary of a node: label → Gaussian of MX


class Inputs:
    """The symbols that an objective depends on, and the dictionary they form at the root.

    Args:
        tree: the unrolled graph.
        uncertain: the start states that come with a covariance.
    """

    def __init__(self, tree: Tree, uncertain: frozenset[str]) -> None:
        graph = tree.graph
        states = {label: graph.slots[label].size for label in tree.needed_states}
        self.uncertain = tuple(label for label in states if label in uncertain)
        self.parameters: tuple[Parameter, ...] = tuple(
            {id(p): p for model in tree.models for p in model.parameters}.values()
        )
        actions = {label: slot.size for label, slot in graph.actions().items()}
        selections = {label: slot.size for label, slot in graph.selections().items()}
        self.actions, action_parts = _stacked("actions", actions.values())
        self.selections, selection_parts = _stacked("selections", selections.values())
        self.means, mean_parts = _stacked("means", states.values())
        squares = [states[label] ** 2 for label in self.uncertain]
        self.covariances, covariance_parts = _stacked("covariances", squares)
        self.root: Dictionary = {
            label: Gaussian(part)
            for label, part in zip([*actions, *selections], action_parts + selection_parts, strict=True)
        }
        spread = {
            label: ca.reshape(part, states[label], states[label])
            for label, part in zip(self.uncertain, covariance_parts, strict=True)
        }
        self.root.update(
            {label: Gaussian(part, spread.get(label)) for label, part in zip(states, mean_parts, strict=True)}
        )

    @property
    def symbols(self) -> list[ca.MX]:
        fixed = [self.actions, self.selections, self.means, self.covariances]
        return fixed + [parameter.symbol for parameter in self.parameters]


def _stacked(name: str, sizes: Iterable[int]) -> tuple[ca.MX, list[ca.MX]]:
    offsets = list(accumulate(sizes, initial=0))
    column = ca.MX.sym(name, offsets[-1])
    return column, ca.vertsplit(column, offsets) if len(offsets) > 1 else []


@dataclass(frozen=True)
class Expectation:
    """The expected sum of rewards J as an expression of the inputs."""

    inputs: Inputs
    value: ca.MX  # (1, 1)
    flat: bool  # small enough for scalar code

    def value_and_gradient(self) -> ca.Function:
        """Return the function inputs → J (1, 1), ∂J/∂actions (n, 1)."""
        if not self.flat:
            gradient = ca.gradient(self.value, self.inputs.actions)
            return ca.Function("objective", self.inputs.symbols, [self.value, gradient], {"cse": True})
        flat = ca.Function("J", self.inputs.symbols, [self.value]).expand()
        symbols = flat.sx_in()
        value = flat.call(symbols)[0]
        results = ca.cse([value, ca.gradient(value, symbols[0])])
        return ca.Function("objective", symbols, [ca.densify(r) for r in results])

    def hessian(self) -> ca.Function:
        """Return the function inputs → ∂²J/∂actions² (n, n)."""
        return ca.Function("hessian", self.inputs.symbols, [ca.densify(ca.hessian(self.value, self.inputs.actions)[0])])


def expected_value(tree: Tree, uncertain: frozenset[str]) -> Expectation:
    """Write down the expected sum of rewards of a tree.

    Args:
        tree: the unrolled graph.
        uncertain: the start states that come with a covariance; for the others no covariance enters the expression.

    Source: Yamaguchi & Atkeson, Humanoids 2016, equations (1)–(4).
    """
    return _Writer(tree, Inputs(tree, uncertain)).run()


class _Writer:
    """Writes the expression: dictionaries from the root to the leaves, values from the leaves to the root."""

    def __init__(self, tree: Tree, inputs: Inputs) -> None:
        self._tree = tree
        self._inputs = inputs
        self._dictionaries: dict[int, Dictionary] = {0: inputs.root}
        # What each branch is worth before its child's value is known, by (node, group, branch).
        self._probabilities: dict[tuple[int, int, int], ca.MX | float] = {}
        self._rewards: dict[tuple[int, int], ca.MX] = {}
        # At a choice the dictionary is handed into functions: local symbols and the expressions they stand for.
        self._handed: dict[tuple[int, int], tuple[list[ca.MX], list[ca.MX]]] = {}
        self._instructions = [0.0] * len(tree.nodes)

    def run(self) -> Expectation:
        for node in self._tree.nodes:
            here = self._dictionaries.pop(node.index)
            for g, tree_group in enumerate(node.groups):
                self._forward(node.index, g, tree_group, here)
        values: dict[int, ca.MX] = {}
        for node in reversed(self._tree.nodes):
            value = ca.MX(self._tree.cut_value if node.cut else 0.0)
            for g, tree_group in enumerate(node.groups):
                value = value + self._backward(node.index, g, tree_group, values)
            values[node.index] = value
        return Expectation(self._inputs, ca.densify(values[0]), self._instructions[0] <= FLATTEN_LIMIT)

    def _forward(self, node: int, g: int, tree_group: TreeGroup, here: Dictionary) -> None:
        if is_open(tree_group):
            here = self._hand_over(node, g, here)
        model = tree_group.group.probability
        shares = self._apply(node, model, here) if isinstance(model, BoundModel) else {}
        for b, tree_branch in enumerate(tree_group.branches):
            label = tree_branch.branch.label
            share = shares[label].mean if label in shares else tree_branch.share
            self._probabilities[node, g, b] = 1.0 if share is None else share
            model = tree_branch.branch.model
            # A branch's model counts to the child: where the group is a choice, both go into one function.
            owner = node if tree_branch.child is None else tree_branch.child
            written = self._apply(owner, model, here) if model is not None else {}
            if tree_branch.child is None:
                self._rewards[node, g] = written[REWARD].mean
            else:
                self._dictionaries[tree_branch.child] = {**here, **written}

    def _apply(self, node: int, model: BoundModel, here: Dictionary) -> Dictionary:
        function, _ = model.moments(here)
        self._instructions[node] += function.n_instructions() if function.is_a("SXFunction") else math.inf
        return model.apply(here)

    def _hand_over(self, node: int, g: int, here: Dictionary) -> Dictionary:
        """Put symbols in the place of all that was computed since the root."""
        local: Dictionary = {}
        symbols, expressions = [], []
        for label, gaussian in here.items():
            if gaussian is self._inputs.root.get(label):
                local[label] = gaussian
                continue
            mean = ca.MX.sym("mean", gaussian.mean.numel())
            covariance = ca.MX.sym("covariance", gaussian.covariance.sparsity())
            local[label] = Gaussian(mean, covariance)
            symbols += [mean, covariance]
            expressions += [gaussian.mean, gaussian.covariance]
        self._handed[node, g] = symbols, expressions
        return local

    def _backward(self, node: int, g: int, tree_group: TreeGroup, values: dict[int, ca.MX]) -> ca.MX:
        if is_open(tree_group):
            return self._switch(node, g, tree_group, values)
        total = ca.MX(0.0)
        for b, tree_branch in enumerate(tree_group.branches):
            if tree_branch.child is None:
                total = total + self._rewards[node, g]
            else:
                self._instructions[node] += self._instructions[tree_branch.child] + 2
                share = self._probabilities[node, g, b]
                value = values.pop(tree_branch.child)
                total = total + (value if isinstance(share, float) and share == 1.0 else share * value)
        return total

    def _switch(self, node: int, g: int, tree_group: TreeGroup, values: dict[int, ca.MX]) -> ca.MX:
        children = [branch.child for branch in tree_group.branches if branch.child is not None]
        branch_values = [values.pop(child) for child in children]
        used = ca.symvar(ca.vertcat(*branch_values))
        cases = []
        for child, value in zip(children, branch_values, strict=True):
            case = ca.Function(f"case_{node}_{g}_{child}", used, [ca.densify(value)], {"cse": True})
            if self._instructions[child] <= FLATTEN_LIMIT:
                case = case.expand()
            cases.append(case)
        self._instructions[node] = math.inf
        locals_, expressions = self._handed.pop((node, g))
        stand_for = {symbol.__hash__(): expression for symbol, expression in zip(locals_, expressions, strict=True)}
        arguments = [stand_for.get(symbol.__hash__(), symbol) for symbol in used]
        selection = self._inputs.root[str(tree_group.group.selection)].mean
        index = ca.dot(selection, ca.DM(range(selection.numel())))
        order = {branch.branch.label: case for branch, case in zip(tree_group.branches, cases, strict=True)}
        choices = self._tree.graph.selections()[str(tree_group.group.selection)].choices
        if len(choices) == 1:
            return cases[0].call(arguments)[0]
        switch = ca.Function.conditional(f"choice_{node}_{g}", [order[c] for c in choices[:-1]], order[choices[-1]])
        return switch.call([index, *arguments])[0]


def is_open(tree_group: TreeGroup) -> bool:
    """Whether the group is a choice that no choice further up has decided."""
    return tree_group.group.kind == "choose" and all(branch.share is None for branch in tree_group.branches)
