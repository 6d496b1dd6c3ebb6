"""Execution: an episode in a world, edge by edge."""

from __future__ import annotations

import copy
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from symgraph.errors import InputError, did_you_mean, names
from symgraph.graph import Graph
from symgraph.learned.knowledge import Knowledge, branches_to
from symgraph.learned.records import Visit, checked_value, checked_visit, shown
from symgraph.learned.schedule import World

Decision = tuple[dict[str, Any], dict[str, str]]  # actions, selections


class WorldFailed(Exception):
    """A world failed on the way, and said what was observed until then."""

    def __init__(self, visit: Visit, error: Exception, observed: Mapping[str, Any]) -> None:
        super().__init__(f"{type(error).__name__} at node {visit.node!r}: {error}")
        self.step = visit.step
        self.observed = dict(observed)


class Diverged(Exception):
    """The world does not do again what it did before."""


class Execution:
    """One episode in a world.

    Args:
        graph: the task.
        world: where it happens.
        knowledge: an empty one, for this episode.
        number: of the episode.
        past: visits of this episode that were stored before: the world is brought back to where it was by doing the
            same again.
        needed: {state: place that reads it} of those without which nothing can be planned at the start.

    Attributes:
        visits: in the order in which nodes were reached.
        seconds: that the world took [s].
    """

    def __init__(
        self,
        graph: Graph,
        world: World,
        knowledge: Knowledge,
        number: int,
        past: Sequence[Visit] = (),
        needed: Mapping[str, str] | None = None,
    ) -> None:
        self._graph = graph
        self._world = world
        self._knowledge = knowledge
        self._number = number
        self._past = list(past)
        self._needed = needed or {}
        self.visits: list[Visit] = []
        self.seconds = 0.0

    def run(
        self,
        seed: int,
        given: Mapping[str, Any],
        decide: Callable[[Visit], Decision],
        reached: Callable[[list[Visit], bool], None],
        goes_on: Callable[[Visit], bool],
    ) -> None:
        """Run the episode to its end.

        Args:
            seed: of the world.
            given: {label: value} of states that the world's reset does not observe.
            decide: returns the actions and selections with which a visit's node is left.
            reached: called with the visits that an executed node has led to, and whether they are new.
            goes_on: whether the world is asked to leave a visit's node; called once for each visit.

        Raises:
            WorldFailed: the world raised, on the way, an exception with an attribute `observed`. Any other comes out
                as it is: it may be a mistake in a program.
            Diverged: the world does not lead to the past again.
            InputError: the world observed what makes no sense, or lacks what is needed.
        """
        start = self._graph.start
        observed = self._timed(lambda: self._world.reset(seed))
        if not isinstance(observed, Mapping):
            raise InputError(f"node {start!r}: the world's reset returned {shown(observed)}; return {{label: value}}")
        known = {**observed, **self._checked_given(given, observed)}
        missing = [label for label in self._needed if label not in known]
        if missing and not self._past:
            raise InputError(
                f"state {missing[0]!r} is missing at the start: {self._needed[missing[0]]} reads it; let the world's "
                f"reset return it, or hand it over as given=, of Stage or of perform. Missing in all: {names(missing)}"
            )
        self._arrive(None, [self._visit(0, None, start, known, ({}, {}), 0.0)], reached)
        waiting = deque(self.visits)
        while waiting:
            visit = waiting.popleft()
            if not goes_on(visit):
                continue
            decision = decide(visit)
            self._knowledge.decide(visit.step, *decision)
            due = self._knowledge.reward_due(visit)
            new: list[Visit] = []
            for node, observed in self._execute(visit, decision).items():
                step = len(self.visits) + len(new)
                new.append(self._visit(step, visit, node, observed, decision, 0.0 if new else due))
            self._arrive(visit.step, new, reached)
            waiting.extend(new)

    def _timed(self, call: Callable[[], Any]) -> Any:
        begin = time.perf_counter()
        try:
            return call()
        finally:
            self.seconds += time.perf_counter() - begin

    def _execute(self, visit: Visit, decision: Decision) -> Mapping[str, Mapping[str, Any]]:
        actions, selections = copy.deepcopy(decision)  # the world may write into its own
        try:
            reached = self._timed(lambda: self._world.execute(visit.node, actions, selections))
        except Exception as error:
            observed = getattr(error, "observed", None)
            if not isinstance(observed, Mapping):
                raise
            if len(self.visits) < len(self._past):
                raise Diverged(
                    f"the world failed where it did not before, step {visit.step}: {type(error).__name__}: {error}"
                ) from error
            raise WorldFailed(visit, error, observed) from error
        self._check_reached(visit, reached)
        return reached  # type: ignore[no-any-return]  # it has just been checked

    def _check_reached(self, visit: Visit, reached: Any) -> None:
        """Raise InputError where a world says what cannot be."""
        node, nodes = visit.node, self._graph.nodes
        if not isinstance(reached, Mapping) or not all(isinstance(o, Mapping) for o in reached.values()):
            raise InputError(
                f"node {node!r}: the world returned {shown(reached)}; return {{node reached: {{label: value}}}}"
            )
        unknown = [target for target in reached if target not in nodes]
        if unknown:
            raise InputError(
                f"node {node!r}: the world led to {unknown[0]!r}, which is no node of the graph"
                f"{did_you_mean(unknown[0], nodes)} Nodes: {names(nodes)}"
            )
        known = self._knowledge.at[visit.step]
        ways = [target for target in nodes if branches_to(self._graph, node, target, known)]
        if not ways:  # the graph ends here, and the world begins again somewhere
            return
        if not reached:
            raise InputError(
                f"node {node!r}: the world led nowhere; return one entry for each group that happened, of "
                f"{names(ways)}, or raise an exception with an attribute 'observed', {{label: value}}"
            )
        elsewhere = [target for target in reached if target not in ways]
        if elsewhere:
            chosen = {label: known[label] for label in self._graph.selections() if label in known}
            raise InputError(
                f"node {node!r}: the world led to {elsewhere[0]!r}, to which no branch leads from there"
                f"{f' with {chosen}' if chosen else ''}; it can lead to {names(ways)}"
            )

    def _checked_given(self, given: Any, observed: Mapping[str, Any]) -> Mapping[str, Any]:
        if not isinstance(given, Mapping):
            raise InputError(f"given = {shown(given)}; give {{label: value}}")
        states = self._graph.states()
        for label, value in given.items():
            if label not in states:
                raise InputError(f"given: {label!r} is no state{did_you_mean(label, states)} States: {names(states)}")
            if label in observed:
                raise InputError(f"given: {label!r} is what the world's reset observes; leave it out of one of them")
            if np.size(value) != states[label].size or not np.isfinite(checked_value(value, f"given {label!r}")).all():
                raise InputError(
                    f"given: {label!r} = {shown(value)}; the slot takes {states[label].size} finite numbers, give those"
                )
        return given

    def _visit(
        self, step: int, parent: Visit | None, node: str, observed: Mapping[str, Any], decision: Decision, due: float
    ) -> Visit:
        at = None if parent is None else parent.step
        try:
            visit = checked_visit(Visit(self._number, step, at, node, dict(observed), *decision, 0.0))
        except InputError as error:
            raise InputError(f"node {node!r}: {error}") from None
        self._knowledge.arrive(visit, parent)
        return replace(visit, reward=due + self._knowledge.reward(visit))

    def _arrive(self, parent: int | None, new: list[Visit], reached: Callable[[list[Visit], bool], None]) -> None:
        stored = [visit for visit in self._past if visit.parent == parent]
        if stored and stored != new:
            raise Diverged(f"the world did not do again what it did before, step {stored[0].step}")
        self.visits.extend(new)
        if new:
            reached(new, not stored)


def returns_of(visits: Sequence[Visit], again: str | None) -> tuple[float, ...]:
    """Return each attempt's return; an attempt begins wherever the world has led on from the node `again`."""
    node = {visit.step: visit.node for visit in visits}
    attempt: dict[int, int] = {}
    begun: dict[int | None, int] = {}  # {step from which the world led back, None at the start: attempt}
    returns: list[float] = []
    for visit in visits:
        if visit.parent is not None and node[visit.parent] != again:
            attempt[visit.step] = attempt[visit.parent]
        else:
            attempt[visit.step] = begun.setdefault(visit.parent, len(begun))
            returns.extend([0.0] * (len(begun) - len(returns)))
        returns[attempt[visit.step]] += visit.reward
    return tuple(returns)
