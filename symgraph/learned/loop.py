"""The on-line loop: plan, execute edge by edge, store, fit what was executed, and again."""

from __future__ import annotations

import os
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from symgraph.errors import InputError, StorageError, did_you_mean, names
from symgraph.graph import Graph
from symgraph.learned.deciding import Decider, Planning, tries_of
from symgraph.learned.episodes import EpisodeStore
from symgraph.learned.execution import Diverged, Execution, WorldFailed, returns_of
from symgraph.learned.inputs import checked_count
from symgraph.learned.knowledge import Knowledge
from symgraph.learned.past import Past
from symgraph.learned.records import Visit, checked_whole, shown
from symgraph.learned.report import EpisodeReport
from symgraph.learned.samples import Lessons
from symgraph.learned.schedule import Exploration, Stage, World
from symgraph.learned.storage import checked_path
from symgraph.objective import Objective
from symgraph.optimizers.problem import Optimizer
from symgraph.outcomes import ModelNumbers
from symgraph.plan import Plan
from symgraph.planner import solve
from symgraph.tree import unroll

STORE = "episodes.sqlite"  # in the folder of a loop


class OnlineLoop:
    """Learn a task by doing it: plan, execute, store, re-fit the models whose edge ran, and again.

    Everything is kept in a folder as it happens: the episodes in `episodes.sqlite`, an `EpisodeStore`, and the learned
    models as `<name>.safetensors`. A loop that is made anew with the same arguments goes on where the last one was
    stopped or killed, and ends as that one would have, if its worlds do the same again for the same seed. If they do
    not, as robots, the episode that was under way counts as interrupted, and what it had observed is learned from.

    Args:
        graph: the task; the models in it that can be fitted are learned.
        stages: which worlds, for how many episodes, see `Stage`.
        folder: of the files; made if it is not there.
        decisions: nodes at which is planned anew, beside the graph's start.
        again: a node at which the graph ends but from which the world may lead back to an earlier one; make that one
            of `decisions`.
        attempts: how often the graph is gone through in an episode, at most.
        optimizer: of the plans, `solve`'s default if left out.
        limits: {label: (low, high)}: values beyond are clipped before they are learned from; rare accidents would
            otherwise dominate a fit.
        remembered: how many start points of a plan come from the better half of the stage's past episodes.
        seed: of all that is random.

    Raises:
        InputError: an argument that does not fit, or a folder whose episodes come from other arguments.
        StorageError: a file that cannot be read or written.

    Source: Yamaguchi & Atkeson, Humanoids 2016, section VII-A.
    """

    def __init__(
        self,
        graph: Graph,
        stages: Sequence[Stage],
        folder: str | os.PathLike[str],
        *,
        decisions: Collection[str] = (),
        again: str | None = None,
        attempts: int = 1,
        optimizer: Optimizer | None = None,
        limits: Mapping[str, tuple[float, float]] | None = None,
        remembered: int = 4,
        seed: int = 0,
    ) -> None:
        if isinstance(stages, Stage) or not stages or not all(isinstance(stage, Stage) for stage in stages):
            raise InputError(f"stages = {stages!r}; give a list of Stage")
        _check_names(stages)
        self.graph = graph
        self.stages = tuple(stages)
        self.folder = checked_path(folder)
        self.decisions = tuple(dict.fromkeys((graph.start, *_checked_nodes(graph, decisions, again))))
        attempts = checked_count(attempts, "attempts")
        if again is None and attempts > 1:
            raise InputError(f"attempts = {attempts}, but nothing leads back; say with `again` where an attempt ends")
        seed = checked_whole(seed, "seed")
        self._past = Past(seed, checked_whole(remembered, "remembered"))
        self._models = ModelNumbers()
        self._lessons = Lessons(graph, {} if limits is None else limits, self.folder, seed)
        self._planning = Planning(
            graph,
            {node: Objective(unroll(graph, start=node)) for node in self.decisions},
            optimizer,
            again,
            attempts,
            seed,
            tuple(self._lessons.reads),
            tuple(p for lesson in self._lessons.all.values() for p in getattr(lesson.model, "spreads", ())),
        )
        # How many episodes are taken over, and samples of each model then. Changed at once, so that an exception at any
        # moment leaves what can be gone on from.
        self._taken = 0, self._lessons.counts()
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise StorageError(f"folder {self.folder} cannot be made: {error.strerror}; give another") from None
        self.store = EpisodeStore(self.folder / STORE)
        try:
            self.store.set_settings(self.settings)
            self._recall()
        except BaseException:
            self.store.close()
            raise

    @property
    def episodes(self) -> int:
        """How many episodes the stages have together."""
        return sum(stage.episodes for stage in self.stages)

    @property
    def done(self) -> int:
        """How many of them are over."""
        return len(self.store) - len(self.store.episodes(status="running"))

    @property
    def settings(self) -> dict[str, Any]:
        """What the episodes depend on, beside the worlds."""
        return {
            "slots": {label: repr(slot) for label, slot in self.graph.slots.items()},
            "nodes": self.graph.nodes,
            "learned": {name: lesson.model.settings for name, lesson in self._lessons.all.items()},
            "decisions": list(self.decisions),
            "again": self._planning.again,
            "attempts": self._planning.attempts,
            "remembered": self._past.remembered,
            "seed": self._planning.seed,
        }

    @property
    def objectives(self) -> dict[str, Objective]:
        """{node: objective} of the nodes where decisions are made, with what has been learned so far."""
        return dict(self._planning.objectives)

    def __iter__(self) -> Iterator[EpisodeReport]:
        """Run the episodes that are still to come, with a report after each."""
        while (number := self._next()) < self.episodes:
            yield self._learn(number)

    def plan(self, known: Mapping[str, Any], node: str | None = None) -> Plan:
        """Return the best plan from a node where decisions are made, with what has been learned so far.

        Args:
            known: {label: value} of what is known there; labels that are no states of the graph are ignored.
            node: the graph's start if left out.
        """
        node = self.graph.start if node is None else node
        if node not in self.decisions:
            raise InputError(
                f"nothing is planned at {node!r}{did_you_mean(node, self.decisions)} Decisions are made at: "
                f"{names(self.decisions)}"
            )
        if not isinstance(known, Mapping):
            raise InputError(f"known = {shown(known)}; give {{label: value}}")
        state = {label: known[label] for label in self.graph.states() if label in known}
        return solve(self._planning.objectives[node], state, self._planning.optimizer, progress=False)

    def perform(self, world: World, seed: int, given: Mapping[str, Any] | None = None) -> EpisodeReport:
        """Run an episode with the best plans; nothing is tried, learned or stored.

        While a model has too few samples, the plans are random, and the report's `explored` says so.

        Args:
            world: where.
            seed: of the world.
            given: {label: value} of states that its reset does not observe, as in `Stage`.
        """
        knowledge = self._knowledge()
        decider = Decider(self._planning, knowledge, 0, Exploration(episodes=0).at(0), self._past.starts(0, None))
        execution = Execution(self.graph, world, knowledge, 0, needed=self._needed)
        status, reason = "done", ""
        try:
            execution.run(
                seed, {} if given is None else given, decider.decide, lambda visits, new: None, decider.goes_on
            )
        except WorldFailed as failure:
            status, reason = "failed", str(failure)
            knowledge.latest |= failure.observed
        returns = returns_of(execution.visits, self._planning.again)
        return _report(0, "performed", seed, status, reason, returns, knowledge, decider, execution.seconds, 0.0)

    def close(self) -> None:
        """Close the store."""
        self.store.close()

    def __enter__(self) -> OnlineLoop:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _next(self) -> int:
        """Return the number of the episode that is to be run, or gone on with."""
        running = self.store.episodes(status="running")
        return running[0].number if running else len(self.store)

    def _learn(self, number: int) -> EpisodeReport:
        """Run an episode, or go on with it, and learn from it."""
        stage, within = self._stage_of(number)
        (seed,) = np.random.SeedSequence([self._planning.seed, number]).generate_state(1).tolist()
        self._catch_up(number)
        past, plans = self.store.visits(number), self.store.plans(number)
        knowledge = self._knowledge()
        execution = Execution(self.graph, stage.world, knowledge, number, past, self._needed)
        decider = Decider(
            self._planning,
            knowledge,
            number,
            stage.explore.at(within),
            self._past.starts(number, stage.name),
            self._past.tries,
            plans,
            lambda step, notes: self.store.note_plan(number, step, notes),
        )
        fitting = 0.0

        def reached(visits: list[Visit], new: bool) -> None:
            nonlocal fitting
            if new and visits[0].parent is None:
                first = visits[0]
                self.store.begin(number, stage.name, seed, first.observed, first.reward, node=first.node)
            elif new:
                self.store.add(visits)
            begin = time.perf_counter()
            self._lessons.fit(self._lessons.take(execution.visits, visits, knowledge))
            fitting += time.perf_counter() - begin

        status, reason, visits = "done", "", execution.visits
        failed: dict[str, Any] = {}
        try:
            execution.run(seed, stage.given_at(within), decider.decide, reached, decider.goes_on)
        except Diverged as error:
            status, reason, visits = "interrupted", str(error), past
            knowledge = self._knowledge()
            knowledge.take_over(past)
            decider.recall()
            self._lessons.rewind(self._taken[1])
            self._lessons.fit(self._lessons.take(past, past, knowledge))
        except WorldFailed as failure:
            status, reason = "failed", str(failure)
            failed = {"observed": failure.observed, "failed_at": failure.step}
            knowledge.latest |= failure.observed
        returns = returns_of(visits, self._planning.again)
        report = _report(
            number, stage.name, seed, status, reason, returns, knowledge, decider, execution.seconds, fitting
        )
        info = {name: getattr(report, name) for name in ("returns", "selections", "value", "explored")} | failed
        self.store.end(number, status, total=report.total, reason=reason, seconds=report.seconds, info=info)
        tries = tries_of(self._planning, knowledge, visits, info)
        self._past.add(stage.name, status, report.total, decider.plans, tries)
        self._taken = number + 1, self._lessons.counts()
        return report

    def _recall(self) -> None:
        """Take over what the folder holds."""
        self._lessons.restore()
        for episode in self.store.episodes():
            stage = self._stage_of(episode.number)[0] if episode.number < self.episodes else None
            if stage is None or stage.name != episode.setup:
                wanted = "no such episode" if stage is None else f"stage {stage.name!r} there"
                raise InputError(
                    f"{self.folder / STORE}: episode {episode.number} is of stage {episode.setup!r}, but the stages "
                    f"have {wanted}; give those it was made with, or another folder"
                )
        number = self._next()
        self._catch_up(number)
        # One that is running is gone through again, and learned from, by and by; its samples may have been fitted.
        running = self.store.visits(number)
        knowledge = self._knowledge()
        knowledge.take_over(running)
        self._lessons.take(running, running, knowledge)
        self._lessons.check_seen()
        self._lessons.rewind(self._taken[1])
        self._lessons.fit(self._lessons.all.values())

    def _catch_up(self, number: int) -> None:
        """Take over, from the store, the episodes before a number, and nothing else."""
        over, counts = self._taken
        self._lessons.rewind(counts)
        self._past.rewind(over)
        for episode in self.store.episodes()[over:number] if over < number else ():
            visits = self.store.visits(episode.number)
            knowledge = self._knowledge()
            knowledge.take_over(visits)
            self._lessons.take(visits, visits, knowledge)
            plans = self.store.plans(episode.number)
            tries = tries_of(self._planning, knowledge, visits, episode.info)
            self._past.add(episode.setup, episode.status, episode.total, plans, tries)
        self._taken = number, self._lessons.counts()

    def _stage_of(self, number: int) -> tuple[Stage, int]:
        """Return the stage of an episode and its place in it."""
        for stage in self.stages:
            if number < stage.episodes:
                return stage, number
            number -= stage.episodes
        raise InputError(f"the stages have {self.episodes} episodes only")

    def _knowledge(self) -> Knowledge:
        return Knowledge(self.graph, self._models, self.decisions)

    @property
    def _needed(self) -> dict[str, str]:
        """{state: place that reads it} of those that every episode must begin with."""
        return self._planning.objectives[self.graph.start].tree.needed_states


def _check_names(stages: Sequence[Stage]) -> None:
    """Raise InputError where two stages have one name: nobody could tell their episodes apart."""
    first: dict[str, int] = {}
    for i, name in enumerate(stage.name for stage in stages):
        if first.setdefault(name, i) != i:
            raise InputError(
                f"stages[{first[name]}] and stages[{i}] are both named {name!r}; give each a name of its own, "
                f"under which its episodes are stored"
            )


def _checked_nodes(graph: Graph, decisions: Any, again: Any) -> list[str]:
    """Return the nodes of decisions; raise InputError where the graph has no such nodes."""
    if isinstance(decisions, str) or not isinstance(decisions, Iterable):
        raise InputError(f"decisions = {decisions!r}; give a list of nodes")
    nodes = list(decisions)
    for place, node in [*(("decisions", node) for node in nodes), *([] if again is None else [("again", again)])]:
        if node not in graph.nodes:
            hint = did_you_mean(node, graph.nodes)
            raise InputError(f"{place}: {node!r} is no node of the graph{hint} Nodes: {names(graph.nodes)}")
    for node in nodes:
        if all(group.kind == "reward" for group in graph.groups.get(node, ())):
            raise InputError(f"decisions: the graph ends at {node!r}, so there is nothing to decide; leave it out")
    if any(group.kind != "reward" for group in graph.groups.get(again, ())):
        raise InputError(f"again: branches lead on from {again!r}; give a node at which the graph ends")
    return nodes


def _report(
    number: int,
    setup: str,
    seed: int,
    status: str,
    reason: str,
    returns: tuple[float, ...],
    knowledge: Knowledge,
    decider: Decider,
    simulating: float,
    fitting: float,
) -> EpisodeReport:
    actions, selections = decider.decision
    return EpisodeReport(
        number=number,
        setup=setup,
        seed=seed,
        status=status,
        reason=reason,
        returns=returns,
        actions=actions,
        selections=selections,
        expected=decider.notes.get("expected", {}),
        value=decider.notes.get("value", float("nan")),
        explored=decider.notes.get("explored", ""),
        known=knowledge.latest,
        seconds={"simulating": simulating, "planning": decider.seconds, "fitting": fitting},
    )
