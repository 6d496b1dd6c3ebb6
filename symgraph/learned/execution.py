"""Execution: an episode in a world, edge by edge."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from symgraph.errors import InputError, did_you_mean, names
from symgraph.graph import Graph
from symgraph.learned.knowledge import Knowledge
from symgraph.learned.records import Visit, checked_visit
from symgraph.learned.schedule import World

Decision = tuple[dict[str, Any], dict[str, str]]  # actions, selections


class WorldFailed(Exception):
    """A world raised; carries what was observed until then, None if it did not say."""

    def __init__(self, node: str, error: Exception) -> None:
        super().__init__(f"{type(error).__name__} at node {node!r}: {error}")
        observed = getattr(error, "observed", None)
        self.observed: dict[str, Any] | None = dict(observed) if isinstance(observed, Mapping) else None


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

    Attributes:
        visits: in the order in which nodes were reached.
        seconds: that the world took [s].
    """

    def __init__(
        self, graph: Graph, world: World, knowledge: Knowledge, number: int, past: Sequence[Visit] = ()
    ) -> None:
        self._graph = graph
        self._world = world
        self._knowledge = knowledge
        self._number = number
        self._past = list(past)
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
            given: {label: value} of states beside what the world observes.
            decide: returns the actions and selections with which a visit's node is left.
            reached: called with the visits that an executed node has led to, and whether they are new.
            goes_on: whether the world is asked to leave a visit's node.

        Raises:
            WorldFailed: the world raised.
            Diverged: the world does not lead to the past again.
            InputError: the world observed what makes no sense.
        """
        observed = self._timed(self._graph.start, lambda: self._world.reset(seed))
        self._arrive([self._visit(0, None, self._graph.start, {**observed, **given}, ({}, {}), 0.0)], reached)
        waiting = deque(self.visits)
        while waiting:
            visit = waiting.popleft()
            if not goes_on(visit):
                continue
            decision = decide(visit)
            self._knowledge.decide(visit.step, *decision)
            due = self._knowledge.reward_due(visit)
            new: list[Visit] = []
            for node, observed in self._execute(visit.node, decision).items():
                step = len(self.visits) + len(new)
                new.append(self._visit(step, visit, node, observed, decision, 0.0 if new else due))
            self._arrive(new, reached)
            waiting.extend(new)

    def _timed(self, node: str, call: Callable[[], Any]) -> Any:
        begin = time.perf_counter()
        try:
            return call()
        except Exception as error:
            raise WorldFailed(node, error) from error
        finally:
            self.seconds += time.perf_counter() - begin

    def _execute(self, node: str, decision: Decision) -> Mapping[str, Mapping[str, Any]]:
        actions, selections = decision
        reached = self._timed(node, lambda: self._world.execute(node, dict(actions), dict(selections)))
        if not isinstance(reached, Mapping) or not all(isinstance(o, Mapping) for o in reached.values()):
            raise InputError(
                f"node {node!r}: the world returned {reached!r}; return {{node reached: {{label: value}}}}"
            )
        for target in reached:
            if target not in self._graph.nodes:
                raise InputError(
                    f"node {node!r}: the world led to {target!r}, which is no node of the graph"
                    f"{did_you_mean(target, self._graph.nodes)} Nodes: {names(self._graph.nodes)}"
                )
        return reached

    def _visit(
        self, step: int, parent: Visit | None, node: str, observed: Mapping[str, Any], decision: Decision, due: float
    ) -> Visit:
        at = None if parent is None else parent.step
        visit = checked_visit(Visit(self._number, step, at, node, dict(observed), *decision, 0.0))
        self._knowledge.arrive(visit, parent)
        return replace(visit, reward=due + self._knowledge.reward(visit))

    def _arrive(self, new: list[Visit], reached: Callable[[list[Visit], bool], None]) -> None:
        at = len(self.visits)
        stored = self._past[at : at + len(new)]
        if stored and stored != new:
            raise Diverged(f"the world did not do again what it did before, step {at}")
        self.visits.extend(new)
        if new:
            reached(new, not stored)
