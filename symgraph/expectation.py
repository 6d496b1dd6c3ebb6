"""From tree to ONE symbolic expression: the expected sum of rewards as a function of actions, selections and states.

Node values follow equation (3) of the paper, J_k = Σ over groups Σ_b P_b · J_b, written down once over the whole tree;
the gradient is CasADi's derivative of that expression, so it contains equation (6) and how actions change variances.

A choice becomes a CasADi switch over one function per branch: only the selected branch is evaluated, in the value and
in every derivative. A product with a one-hot factor would evaluate them all, and 0 · NaN would poison the sum.

Large trees are cut into such functions too. Subtrees of the same structure share one, so that a tree's code grows with
the number of its different subtrees.

The margins of requirements are written down on the way, from the leaves to the root like the values, but no probability
weighs them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import casadi as ca

from symgraph.binding import REQUIREMENT, REWARD, BoundModel
from symgraph.constraints import Constraint, constraints_of, merit
from symgraph.folding import Folder, Unsteady
from symgraph.model import Parameter
from symgraph.requirement import deviation
from symgraph.slots import Gaussian, State
from symgraph.structure import Structure, is_open
from symgraph.tree import Tree, TreeBranch, TreeGroup
from symgraph.worth import FLATTEN_LIMIT, Dictionary, Worth, applied, mixed, probability_of


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
    """The expected sum of rewards J, and the margins of requirements, as expressions of the inputs.

    Attributes:
        inputs: what they depend on.
        value: J (1, 1).
        margins: (k, 1), a row for each of the constraints; `unused` where it does not count.
        constraints: k of them.
        flat: whether it is small enough for scalar code.
    """

    inputs: Inputs
    value: ca.MX
    margins: ca.MX
    constraints: tuple[Constraint, ...]
    flat: bool

    def value_function(self) -> ca.Function:
        """Return the function inputs → J (1, 1)."""
        return ca.Function("objective", self.inputs.symbols, [self.value], {"cse": True})

    def value_and_gradient(self) -> ca.Function:
        """Return the function inputs → J (1, 1), ∂J/∂actions (n, 1)."""
        return self._with_gradient(self.value_function())

    def merit_function(self) -> ca.Function:
        """Return the function inputs, λ (k, 1), w (k, 1) → J - Σ penalties; see `merit`."""
        multipliers, weights = (ca.MX.sym(name, len(self.constraints)) for name in ("multipliers", "weights"))
        penalised = merit(self.value, self.margins, multipliers, weights, self.constraints)
        return ca.Function("merit", [*self.inputs.symbols, multipliers, weights], [penalised], {"cse": True})

    def merit_and_gradient(self) -> ca.Function:
        """Return the same with its gradient (n, 1)."""
        return self._with_gradient(self.merit_function())

    def margins_function(self) -> ca.Function:
        """Return the function inputs → margins (k, 1)."""
        return ca.Function("margins", self.inputs.symbols, [ca.densify(self.margins)])

    def _with_gradient(self, function: ca.Function) -> ca.Function:
        symbols = function.mx_in()
        if not self.flat:
            (value,) = function.call(symbols, True, False)
            return ca.Function("objective", symbols, [value, ca.gradient(value, symbols[0])], {"cse": True})
        flat = function.expand()
        scalars = flat.sx_in()
        expanded = flat.call(scalars)[0]
        results = ca.cse([expanded, ca.gradient(expanded, scalars[0])])
        return ca.Function("objective", scalars, [ca.densify(r) for r in results])

    def hessian(self) -> ca.Function:
        """Return the function inputs → ∂²J/∂actions² (n, n)."""
        return ca.Function("hessian", self.inputs.symbols, [ca.densify(ca.hessian(self.value, self.inputs.actions)[0])])


def expected_value(tree: Tree, uncertain: frozenset[str], relaxed: bool = False, risk: float = 0.0) -> Expectation:
    """Write down the expected sum of rewards of a tree.

    Args:
        tree: the unrolled graph.
        uncertain: the start states that come with a covariance; for the others no covariance enters the expression.
        relaxed: selections may be anything between their choices: a branch's value and margins are weighed with its
            element of the one-hot column, as if it were a probability, so that derivatives by selections exist.
        risk: how many standard deviations of the sum of rewards are taken from its mean. Rewards on the way through the
            tree count as independent of each other, as slots do.

    Source: Yamaguchi & Atkeson, Humanoids 2016, equations (1)–(4).
    """
    inputs = Inputs(tree, uncertain)
    try:
        return _Writer(tree, inputs, relaxed, risk, chains=not risk).run()  # a variance is no sum over rounds
    except Unsteady:
        return _Writer(tree, inputs, relaxed, risk, chains=False).run()


class _Writer:
    """Writes the expression: dictionaries from the root to the leaves, values from the leaves to the root."""

    def __init__(self, tree: Tree, inputs: Inputs, relaxed: bool, risk: float, chains: bool) -> None:
        self.tree = tree
        self.inputs = inputs
        self.root = inputs.root
        self.relaxed = relaxed
        self.risk = risk
        self.structure = Structure(tree, chains)
        self._functions: dict[tuple[Any, ...], ca.Function] = {}
        self._folder = Folder(self, self.structure)

    def run(self) -> Expectation:
        # Functions are written before those that call them: leaves first. For that, a first pass finds what is
        # uncertain where, without any calculus.
        uncertain = self._uncertain_labels()
        for node in reversed(self.tree.nodes):
            for group in node.groups:
                for branch in group.branches:
                    if branch.child is not None and self.structure.apart[branch.child]:
                        self._write_function(branch, uncertain[node.index])
        worth, instructions = self.worth(0, self.inputs.root)
        value = worth.value
        if self.risk:
            value = value - self.risk * deviation(worth.variance)
        margins = ca.vertcat(*worth.margins) if worth.margins else ca.MX(0, 1)
        constraints = constraints_of(self.tree)
        return Expectation(self.inputs, ca.densify(value), margins, constraints, instructions <= FLATTEN_LIMIT)

    def _uncertain_labels(self) -> list[frozenset[str]]:
        found = [frozenset[str]()] * len(self.tree.nodes)
        found[0] = frozenset(self.inputs.uncertain)
        for node in self.tree.nodes:
            here = found[node.index]
            for group in node.groups:
                for branch in group.branches:
                    model = branch.branch.model
                    if branch.child is not None:
                        found[branch.child] = here if model is None else (here - set(model.writes)) | model.spread(here)
        return found

    def _write_function(self, branch: TreeBranch, uncertain: frozenset[str]) -> None:
        """Write the value of a branch as a function of the dictionary at its source."""
        key = self._key(branch, uncertain)
        if key in self._functions:
            return
        slots = self.tree.graph.slots
        here = {label: g for label, g in self.inputs.root.items() if not isinstance(slots[label], State)}
        symbols: list[ca.MX] = []
        for label in self.structure.needs(branch):
            n = slots[label].size
            mean = ca.MX.sym(label, n)
            covariance = ca.MX.sym(label, n, n) if label in uncertain else None
            here[label] = Gaussian(mean, covariance)
            symbols += [mean] if covariance is None else [mean, covariance]
        written, own = applied(branch.branch.model, here)
        worth, instructions = self.worth(branch.child or 0, {**here, **written})
        results = self._results(worth)
        name = f"branch_{len(self._functions)}"
        inputs = symbols + self.shared_symbols
        # Nobody asks for derivatives by selections and weights, and the reverse sweep would compute them.
        by = 2 if self.relaxed else 1
        follows = [True] * (len(symbols) + by) + [False] * (len(self.shared_symbols) - by)
        function = ca.Function(name, inputs, results, {"cse": True, "is_diff_in": follows})
        if own + instructions <= FLATTEN_LIMIT:
            function = function.expand()
        self._functions[key] = function

    def call(self, branch: TreeBranch, here: Dictionary) -> tuple[ca.Function, list[ca.MX]]:
        """Return the function of a branch that stands apart, and the arguments it takes here."""
        uncertain = frozenset(label for label, g in here.items() if g.covariance.nnz())
        arguments: list[ca.MX] = []
        for label in self.structure.needs(branch):
            arguments.append(here[label].mean)
            if label in uncertain:
                arguments.append(here[label].covariance)
        return self._functions[self._key(branch, uncertain)], arguments + self.shared_symbols

    def _key(self, branch: TreeBranch, uncertain: frozenset[str]) -> tuple[Any, ...]:
        kind = self.structure.kinds[branch.child or 0]
        return branch.branch.model, kind, uncertain.intersection(self.structure.needs(branch))

    @property
    def shared_symbols(self) -> list[ca.MX]:
        inputs = self.inputs
        return [inputs.actions, inputs.selections, *(parameter.symbol for parameter in inputs.parameters)]

    def worth(self, root: int, dictionary: Dictionary) -> tuple[Worth, float]:
        """Write what a subtree is worth, up to the branches that stand apart; also count scalar instructions."""
        instructions = 0.0
        dictionaries = {root: dictionary}
        order = [root]  # grows while it is walked
        groups: dict[int, list[list[tuple[ca.MX | float, Worth | int]]]] = {}  # node → (probability, worth or child)
        margins: dict[int, list[ca.MX]] = {}
        for index in order:
            here = dictionaries.pop(index)
            groups[index], margins[index] = [], []
            chain = self._folder.chain_from(index, here)
            if chain is not None:
                instructions = math.inf
                reach, gained, dictionaries[chain.end] = self._folder.fold(index, chain, here)
                order.append(chain.end)
                groups[index] = [[(1.0, Worth(gained, ca.MX(0.0), []))], [(reach, chain.end)]]
                continue
            for requirement in self.tree.nodes[index].requirements:
                outcome, count = applied(requirement.model, here)
                instructions += count
                margins[index] += requirement.margins(outcome[REQUIREMENT])
            for group in self.tree.nodes[index].groups:
                terms: list[tuple[ca.MX | float, Worth | int]] = []
                groups[index].append(terms)
                if is_open(group):
                    instructions = math.inf
                    terms.append((1.0, (self._blend if self.relaxed else self._switch)(group, here)))
                    continue
                model = group.group.probability
                shares, count = applied(model if isinstance(model, BoundModel) else None, here)
                instructions += count
                for branch in group.branches:
                    probability = probability_of(branch, shares)
                    if branch.child is not None and self.structure.apart[branch.child]:
                        instructions = math.inf
                        function, arguments = self.call(branch, here)
                        terms.append((probability, self.worth_of(function.call(arguments))))
                        continue
                    written, count = applied(branch.branch.model, here)
                    instructions += count + 2
                    if branch.child is None:
                        reward = written[REWARD]
                        terms.append((probability, Worth(reward.mean, ca.densify(reward.covariance), [])))
                    else:
                        dictionaries[branch.child] = {**here, **written}
                        order.append(branch.child)
                        terms.append((probability, branch.child))
        worths: dict[int, Worth] = {}
        for index in reversed(order):
            total = Worth(ca.MX(self.tree.cut_value if self.tree.nodes[index].cut else 0.0), ca.MX(0.0), [])
            total.margins += margins[index]
            for terms in groups[index]:
                parts = [(p, worths.pop(term) if isinstance(term, int) else term) for p, term in terms]
                total.add(mixed(parts, bool(self.risk)))
            worths[index] = total
        return worths[root], instructions

    def _results(self, worth: Worth) -> list[ca.MX]:
        """Return what a function of a branch hands on: value, variance if it is asked for, margins if there are any."""
        variance = [ca.densify(worth.variance)] if self.risk else []
        margins = [ca.densify(ca.vertcat(*worth.margins))] if worth.margins else []
        return [ca.densify(worth.value), *variance, *margins]

    def worth_of(self, results: list[ca.MX]) -> Worth:
        """Read what `_results` returned."""
        value, *rest = results
        return Worth(value, rest.pop(0) if self.risk else ca.MX(0.0), rest)

    def _blend(self, group: TreeGroup, here: Dictionary) -> Worth:
        """Write a choice whose selection may be anything between its choices."""
        shares = ca.vertsplit(self.inputs.root[str(group.group.selection)].mean)
        terms = []
        for share, branch in zip(shares, group.branches, strict=True):
            function, arguments = self.call(branch, here)
            worth = self.worth_of(function.call(arguments))
            worth.margins = [share * margin for margin in worth.margins]
            terms.append((share, worth))
        return mixed(terms, bool(self.risk))

    def _switch(self, group: TreeGroup, here: Dictionary) -> Worth:
        """Write a choice: the function of the selected branch, the others not evaluated."""
        slot = self.tree.graph.selections()[str(group.group.selection)]
        calls = [self.call(branch, here) for branch in group.branches]  # in the order of the slot's choices
        if len(calls) == 1:
            return self.worth_of(calls[0][0].call(calls[0][1]))
        # All cases of a switch take the same arguments: those that any of them needs. And all return the margins of all
        # branches, in which those of the others do not count.
        arguments = {argument.__hash__(): argument for _, given in calls for argument in given}
        symbols = {key: ca.MX.sym("x", argument.sparsity()) for key, argument in arguments.items()}
        unused = [[one.unused for one in constraints_of(self.tree, branch.child or 0)] for branch in group.branches]
        cases = []
        for i, (function, given) in enumerate(calls):
            worth = self.worth_of(function.call([symbols[argument.__hash__()] for argument in given]))
            before, after = ([ca.MX(ca.DM(part)) for part in parts] for parts in (unused[:i], unused[i + 1 :]))
            worth.margins = [*before, *worth.margins, *after] if any(unused) else []
            cases.append(ca.Function(f"case_{function.name()}", [*symbols.values()], self._results(worth)))
        selection = self.inputs.root[str(group.group.selection)].mean
        index = ca.dot(selection, ca.DM(range(slot.size)))
        switch = ca.Function.conditional("choice", cases[:-1], cases[-1])
        return self.worth_of(switch.call([index, *arguments.values()]))
