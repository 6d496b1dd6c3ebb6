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
from symgraph.model import Parameter
from symgraph.requirement import deviation
from symgraph.slots import Gaussian, State
from symgraph.structure import Chain, Structure, is_open
from symgraph.tree import Tree, TreeBranch, TreeGroup

# Scalar instructions up to which an expression is flattened: flat code runs several times faster, but the C compiler's
# time grows faster than its length.
FLATTEN_LIMIT = 5_000

MOST_REFUSED = 64  # rounds written out one by one until what is uncertain is the same after each

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
    except _Unsteady:
        return _Writer(tree, inputs, relaxed, risk, chains=False).run()


class _Unsteady(Exception):
    """What is uncertain goes on changing from round to round, so that chains cannot be folded."""


class _Writer:
    """Writes the expression: dictionaries from the root to the leaves, values from the leaves to the root."""

    def __init__(self, tree: Tree, inputs: Inputs, relaxed: bool, risk: float, chains: bool) -> None:
        self._tree = tree
        self._inputs = inputs
        self._relaxed = relaxed
        self._risk = risk
        self._structure = Structure(tree, chains)
        self._functions: dict[tuple[Any, ...], ca.Function] = {}
        self._refused = 0  # chains in which one round leaves other labels uncertain than the one before

    def run(self) -> Expectation:
        # Functions are written before those that call them: leaves first. For that, a first pass finds what is
        # uncertain where, without any calculus.
        uncertain = self._uncertain_labels()
        for node in reversed(self._tree.nodes):
            for group in node.groups:
                for branch in group.branches:
                    if branch.child is not None and self._structure.apart[branch.child]:
                        self._write_function(branch, uncertain[node.index])
        worth, instructions = self._worth(0, self._inputs.root)
        value = worth.value
        if self._risk:
            value = value - self._risk * deviation(worth.variance)
        margins = ca.vertcat(*worth.margins) if worth.margins else ca.MX(0, 1)
        constraints = constraints_of(self._tree)
        return Expectation(self._inputs, ca.densify(value), margins, constraints, instructions <= FLATTEN_LIMIT)

    def _uncertain_labels(self) -> list[frozenset[str]]:
        found = [frozenset[str]()] * len(self._tree.nodes)
        found[0] = frozenset(self._inputs.uncertain)
        for node in self._tree.nodes:
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
        slots = self._tree.graph.slots
        here = {label: g for label, g in self._inputs.root.items() if not isinstance(slots[label], State)}
        symbols: list[ca.MX] = []
        for label in self._structure.needs(branch):
            n = slots[label].size
            mean = ca.MX.sym(label, n)
            covariance = ca.MX.sym(label, n, n) if label in uncertain else None
            here[label] = Gaussian(mean, covariance)
            symbols += [mean] if covariance is None else [mean, covariance]
        written, own = _apply(branch.branch.model, here)
        worth, instructions = self._worth(branch.child or 0, {**here, **written})
        results = self._results(worth)
        name = f"branch_{len(self._functions)}"
        inputs = symbols + self._shared_symbols
        # Nobody asks for derivatives by selections and weights, and the reverse sweep would compute them.
        by = 2 if self._relaxed else 1
        follows = [True] * (len(symbols) + by) + [False] * (len(self._shared_symbols) - by)
        function = ca.Function(name, inputs, results, {"cse": True, "is_diff_in": follows})
        if own + instructions <= FLATTEN_LIMIT:
            function = function.expand()
        self._functions[key] = function

    def _call(self, branch: TreeBranch, here: Dictionary) -> tuple[ca.Function, list[ca.MX]]:
        """Return the function of a branch that stands apart, and the arguments it takes here."""
        uncertain = frozenset(label for label, g in here.items() if g.covariance.nnz())
        arguments: list[ca.MX] = []
        for label in self._structure.needs(branch):
            arguments.append(here[label].mean)
            if label in uncertain:
                arguments.append(here[label].covariance)
        return self._functions[self._key(branch, uncertain)], arguments + self._shared_symbols

    def _key(self, branch: TreeBranch, uncertain: frozenset[str]) -> tuple[Any, ...]:
        kind = self._structure.kinds[branch.child or 0]
        return branch.branch.model, kind, uncertain.intersection(self._structure.needs(branch))

    @property
    def _shared_symbols(self) -> list[ca.MX]:
        inputs = self._inputs
        return [inputs.actions, inputs.selections, *(parameter.symbol for parameter in inputs.parameters)]

    def _worth(self, root: int, dictionary: Dictionary) -> tuple[_Worth, float]:
        """Write what a subtree is worth, up to the branches that stand apart; also count scalar instructions."""
        instructions = 0.0
        dictionaries = {root: dictionary}
        order = [root]  # grows while it is walked
        groups: dict[int, list[list[tuple[ca.MX | float, _Worth | int]]]] = {}  # node → (probability, worth or child)
        margins: dict[int, list[ca.MX]] = {}
        for index in order:
            here = dictionaries.pop(index)
            groups[index], margins[index] = [], []
            chain = self._chain_from(index, here)
            if chain is not None:
                instructions = math.inf
                reach, gained, dictionaries[chain.end] = self._fold(index, chain, here)
                order.append(chain.end)
                groups[index] = [[(1.0, _Worth(gained, ca.MX(0.0), []))], [(reach, chain.end)]]
                continue
            for requirement in self._tree.nodes[index].requirements:
                outcome, count = _apply(requirement.model, here)
                instructions += count
                margins[index] += requirement.margins(outcome[REQUIREMENT])
            for group in self._tree.nodes[index].groups:
                terms: list[tuple[ca.MX | float, _Worth | int]] = []
                groups[index].append(terms)
                if is_open(group):
                    instructions = math.inf
                    terms.append((1.0, (self._blend if self._relaxed else self._switch)(group, here)))
                    continue
                model = group.group.probability
                shares, count = _apply(model if isinstance(model, BoundModel) else None, here)
                instructions += count
                for branch in group.branches:
                    probability = _share(branch, shares)
                    if branch.child is not None and self._structure.apart[branch.child]:
                        instructions = math.inf
                        function, arguments = self._call(branch, here)
                        terms.append((probability, self._worth_of(function.call(arguments))))
                        continue
                    written, count = _apply(branch.branch.model, here)
                    instructions += count + 2
                    if branch.child is None:
                        reward = written[REWARD]
                        terms.append((probability, _Worth(reward.mean, ca.densify(reward.covariance), [])))
                    else:
                        dictionaries[branch.child] = {**here, **written}
                        order.append(branch.child)
                        terms.append((probability, branch.child))
        worths: dict[int, _Worth] = {}
        for index in reversed(order):
            total = _Worth(ca.MX(self._tree.cut_value if self._tree.nodes[index].cut else 0.0), ca.MX(0.0), [])
            total.margins += margins[index]
            for terms in groups[index]:
                mixed = [(p, worths.pop(term) if isinstance(term, int) else term) for p, term in terms]
                total.add(_mixed(mixed, bool(self._risk)))
            worths[index] = total
        return worths[root], instructions

    def _chain_from(self, index: int, here: Dictionary) -> Chain | None:
        """Return the chain that begins at a node, if it can be written as one round again and again."""
        chain = self._structure.chains.get(index)
        if chain is None:
            return None
        # What is uncertain must be so after a round too, or rounds differ.
        needed = self._structure.reads(index) | self._structure.reads(chain.end)
        before = after = frozenset(label for label, g in here.items() if g.covariance.nnz())
        for model in self._models_of(chain):
            after = (after - set(model.writes)) | model.spread(after)
        if before & needed == after & needed:
            return chain
        self._refused += 1
        if self._refused > MOST_REFUSED:
            raise _Unsteady
        return None

    def _models_of(self, chain: Chain) -> list[BoundModel]:
        """Return the models by which a round leads to the next one."""
        branches = [self._tree.nodes[node].groups[g].branches[b].branch for node, g, b in chain.steps]
        return [branch.model for branch in branches if branch.model is not None]

    def _fold(self, index: int, chain: Chain, here: Dictionary) -> tuple[ca.MX, ca.MX, Dictionary]:
        """Write a chain.

        Of rounds k with own rewards r_k and the probability p_k of going on, Σ_k r_k Π_{i<k} p_i is carried along. The
        function of 2n rounds calls that of n twice, so that a chain takes few functions, however long it is.

        Returns:
            the probability that all go on, the expected rewards until then, the dictionary at the end.
        """
        slots = self._tree.graph.slots
        written = {label for model in self._models_of(chain) for label in model.writes}
        labels = sorted(self._structure.reads(index) | self._structure.reads(chain.end))
        uncertain = {label for label in labels if label in here and here[label].covariance.nnz()}

        def moments(of: Dictionary, wanted: bool) -> list[ca.MX]:
            """Return what rounds change, or what they leave; what nobody has read yet may not exist."""
            parts = []
            for label in labels:
                if (label in written) == wanted:
                    known = of.get(label, Gaussian(ca.MX(slots[label].size, 1)))
                    parts.append(ca.densify(known.mean))
                    parts += [ca.densify(known.covariance)] if label in uncertain else []
            return parts

        start = {label: g for label, g in self._inputs.root.items() if not isinstance(slots[label], State)}
        for label in labels:
            n = slots[label].size
            spread = ca.MX.sym(label, n, n) if label in uncertain else None
            start[label] = Gaussian(ca.MX.sym(label, n), spread)
        share, gained = ca.MX.sym("share"), ca.MX.sym("gained")
        goes_on, own, after, instructions = self._round(chain, start)
        constant = [*moments(start, False), *self._shared_symbols]
        inputs = [share, gained, *moments(start, True), *constant]
        results = [share * goes_on, gained + share * own, *moments(after, True)]
        by = 2 if self._relaxed else 1
        follows = [True] * (len(inputs) - len(self._shared_symbols) + by)
        follows += [False] * (len(self._shared_symbols) - by)
        options: dict[str, Any] = {"cse": True, "is_diff_in": follows}
        function = ca.Function("round", inputs, results, options)
        if instructions <= FLATTEN_LIMIT:
            function = function.expand()
        reached = [ca.MX(1.0), ca.MX(0.0), *moments(here, True)]
        shared = [*moments(here, False), *self._shared_symbols]
        rounds, count = chain.rounds, 1
        while rounds:
            if rounds % 2:
                reached = function.call([*reached, *shared])
            rounds, count = rounds // 2, 2 * count
            if rounds:
                twice = function.call([*function.call(inputs), *constant])
                function = ca.Function(f"rounds_{count}", inputs, twice, options)
        share, gained, *rest = reached
        end = dict(here)
        for label in labels:
            if label in written:
                mean = rest.pop(0)
                end[label] = Gaussian(mean, rest.pop(0) if label in uncertain else None)
        return share, gained, end

    def _round(self, chain: Chain, here: Dictionary) -> tuple[ca.MX, ca.MX, Dictionary, float]:
        """Write one round: the probability of going on, what it gains, what it leads to; also its instructions."""
        goes_on, gained, instructions = ca.MX(1.0), ca.MX(0.0), 0.0
        for index, onward_group, onward_branch in chain.steps:
            own, after = _Worth(ca.MX(0.0), ca.MX(0.0), []), here
            probability: ca.MX | float = 1.0
            for g, group in enumerate(self._tree.nodes[index].groups):
                terms: list[tuple[ca.MX | float, _Worth]] = []
                model = group.group.probability
                shares, count = _apply(model if isinstance(model, BoundModel) else None, here)
                instructions += count
                for b, branch in enumerate(group.branches):
                    share = _share(branch, shares)
                    if branch.child is not None and self._structure.apart[branch.child]:
                        function, arguments = self._call(branch, here)
                        terms.append((share, self._worth_of(function.call(arguments))))
                        instructions = math.inf
                        continue
                    written, count = _apply(branch.branch.model, here)
                    instructions += count + 2
                    if (g, b) == (onward_group, onward_branch):
                        probability, after = share, {**here, **written}
                    elif branch.child is None:
                        terms.append((share, _Worth(written[REWARD].mean, ca.MX(0.0), [])))
                    else:
                        worth, count = self._worth(branch.child, {**here, **written})
                        terms.append((share, worth))
                        instructions += count
                own.add(_mixed(terms, spread=False))
            gained += goes_on * own.value
            goes_on, here = goes_on * probability, after
        return goes_on, gained, here, instructions

    def _results(self, worth: _Worth) -> list[ca.MX]:
        """Return what a function of a branch hands on: value, variance if it is asked for, margins if there are any."""
        variance = [ca.densify(worth.variance)] if self._risk else []
        margins = [ca.densify(ca.vertcat(*worth.margins))] if worth.margins else []
        return [ca.densify(worth.value), *variance, *margins]

    def _worth_of(self, results: list[ca.MX]) -> _Worth:
        """Read what `_results` returned."""
        value, *rest = results
        return _Worth(value, rest.pop(0) if self._risk else ca.MX(0.0), rest)

    def _blend(self, group: TreeGroup, here: Dictionary) -> _Worth:
        """Write a choice whose selection may be anything between its choices."""
        shares = ca.vertsplit(self._inputs.root[str(group.group.selection)].mean)
        terms = []
        for share, branch in zip(shares, group.branches, strict=True):
            function, arguments = self._call(branch, here)
            worth = self._worth_of(function.call(arguments))
            worth.margins = [share * margin for margin in worth.margins]
            terms.append((share, worth))
        return _mixed(terms, bool(self._risk))

    def _switch(self, group: TreeGroup, here: Dictionary) -> _Worth:
        """Write a choice: the function of the selected branch, the others not evaluated."""
        slot = self._tree.graph.selections()[str(group.group.selection)]
        calls = [self._call(branch, here) for branch in group.branches]  # in the order of the slot's choices
        if len(calls) == 1:
            return self._worth_of(calls[0][0].call(calls[0][1]))
        # All cases of a switch take the same arguments: those that any of them needs. And all return the margins of all
        # branches, in which those of the others do not count.
        arguments = {argument.__hash__(): argument for _, given in calls for argument in given}
        symbols = {key: ca.MX.sym("x", argument.sparsity()) for key, argument in arguments.items()}
        unused = [[one.unused for one in constraints_of(self._tree, branch.child or 0)] for branch in group.branches]
        cases = []
        for i, (function, given) in enumerate(calls):
            worth = self._worth_of(function.call([symbols[argument.__hash__()] for argument in given]))
            before, after = ([ca.MX(ca.DM(part)) for part in parts] for parts in (unused[:i], unused[i + 1 :]))
            worth.margins = [*before, *worth.margins, *after] if any(unused) else []
            cases.append(ca.Function(f"case_{function.name()}", [*symbols.values()], self._results(worth)))
        selection = self._inputs.root[str(group.group.selection)].mean
        index = ca.dot(selection, ca.DM(range(slot.size)))
        switch = ca.Function.conditional("choice", cases[:-1], cases[-1])
        return self._worth_of(switch.call([index, *arguments.values()]))


@dataclass
class _Worth:
    """What a subtree is worth: mean and variance of its sum of rewards, and the margins of its requirements."""

    value: ca.MX
    variance: ca.MX
    margins: list[ca.MX]

    def add(self, other: _Worth) -> None:
        """Take in a group that happens side by side, independently."""
        self.value += other.value
        self.variance += other.variance
        self.margins += other.margins


def _mixed(terms: list[tuple[ca.MX | float, _Worth]], spread: bool) -> _Worth:
    """Return the worth of a group of branches of which one happens: mean and, if asked for, variance of a mixture."""
    margins = [margin for _, worth in terms for margin in worth.margins]
    if len(terms) == 1 and isinstance(terms[0][0], float) and terms[0][0] == 1.0:
        return _Worth(terms[0][1].value, terms[0][1].variance, margins)
    value, variance = ca.MX(0.0), ca.MX(0.0)
    for probability, worth in terms:
        value += probability * worth.value
    for probability, worth in terms if spread else ():
        variance += probability * (worth.variance + (worth.value - value) ** 2)
    return _Worth(value, variance, margins)


def _share(branch: TreeBranch, shares: Dictionary) -> ca.MX | float:
    """Return the probability of a branch, given what the group's model returned."""
    label = branch.branch.label
    share = shares[label].mean if label in shares else branch.share
    return 1.0 if share is None else share


def _apply(model: BoundModel | None, here: Dictionary) -> tuple[Dictionary, float]:
    """Return what a model writes, and its scalar instructions: infinitely many where it cannot be flattened."""
    if model is None:
        return {}, 0.0
    function, _ = model.moments(here)
    return model.apply(here), function.n_instructions() if function.is_a("SXFunction") else math.inf
