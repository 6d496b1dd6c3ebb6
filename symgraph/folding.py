"""Chains as expressions: one round as a function, applied again and again."""

from __future__ import annotations

import math
from typing import Any, Protocol

import casadi as ca

from symgraph.binding import REWARD, BoundModel
from symgraph.slots import Gaussian, State
from symgraph.structure import Chain, Structure
from symgraph.tree import Tree, TreeBranch
from symgraph.worth import FLATTEN_LIMIT, Dictionary, Worth, applied, mixed, probability_of

MOST_REFUSED = 64  # rounds written out one by one until what is uncertain is the same after each


class Writer(Protocol):
    """Writes what is beside a chain."""

    tree: Tree
    relaxed: bool
    root: Dictionary

    @property
    def shared_symbols(self) -> list[ca.MX]: ...
    def call(self, branch: TreeBranch, here: Dictionary) -> tuple[ca.Function, list[ca.MX]]: ...
    def worth_of(self, results: list[ca.MX]) -> Worth: ...
    def worth(self, root: int, dictionary: Dictionary) -> tuple[Worth, float]: ...


class Unsteady(Exception):
    """What is uncertain goes on changing from round to round, so that chains cannot be folded."""


class Folder:
    """Writes chains.

    Args:
        writer: of the rest.
        structure: which chains there are.
    """

    def __init__(self, writer: Writer, structure: Structure) -> None:
        self._writer = writer
        self._structure = structure
        self._refused = 0  # chains in which one round leaves other labels uncertain than the one before

    def chain_from(self, index: int, here: Dictionary) -> Chain | None:
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
            raise Unsteady
        return None

    def _models_of(self, chain: Chain) -> list[BoundModel]:
        """Return the models by which a round leads to the next one."""
        branches = [self._writer.tree.nodes[node].groups[g].branches[b].branch for node, g, b in chain.steps]
        return [branch.model for branch in branches if branch.model is not None]

    def fold(self, index: int, chain: Chain, here: Dictionary) -> tuple[ca.MX, ca.MX, Dictionary]:
        """Write a chain.

        Of rounds k with own rewards r_k and the probability p_k of going on, Σ_k r_k Π_{i<k} p_i is carried along. The
        function of 2n rounds calls that of n twice, so that a chain takes few functions, however long it is.

        Returns:
            the probability that all go on, the expected rewards until then, the dictionary at the end.
        """
        slots = self._writer.tree.graph.slots
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

        start = {label: g for label, g in self._writer.root.items() if not isinstance(slots[label], State)}
        for label in labels:
            n = slots[label].size
            spread = ca.MX.sym(label, n, n) if label in uncertain else None
            start[label] = Gaussian(ca.MX.sym(label, n), spread)
        share, gained = ca.MX.sym("share"), ca.MX.sym("gained")
        goes_on, own, after, instructions = self._round(chain, start)
        constant = [*moments(start, False), *self._writer.shared_symbols]
        inputs = [share, gained, *moments(start, True), *constant]
        results = [share * goes_on, gained + share * own, *moments(after, True)]
        by = 2 if self._writer.relaxed else 1
        follows = [True] * (len(inputs) - len(self._writer.shared_symbols) + by)
        follows += [False] * (len(self._writer.shared_symbols) - by)
        options: dict[str, Any] = {"cse": True, "is_diff_in": follows}
        function = ca.Function("round", inputs, results, options)
        if instructions <= FLATTEN_LIMIT:
            function = function.expand()
        reached = [ca.MX(1.0), ca.MX(0.0), *moments(here, True)]
        shared = [*moments(here, False), *self._writer.shared_symbols]
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
            own, after = Worth(ca.MX(0.0), ca.MX(0.0), []), here
            probability: ca.MX | float = 1.0
            for g, group in enumerate(self._writer.tree.nodes[index].groups):
                terms: list[tuple[ca.MX | float, Worth]] = []
                model = group.group.probability
                shares, count = applied(model if isinstance(model, BoundModel) else None, here)
                instructions += count
                for b, branch in enumerate(group.branches):
                    share = probability_of(branch, shares)
                    if branch.child is not None and self._structure.apart[branch.child]:
                        function, arguments = self._writer.call(branch, here)
                        terms.append((share, self._writer.worth_of(function.call(arguments))))
                        instructions = math.inf
                        continue
                    written, count = applied(branch.branch.model, here)
                    instructions += count + 2
                    if (g, b) == (onward_group, onward_branch):
                        probability, after = share, {**here, **written}
                    elif branch.child is None:
                        terms.append((share, Worth(written[REWARD].mean, ca.MX(0.0), [])))
                    else:
                        worth, count = self._writer.worth(branch.child, {**here, **written})
                        terms.append((share, worth))
                        instructions += count
                own.add(mixed(terms, spread=False))
            gained += goes_on * own.value
            goes_on, here = goes_on * probability, after
        return goes_on, gained, here, instructions
