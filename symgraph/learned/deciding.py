"""Deciding: plans at the nodes where decisions are made, with what is tried beside them."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from symgraph.binding import BoundModel
from symgraph.graph import Graph
from symgraph.learned.execution import Decision
from symgraph.learned.knowledge import Knowledge
from symgraph.learned.novelty import Try, least_known, situation_of
from symgraph.learned.records import Visit
from symgraph.learned.schedule import Exploration
from symgraph.model import Parameter
from symgraph.objective import Objective
from symgraph.optimizers.problem import Optimizer
from symgraph.plan import Plan
from symgraph.planner import solve
from symgraph.slots import Action, Array
from symgraph.tree import Tree

Notes = dict[str, Any]  # what is stored of a plan
DRAWS = 2  # joined with other numbers, what is drawn for exploration


@dataclass(frozen=True)
class Planning:
    """How decisions are made, in all episodes of a loop.

    Attributes:
        graph: the task.
        objectives: of the nodes at which is planned.
        optimizer: of the plans, `solve`'s default if None.
        again: a node at which the graph ends but from which the world may lead back to an earlier one.
        attempts: how often the graph is gone through, at most.
        seed: of all that is random.
        informative: states that tell situations apart, in which a choice may be known or not.
        spreads: parameters of learned models that make them certain where they are 0.
    """

    graph: Graph
    objectives: Mapping[str, Objective]
    optimizer: Optimizer | None
    again: str | None
    attempts: int
    seed: int
    informative: tuple[str, ...]
    spreads: tuple[Parameter, ...]


class Decider:
    """Decides in one episode.

    Args:
        planning: how.
        knowledge: what is known in this episode.
        number: of the episode.
        explore: how much is tried in this episode.
        starts: decisions of other episodes, to start searches from.
        tries: of other episodes; what is drawn is what is known least, see `least_known`.
        recalled: {step: notes} of plans that were made before.
        note: called with the step and the notes of every new plan.

    Attributes:
        decision: the latest.
        notes: of the latest plan.
        plans: {step: notes} of all plans of the episode so far.
        attempts: begun so far: at the start, and where the world has led back to.
        seconds: that planning took [s].
    """

    def __init__(
        self,
        planning: Planning,
        knowledge: Knowledge,
        number: int,
        explore: Exploration,
        starts: Sequence[Mapping[str, Any]] = (),
        tries: Sequence[Try] = (),
        recalled: Mapping[int, Notes] | None = None,
        note: Callable[[int, Notes], None] = lambda step, notes: None,
    ) -> None:
        self._planning = planning
        self._knowledge = knowledge
        self._number = number
        self._explore = explore
        self._starts = list(starts)
        self._tries = list(tries)
        self._recalled = recalled or {}
        self._note = note
        self._fixed: dict[str, Any] = {}
        self._made: set[str] = set()  # selections that have mattered in this attempt
        self._disturbance: dict[str, Any] = {}
        self._ends: set[int] = set()  # steps from which the world may lead back
        self.decision: Decision = {}, {}
        self.notes: Notes = {}
        self.plans: dict[int, Notes] = {}
        self.attempts = 0
        self.seconds = 0.0

    def goes_on(self, visit: Visit) -> bool:
        """Whether the world is asked to leave a visit's node."""
        if any(group.kind != "reward" for group in self._planning.graph.groups.get(visit.node, ())):
            return True
        if visit.node != self._planning.again or self.attempts + len(self._ends) >= self._planning.attempts:
            return False
        self._ends.add(visit.step)
        return True

    def decide(self, visit: Visit) -> Decision:
        """Return the actions and selections with which a visit's node is left."""
        if visit.parent is None or visit.parent in self._ends:
            self._ends.discard(-1 if visit.parent is None else visit.parent)
            self._begin_attempt(visit)
        if visit.node in self._planning.objectives:
            begin = time.perf_counter()
            if visit.step in self._recalled:
                notes = self._recalled[visit.step]
            else:
                notes = self._planned(visit)
                self._note(visit.step, notes)
            self.plans[visit.step] = notes
            self._take_over(notes)
            self.seconds += time.perf_counter() - begin
        self._tries += _tries_at(self._planning, self._knowledge, visit, self.decision[1], self._made)
        return self.decision

    def recall(self) -> None:
        """Take over the plans that were made before, and no others."""
        self.plans = dict(self._recalled)
        if self._recalled:
            self._take_over(self._recalled[max(self._recalled)])

    def _take_over(self, notes: Notes) -> None:
        self.notes = notes
        actions = {k: np.array(v) if isinstance(v, list) else v for k, v in notes["actions"].items()}
        self.decision = actions, dict(notes["selections"])

    def _begin_attempt(self, visit: Visit) -> None:
        """Draw what is tried in an attempt, all of whose decisions keep to it."""
        graph = self._planning.graph
        rng = np.random.default_rng([self._planning.seed, self._number, self.attempts, DRAWS])
        self.attempts += 1
        self._made = set()
        draws_selections, draws_actions = rng.random(2) < (self._explore.selections, self._explore.actions)
        situation = _situation(self._planning, self._knowledge, visit.step)
        selections = {
            label: str(rng.choice(least_known(label, slot.choices, situation, self._tries)))
            for label, slot in graph.selections().items()
        }
        actions = {label: rng.uniform(slot.lower, slot.upper) for label, slot in graph.actions().items()}
        self._fixed = {**(selections if draws_selections else {}), **(actions if draws_actions else {})}
        self._disturbance = {
            label: self._explore.noise * rng.standard_normal(slot.size) * (slot.upper - slot.lower)
            for label, slot in graph.actions().items()
        }

    def _planned(self, visit: Visit) -> Notes:
        """Plan at a visit's node, and return what is decided and expected."""
        graph, objective = self._planning.graph, self._planning.objectives[visit.node]
        known = self._knowledge.at[visit.step]
        actions, selections = self.decision
        # What is known little must be given its best chance while there is time to try: planned for all that may go
        # wrong, it would be left alone, or done where nothing can go right either, and would never be learned.
        with _as_zero(self._planning.spreads if self._explore.explores else ()):
            plan = solve(
                objective,
                {label: known[label] for label in graph.states() if label in known},
                self._planning.optimizer,
                guess=[*([{**actions, **selections}] if actions or selections else []), *self._starts],
                fixed=self._fixed,
                seed=zlib.crc32(repr((self._planning.seed, self._number, visit.step)).encode()),
                progress=False,
            )
        if plan.status.startswith("interrupted"):  # solve returns what it has; the loop is to stop
            raise KeyboardInterrupt
        explores = plan.status.startswith("exploring")
        ahead = _ahead(objective.tree)
        # What lies behind stays as it was.
        decided = {
            label: value if explores else self._disturbed(label, value)
            for label, value in plan.actions.items()
            if label in ahead or label not in actions
        }
        selected = {label: c for label, c in plan.selections.items() if label in ahead or label not in selections}
        kinds = (("selections", list(graph.selections())), ("actions", list(graph.actions())))
        drawn = [kind for kind, labels in kinds if any(label in self._fixed for label in labels)]
        return {
            "actions": {**actions, **decided},
            "selections": {**selections, **selected},
            "planned": plan.actions,
            "value": plan.value,
            "status": plan.status,
            "explored": plan.status if explores else f"drawn: {', '.join(drawn)}" if drawn else "",
            "expected": _expected(plan),
        }

    def _disturbed(self, label: str, value: Any) -> Any:
        slot = self._planning.graph.slots[label]
        if label in self._fixed or not self._explore.noise or not isinstance(slot, Action):
            return value
        column = np.clip(value + self._disturbance[label], slot.lower, slot.upper)
        return float(column[0]) if slot.size == 1 else column


def tries_of(planning: Planning, knowledge: Knowledge, visits: Sequence[Visit], info: Mapping[str, Any]) -> list[Try]:
    """Return the choices that were executed in an episode, from its visits and what was noted when it ended.

    A choice is one try in an attempt, where it first mattered.
    """
    left = {visit.parent: visit.selections for visit in visits if visit.parent is not None}
    if "failed_at" in info:
        left[info["failed_at"]] = info["selections"]
    tries: list[Try] = []
    made: set[str] = set()
    for step, selections in sorted(left.items()):
        parent = visits[step].parent
        if parent is not None and visits[parent].node == planning.again:
            made = set()
        tries += _tries_at(planning, knowledge, visits[step], selections, made)
    return tries


def _tries_at(
    planning: Planning, knowledge: Knowledge, visit: Visit, selections: Mapping[str, str], made: set[str]
) -> list[Try]:
    """Return the try that leaving a visit's node is, and add its selections to those made in the attempt.

    None where neither the way nor a model depends on another selection.
    """
    used: set[str | None] = set()
    for group in planning.graph.groups.get(visit.node, ()):
        if group.kind != "reward":
            models = [group.probability, *(branch.model for branch in group.branches)]
            used.update([group.selection], *(model.reads for model in models if isinstance(model, BoundModel)))
    new = {label: choice for label, choice in selections.items() if label in used - made}
    made.update(new)
    return [(_situation(planning, knowledge, visit.step), new)] if new else []


def _situation(planning: Planning, knowledge: Knowledge, step: int) -> Array:
    return situation_of(planning.graph, planning.informative, knowledge.at[step], knowledge.at[0])


@contextmanager
def _as_zero(parameters: Sequence[Parameter]) -> Iterator[None]:
    """Let parameters be 0 in between. In other threads they are 0 meanwhile as well: a loop belongs to one."""
    kept = [parameter.value for parameter in parameters]
    try:
        for parameter, value in zip(parameters, kept, strict=True):
            parameter.value = np.zeros_like(value)
        yield
    finally:
        for parameter, value in zip(parameters, kept, strict=True):
            parameter.value = value


def _ahead(tree: Tree) -> set[str]:
    """Return the labels that something in a tree depends on."""
    selected = {str(group.group.selection) for node in tree.nodes for group in node.groups if group.group.selection}
    return selected.union(*(model.reads for model in tree.models))


def _expected(plan: Plan) -> dict[str, Any]:
    """Return {label: mean} of the states on the way that the plan thinks most likely, later nodes over earlier ones."""
    expected: dict[str, Any] = {}
    for node in plan.nodes:
        if node.probability > 0.5:
            expected |= {label: gaussian.mean for label, gaussian in node.states.items()}
    return expected
