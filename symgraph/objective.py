"""Objective: the expected sum of rewards of a tree, its value, gradient and Hessian in numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any, Literal

import casadi as ca
import numpy as np

from symgraph.constraints import violations
from symgraph.errors import InputError, SlotError, did_you_mean, names
from symgraph.outcomes import ModelNumbers, Moments, NodeOutcomes, walk
from symgraph.progress import Progress
from symgraph.situation import Build, Situation
from symgraph.slots import Action, Array, Gaussian, Selection, Slot, as_column, unchecked_gaussian
from symgraph.tree import Tree

PRECISIONS: tuple[Literal["double", "single"], ...] = ("double", "single")


class Objective:
    """The expected sum of rewards as ONE function of actions, selections, start states and model parameters.

    J(actions, selections, state) = E[Σ rewards], equation (1) of the paper. Built at first use, once for each set of
    start states that are uncertain; changed parameters and other numbers need no rebuild.

    Args:
        tree: what `unroll` returns.
        compiled: evaluate many points in compiled C when there is a compiler; False stays in CasADi's interpreter.
        risk: J becomes E[Σ rewards] - risk · sd[Σ rewards]; rewards on the way through the tree count as independent of
            each other, as slots do.
        precision: of compiled code. In "single" wide networks take half the time, and searches end some 1e-6 of J's
            size before they would in "double"; numbers above 3e38 are infinite there. What a plan says of itself is
            computed in double either way.

    Raises:
        InputError: no tree, a risk that is no finite number, or no such precision.

    Source: Yamaguchi & Atkeson, Humanoids 2016, sections II-A to II-C and III.
    """

    def __init__(
        self, tree: Tree, compiled: bool = True, risk: float = 0.0, precision: Literal["double", "single"] = "double"
    ) -> None:
        if not isinstance(tree, Tree):
            raise InputError(f"Objective takes a tree, got {type(tree).__name__}; write Objective(unroll(graph))")
        if isinstance(risk, bool) or not isinstance(risk, (int, float, np.number)) or not math.isfinite(risk):
            raise InputError(f"Objective: risk = {risk!r}; give a finite number of standard deviations, e.g. 1.0")
        if precision not in PRECISIONS:
            raise InputError(f"Objective: precision = {precision!r}; give 'double' or 'single'")
        self.tree = tree
        self.graph = tree.graph
        self.precision = precision
        self.risk = float(risk)
        self._compiled = compiled
        self._builds: dict[frozenset[str], Build] = {}
        self._chosen: dict[tuple[str, ...], Objective] = {}
        self._models = ModelNumbers()

    def value(
        self,
        state: Mapping[str, Any],
        actions: Mapping[str, Any] | None = None,
        selections: Mapping[str, str] | None = None,
    ) -> float:
        """Return the expected sum of rewards, less what the risk takes away.

        Args:
            state: label → number, array or Gaussian [unit], at least the states that some path reads before writing.
            actions: label → number or array [unit], all of them; outside the bounds they are evaluated as they are.
            selections: label → choice, all of them.

        Raises:
            InputError: something is missing, unknown, of the wrong size or not finite.
        """
        return float(self._evaluate(state, actions, selections)[0][0])

    def gradient(
        self,
        state: Mapping[str, Any],
        actions: Mapping[str, Any] | None = None,
        selections: Mapping[str, str] | None = None,
    ) -> dict[str, Any]:
        """Return ∂J/∂action for each action label, a float for a scalar, else (size,) [reward/unit]; see `value`."""
        return self.unstack(self._evaluate(state, actions, selections)[1])

    def hessian(
        self,
        state: Mapping[str, Any],
        actions: Mapping[str, Any] | None = None,
        selections: Mapping[str, str] | None = None,
    ) -> Array:
        """Return ∂²J/∂actions², (n, n) over the stacked actions in graph order; see `value`."""
        situation = self.situation(state)
        columns = [self.stack_actions(actions), self.one_hot(selections), *situation.shared]
        return situation.build.hessian(columns)[0].reshape(self.n_actions, self.n_actions)

    def violation(
        self,
        state: Mapping[str, Any],
        actions: Mapping[str, Any] | None = None,
        selections: Mapping[str, str] | None = None,
    ) -> float:
        """Return the largest breach of a requirement in the unit of its model, 0 if all are met; see `value`."""
        situation = self.situation(state)
        breaches = self.breaches(situation, self.stack_actions(actions), self.one_hot(selections))
        return float(breaches.max(initial=0.0))

    def breaches(self, situation: Situation, actions: Array, hot: Array) -> Array:
        """Return by how much each constraint is missed (k,), each at least 0, at stacked actions and selections."""
        (margins,) = situation.build.margins([actions, hot, *situation.shared])
        return violations(margins, situation.build.expectation.constraints)

    def evaluate(
        self, state: Mapping[str, Any], points: Any, selections: Mapping[str, str] | None = None
    ) -> tuple[Array, Array]:
        """Evaluate many points at once, side by side as columns.

        Args:
            state: as in `value`.
            points: (n, P), the stacked actions in graph order, a column per point.
            selections: label → choice, the same for all points.

        Returns:
            values (P,) and gradients (n, P).
        """
        situation = self.situation(state)
        try:
            columns = np.asarray(points, dtype=float)
        except (TypeError, ValueError):
            raise InputError(f"points is {points!r}; give an array of numbers") from None
        n = self.n_actions
        if columns.ndim != 2 or columns.shape[0] != n:
            raise InputError(
                f"points has shape {columns.shape}; give ({n}, P): the {n} stacked actions, a column per point"
            )
        chosen = np.tile(self.one_hot(selections), (columns.shape[1], 1))
        values, gradients = situation.bind(*self.bounds).evaluate(columns.T, chosen)
        return values, gradients.T

    def outcomes(
        self,
        state: Mapping[str, Any],
        actions: Mapping[str, Any] | None = None,
        selections: Mapping[str, str] | None = None,
    ) -> NodeOutcomes:
        """Return what happens at every node: probability, the slots' Gaussians, reward and value; see `value`."""
        situation = self.situation(state)
        self.one_hot(selections)  # checks them
        return self.outcomes_of(situation, self.stack_actions(actions), {} if selections is None else selections)

    def outcomes_of(self, situation: Situation, actions: Array, selections: Mapping[str, str]) -> NodeOutcomes:
        """Return the outcomes for a checked situation and stacked actions (n,)."""
        here: dict[str, Moments] = {label: (column, None) for label, column in self._columns(actions, selections)}
        for label, gaussian in situation.given.items():
            exact = not np.any(gaussian.covariance)
            here[label] = np.atleast_1d(gaussian.mean), None if exact else np.ravel(gaussian.covariance)
        return walk(self.tree, here, dict(selections), self._models)

    def _columns(self, actions: Array, selections: Mapping[str, str]) -> Iterator[tuple[str, Array]]:
        where = stacked_index(self.graph.actions())
        yield from ((label, actions[where[label]]) for label in where)
        for label, slot in self.graph.selections().items():
            yield label, np.array([float(choice == selections[label]) for choice in slot.choices])

    def __getstate__(self) -> dict[str, Any]:  # what is derived from the tree does not travel; it is built anew
        return {**self.__dict__, "_builds": {}, "_chosen": {}, "_models": ModelNumbers()}

    def chosen(self, selections: Mapping[str, str]) -> Objective:
        """Return the objective of the tree without the branches that selections rule out."""
        key = tuple(selections[label] for label in self.graph.selections())
        if key not in self._chosen:
            tree = self.tree.chosen(selections)
            whole = len(tree.nodes) == len(self.tree.nodes)
            self._chosen[key] = self if whole else Objective(tree, self._compiled, self.risk, self.precision)
        return self._chosen[key]

    @cached_property
    def n_actions(self) -> int:
        """Number of stacked action elements."""
        return sum(slot.size for slot in self.graph.actions().values())

    @cached_property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the stacked actions, each (n,)."""
        actions = self.graph.actions().values()
        empty = [np.zeros(0)]
        return np.concatenate([a.lower for a in actions] or empty), np.concatenate([a.upper for a in actions] or empty)

    def situation(self, state: Mapping[str, Any]) -> Situation:
        """Check a start state and find or begin the build for it.

        Raises:
            InputError: a label that is unknown or no state, a state that is missing, a value that does not fit.
        """
        if not isinstance(state, Mapping):
            raise InputError(f"state is {type(state).__name__}; give {{label: number, array or Gaussian}}")
        given = {label: self._gaussian(label, value) for label, value in state.items()}
        missing = {label: place for label, place in self.tree.needed_states.items() if label not in given}
        if missing:
            label, place = next(iter(missing.items()))
            hint = did_you_mean(label, [x for x in given if x not in self.tree.needed_states])
            raise InputError(f"state {label!r} is missing: {place} reads it{hint} Missing in all: {names(missing)}")
        # A variance of zero is exact: formulas for a spread may not survive it (0 · ∞ where a slope is infinite).
        uncertain = frozenset(label for label in self.tree.needed_states if np.any(given[label].covariance))
        empty = [np.zeros(0)]
        spread = [label for label in self.tree.needed_states if label in uncertain]
        means = [np.ravel(given[label].mean) for label in self.tree.needed_states]
        return Situation(
            given,
            self.build(uncertain),
            np.concatenate(means or empty),
            np.concatenate([np.ravel(given[label].covariance) for label in spread] or empty),
        )

    def compile(self, state: Mapping[str, Any], progress: bool = True) -> None:
        """Do ahead what the first plan from such a state would wait for: write down J, its gradient, and compile both.

        Machine code is kept on disk; what it serves is every state of which the same labels are uncertain.

        Args:
            state: as in `value`.
            progress: show a progress bar where it takes longer than two seconds.
        """
        situation = self.situation(state)
        with Progress("compiling", progress) as bar:
            bar.wait("compiling")
            situation.build.compile()

    def build(self, uncertain: frozenset[str]) -> Build:
        """Return all that is derived from the tree for a set of uncertain start states."""
        if uncertain not in self._builds:
            self._builds[uncertain] = Build(self.tree, uncertain, self._compiled, self.risk, self.precision == "single")
        return self._builds[uncertain]

    def stack_actions(self, actions: Mapping[str, Any] | None) -> Array:
        """Stack {label: value} of all actions to (n,) in graph order."""
        actions = {} if actions is None else actions
        slots = self.graph.actions()
        self._check_labels(actions, slots, "action")
        missing = [label for label in slots if label not in actions]
        if missing:
            raise InputError(f"action {missing[0]!r} is missing; give a value to each of {names(slots)}")
        columns = [checked_column(value, slots[label].size, f"action {label!r}") for label, value in actions.items()]
        by_label = dict(zip(actions, columns, strict=True))
        return np.concatenate([by_label[label] for label in slots]) if slots else np.zeros(0)

    def unstack(self, column: Array) -> dict[str, Any]:
        """Split (n,) stacked actions into {label: float or (size,)}."""
        parts, at = {}, 0
        for label, slot in self.graph.actions().items():
            part = column[at : at + slot.size]
            parts[label] = float(part[0]) if slot.size == 1 else part.copy()
            at += slot.size
        return parts

    def one_hot(self, selections: Mapping[str, str] | None) -> Array:
        """Stack {label: choice} of all selections to one-hot columns (m,) in graph order."""
        selections = {} if selections is None else selections
        slots = self.graph.selections()
        self._check_labels(selections, slots, "selection")
        missing = [label for label in slots if label not in selections]
        if missing:
            choices = names(slots[missing[0]].choices)
            raise InputError(f"selection {missing[0]!r} is missing; give one of its choices: {choices}")
        for label, choice in selections.items():
            check_choice(label, choice, slots[label])
        hot = [float(choice == selections[label]) for label, slot in slots.items() for choice in slot.choices]
        return np.array(hot)

    def _evaluate(
        self, state: Mapping[str, Any], actions: Mapping[str, Any] | None, selections: Mapping[str, str] | None
    ) -> list[Array]:
        situation = self.situation(state)
        columns = [self.stack_actions(actions), self.one_hot(selections), *situation.shared]
        return situation.build.interpreted(columns)

    def _gaussian(self, label: str, value: Any) -> Gaussian:
        slots = self.graph.slots
        slot = slots.get(label)
        if slot is None:
            raise InputError(
                f"state {label!r} is not a slot{did_you_mean(label, slots)} States: {names(self.graph.states())}"
            )
        if isinstance(slot, Action):
            raise InputError(
                f"{label!r} is an action, not a state: the planner chooses it; to hold it give fixed={{{label!r}: …}}"
            )
        if isinstance(slot, Selection):
            raise InputError(f"{label!r} is a selection, not a state: give it as selections= or fixed=")
        if isinstance(value, Gaussian):
            if isinstance(value.mean, (ca.SX, ca.MX)):
                raise InputError(f"state {label!r} is a Gaussian of symbols; give numbers")
            if np.size(value.mean) != slot.size:
                raise InputError(f"state {label!r}: the mean has {np.size(value.mean)} elements, the slot {slot.size}")
            return value
        column = checked_column(value, slot.size, f"state {label!r}")
        return unchecked_gaussian(column, np.zeros((slot.size, slot.size)))

    def _check_labels(self, given: Mapping[str, Any], slots: Mapping[str, Slot], kind: str) -> None:
        if not isinstance(given, Mapping):
            raise InputError(f"{kind}s is {type(given).__name__}; give {{label: value}}")
        for label in given:
            if label not in slots:
                raise InputError(
                    f"{label!r} is no {kind}{did_you_mean(str(label), slots)} {kind.capitalize()}s: {names(slots)}"
                )


def checked_column(value: Any, size: int, place: str) -> Array:
    """Turn a number or array into a finite (size,) array; raise InputError naming the place otherwise."""
    try:
        column = as_column(value, place)
    except SlotError as error:
        raise InputError(str(error)) from None
    if column.size != size:
        raise InputError(f"{place} has {column.size} elements, the slot has {size}")
    return column


def check_choice(label: str, choice: Any, slot: Selection) -> None:
    """Raise InputError when a choice is none of the selection's."""
    if not isinstance(choice, str) or choice not in slot.choices:
        hint = did_you_mean(choice, slot.choices)
        raise InputError(f"selection {label!r}: {choice!r} is not a choice{hint} Choices: {names(slot.choices)}")


def stacked_index(slots: Mapping[str, Slot]) -> dict[str, slice]:
    """Return where each label stands in the stacked column."""
    where, at = {}, 0
    for label, slot in slots.items():
        where[label] = slice(at, at + slot.size)
        at += slot.size
    return where
