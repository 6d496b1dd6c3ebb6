"""CPlanner: a generated planner, compiled and called from Python."""

from __future__ import annotations

import ctypes
import math
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, get_args

import numpy as np

from symgraph.codegen.ctypes_of import Structures, array_of
from symgraph.codegen.description import StateSlot
from symgraph.codegen.library import Library
from symgraph.compile.kernel import Outcome
from symgraph.errors import InputError, SolveError, did_you_mean, names
from symgraph.objective import checked_column
from symgraph.optimizers.settings import number, positive_whole
from symgraph.outcomes import NodeOutcome
from symgraph.plan import Plan, PlanRun
from symgraph.slots import Array, Gaussian, unchecked_gaussian

TIME_LIMIT, EVALUATION_LIMIT, INTERRUPTED, NO_PLAN = 1, 2, 3, -1  # of the header's statuses
LOOK = 0.05  # [s] between looks at whether Ctrl-C was pressed: another thread may have got the signal
MOST_EVALUATIONS = 2**31 - 1  # that a long holds anywhere
MOST_RUNS = 4096  # that a plan tells of

_OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)  # in the order of walks.c


class CPlanner:
    """A planner that `export_c` wrote, compiled for this machine, with the interface of `solve` and of an `Objective`.

    Several threads may call it at once.

    Args:
        folder: what `export_c` returned.
        name: of the planner, if the folder holds several.

    Raises:
        StorageError: no planner is there, several are, or a file of it is damaged.
        CompileError: there is no C compiler, or it refused.
    """

    def __init__(self, folder: str | Path, name: str | None = None) -> None:
        self.folder = Path(folder)
        self._library = Library(self.folder, name)
        self.description = self._library.description
        self._structures = Structures(self.description)
        self._worker: tuple[int, ThreadPoolExecutor] | None = (
            None  # kept: to begin a thread can take longer than to plan
        )

    def __repr__(self) -> str:
        d = self.description
        given = names(slot.label for slot in d.given)
        return f"CPlanner({str(self.folder)!r}: {d.name}, {d.optimizer}, {d.precision} precision, given {given})"

    def solve(
        self,
        state: Mapping[str, Any],
        *,
        guess: Any = None,
        fixed: Mapping[str, Any] | None = None,
        seed: int = 0,
        time_limit: float | None = None,
        evaluations: int | None = None,
    ) -> Plan:
        """Find the best actions and selections; the optimizer is the one that was exported.

        Args:
            state: label → number, array or Gaussian [unit], as for `solve`.
            guess: start points to add: a plan, {label: value} of some actions and selections, or a list of them.
            fixed: {label: value} of actions and selections that are held.
            seed: of all that is random; with the same seed `solve` finds the same plan, but for rounding.
            time_limit: after which the best so far is returned [s].
            evaluations: after which the best so far is returned.

        Returns:
            a plan; its runs have no history.

        Raises:
            InputError: a state, guess or fixed value that does not fit.
            SolveError: no point with a finite value was found.
        """
        begin = time.perf_counter()
        if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or not 0 <= seed < 2**64:
            raise InputError(f"seed = {seed!r}; give a whole number in [0, 2^64)")
        if time_limit is not None:
            number("time_limit", time_limit, "solve", 0.0)
        if evaluations is not None:
            positive_whole("evaluations", evaluations, "solve")
        guesses = _listed(guess)
        if len(guesses) > self.description.most_starts:
            raise InputError(f"{len(guesses)} guesses; this planner takes at most {self.description.most_starts}")
        made = self._structures
        starts = (made.point * max(len(guesses), 1))(*(self._point(one, "guess", clips=True) for one in guesses))
        held = self._point({} if fixed is None else fixed, "fixed", clips=False)
        runs = (made.run * MOST_RUNS)()
        stop = ctypes.c_int(0)
        options = made.options(
            seed=int(seed),
            evaluations=min(evaluations or 0, MOST_EVALUATIONS),
            # No time at all is as little as there can be; 0 is no limit.
            seconds=0.0 if time_limit is None else max(float(time_limit), 1e-12),
            clock=self._library.address("clock"),
            progress=self._library.address("progress"),
            user=ctypes.addressof(stop),
            starts=ctypes.addressof(starts),
            start_count=len(guesses),
            held=ctypes.addressof(held),
            runs=ctypes.addressof(runs),
            run_room=MOST_RUNS,
        )
        column, plan = self._state(state), made.plan()

        def search() -> int:
            with self._library.planner() as planner:
                kept = starts, held, runs, stop  # options know their addresses only
                status = self._library.call("solve", planner, column, ctypes.byref(options), ctypes.byref(plan))
                del kept
                return status

        status = self._interruptible(search, stop)
        if status == NO_PLAN and stop.value:
            raise KeyboardInterrupt
        if status == NO_PLAN and (time_limit is not None or evaluations is not None):
            raise SolveError("no point with a finite value was found within the limit; give more time or evaluations")
        if status == NO_PLAN:
            raise SolveError(
                "no start point has a finite value; look for square roots and divisions at 0 in the models"
            )
        actions, selections = self._labelled(plan.actions), self._chosen(plan.selections)
        return Plan(
            actions=actions,
            selections=selections,
            value=plan.value,
            violation=plan.violation,
            status=self._told(status, plan),
            notes=self.description.notes,
            nodes=self._outcomes(column, plan.actions, plan.selections),
            runs=[self._run(run) for run in runs[: min(plan.runs, MOST_RUNS)]],
            optimizer=f"{self.description.optimizer} in C ({plan.evaluations} evaluations)",
            seed=int(seed),
            seconds=time.perf_counter() - begin,
            units=self.description.units,
        )

    def value(
        self,
        state: Mapping[str, Any],
        actions: Mapping[str, Any] | None = None,
        selections: Mapping[str, str] | None = None,
    ) -> float:
        """Return the expected sum of rewards, as `Objective.value` does."""
        value = ctypes.c_double()
        self._call("value", state, actions, selections, ctypes.byref(value))
        return value.value

    def gradient(
        self,
        state: Mapping[str, Any],
        actions: Mapping[str, Any] | None = None,
        selections: Mapping[str, str] | None = None,
    ) -> dict[str, Any]:
        """Return ∂J/∂action for each action label, as `Objective.gradient` does."""
        value, slopes = ctypes.c_double(), self._structures.actions()
        self._call("gradient", state, actions, selections, ctypes.byref(value), slopes)
        return self._labelled(slopes)

    def violation(
        self,
        state: Mapping[str, Any],
        actions: Mapping[str, Any] | None = None,
        selections: Mapping[str, str] | None = None,
    ) -> float:
        """Return the largest breach of a requirement, as `Objective.violation` does."""
        violation = ctypes.c_double()
        if self.description.demands:
            self._call("violation", state, actions, selections, ctypes.byref(violation))
        return violation.value

    def outcomes(
        self,
        state: Mapping[str, Any],
        actions: Mapping[str, Any] | None = None,
        selections: Mapping[str, str] | None = None,
    ) -> list[NodeOutcome]:
        """Return what happens at every node, as `Objective.outcomes` does."""
        point = self._complete(actions, selections)
        return self._outcomes(self._state(state), point.actions, point.selections)

    def _interruptible(self, search: Callable[[], int], stop: ctypes.c_int) -> int:
        """Carry out a search so that Ctrl-C ends it early: no signal interrupts C."""
        if threading.current_thread() is not threading.main_thread():
            return search()
        if self._worker is None or self._worker[0] != os.getpid():  # a fork takes no threads with it
            self._worker = os.getpid(), ThreadPoolExecutor(1, "symgraph")
        task = self._worker[1].submit(search)
        while True:
            try:
                wait([task], LOOK)
                if task.done():
                    return task.result()
            except KeyboardInterrupt:
                stop.value = 1

    # what C is given

    def _state(self, state: Mapping[str, Any]) -> Any:
        given = self.description.given
        if not isinstance(state, Mapping):
            raise InputError(f"state is {type(state).__name__}; give {{label: number, array or Gaussian}}")
        known = {*(slot.label for slot in self.description.states), *self.description.unread}
        needed = [slot.label for slot in given]
        for label in state:
            if label not in known:
                raise InputError(f"state {label!r} is not a slot{did_you_mean(label, needed)} States: {names(needed)}")
        for label in needed:
            if label not in state:
                raise InputError(f"state {label!r} is missing; this planner needs {names(needed)}")
        means, covariances = [], []
        for slot in given:
            mean, covariance = _moments(slot, state[slot.label])
            means.append(mean)
            covariances.append(covariance)
        return self._structures.state(*np.concatenate([np.zeros(0), *means, *covariances]).tolist())

    def _point(self, values: Any, place: str, clips: bool) -> Any:
        """Return {label: value} of some actions and selections as a point; what is left out is NaN and -1."""
        if not isinstance(values, Mapping):
            if not hasattr(values, "actions"):
                raise InputError(f"{place} is {values!r}; give a plan or {{label: value}}")
            values = {**values.actions, **values.selections}
        d, point, at = self.description, self._structures.point(), 0
        labels = d.decided
        for label in values:
            if label not in labels:
                hint = did_you_mean(label, labels)
                raise InputError(f"{place}: {label!r} is no action or selection{hint} There are {names(labels)}")
        for action in d.actions:
            column = np.full(action.size, np.nan)
            if action.label in values:
                column = checked_column(values[action.label], action.size, f"{place}: action {action.label!r}")
                if clips:
                    column = np.clip(column, action.low, action.high)
            point.actions[at : at + action.size] = column.tolist()
            at += action.size
        for s, selection in enumerate(d.selections):
            choice = values.get(selection.label)
            if choice is not None and choice not in selection.choices:
                hint = did_you_mean(choice, selection.choices)
                raise InputError(
                    f"{place}: selection {selection.label!r}: {choice!r} is not a choice{hint} "
                    f"Choices: {names(selection.choices)}"
                )
            point.selections[s] = -1 if choice is None else selection.choices.index(choice)
        return point

    def _complete(self, actions: Mapping[str, Any] | None, selections: Mapping[str, str] | None) -> Any:
        given = {**(actions or {}), **(selections or {})}
        for label in self.description.decided:
            if label not in given:
                raise InputError(f"{label!r} is missing; give a value to each of {names(self.description.decided)}")
        return self._point(given, "given", clips=False)

    # what C returns

    def _call(
        self,
        name: str,
        state: Mapping[str, Any],
        actions: Mapping[str, Any] | None,
        selections: Mapping[str, str] | None,
        *results: Any,
    ) -> None:
        point, column = self._complete(actions, selections), self._state(state)
        with self._library.planner() as planner:
            self._library.call(name, planner, column, point.actions, point.selections, *results)

    def _outcomes(self, state: Any, actions: Any, selections: Any) -> list[NodeOutcome]:
        d, out = self.description, self._structures.outcomes()
        with self._library.planner() as planner:
            self._library.call("foresee", planner, state, actions, selections, ctypes.byref(out))
        moments = array_of(out.moments)
        known: list[dict[str, Gaussian]] = []
        for i, node in enumerate(d.nodes):
            here = dict(known[node.parent]) if node.parent >= 0 else {}
            for at, state_index, mean, covariance in d.writes:
                if at == i:
                    slot = d.states[state_index]
                    here[slot.label] = _gaussian(moments, slot.size, mean, covariance)
            known.append(here)
        order = [slot.label for slot in d.states]
        return [
            NodeOutcome(
                path=node.path,
                node=node.node,
                probability=out.probability[i],
                states={label: known[i][label] for label in order if label in known[i]},
                reward=out.reward[i],
                value=out.value[i],
                deviation=out.deviation[i],
                cut=node.cut,
            )
            for i, node in enumerate(d.nodes)
        ]

    def _labelled(self, numbers: Any) -> dict[str, Any]:
        column, made, at = array_of(numbers), {}, 0
        for slot in self.description.actions:
            part = column[at : at + slot.size]
            made[slot.label] = float(part[0]) if slot.size == 1 else part
            at += slot.size
        return made

    def _chosen(self, choices: Any) -> dict[str, str]:
        return {slot.label: slot.choices[choices[s]] for s, slot in enumerate(self.description.selections)}

    def _run(self, run: Any) -> PlanRun:
        return PlanRun(
            selections=self._chosen(run.selections),
            start=self._labelled(run.start),
            actions=self._labelled(run.actions),
            value=run.value,
            outcome=_OUTCOMES[run.outcome],
            gradients=run.gradients,
            history=(),
        )

    def _told(self, status: int, plan: Any) -> str:
        d = self.description
        combinations = math.prod(len(slot.choices) for slot in d.selections)
        told = f"best of {plan.starts} starts"
        if plan.tried < combinations:
            told += f", which tried {plan.tried} of {combinations} combinations of selections"
        elif d.optimizer.startswith("Enumerate"):
            told = f"enumerated {combinations} combinations of selections: {told}"
        heads = {TIME_LIMIT: "time limit: ", EVALUATION_LIMIT: "evaluation limit: ", INTERRUPTED: "interrupted: "}
        missed = ""
        if plan.worst >= 0:
            missed = f"requirements are missed: {d.demands[plan.worst].told} by {plan.missed:.3g}; "
        return f"{missed}{heads.get(status, '')}{told}"


def _listed(guess: Any) -> list[Any]:
    if guess is None:
        return []
    if isinstance(guess, Sequence) and not isinstance(guess, str):
        return list(guess)
    return [guess]


def _moments(slot: StateSlot, value: Any) -> tuple[Array, Array]:
    if isinstance(value, Gaussian):
        mean = checked_column(value.mean, slot.size, f"state {slot.label!r}")
        covariance = np.asarray(value.covariance, dtype=float)
        if covariance.any() and not slot.uncertain:
            raise InputError(
                f"state {slot.label!r} comes with a covariance, but this planner takes it for exact: "
                f"export it with uncertain=[{slot.label!r}]"
            )
        return mean, covariance.ravel(order="F") if slot.uncertain else np.zeros(0)
    column = checked_column(value, slot.size, f"state {slot.label!r}")
    return column, np.zeros(slot.size**2 if slot.uncertain else 0)


def _gaussian(moments: Array, size: int, mean: int, covariance: int) -> Gaussian:
    spread = np.zeros(size**2) if covariance < 0 else moments[covariance : covariance + size**2]
    return unchecked_gaussian(moments[mean : mean + size], spread.reshape(size, size, order="F"))
