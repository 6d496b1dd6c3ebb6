"""solve: from an objective and a state to a plan."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, overload

import numpy as np

from symgraph.binding import BoundModel
from symgraph.compile.crew import cores
from symgraph.compile.kernel import BoundKernel, Stop
from symgraph.constraints import counting
from symgraph.errors import InputError, SolveError, did_you_mean, names
from symgraph.exploration import Decisions, explore, lacking_models, met
from symgraph.objective import Objective, check_choice, checked_column, stacked_index
from symgraph.optimizers.constrained import Constrained
from symgraph.optimizers.draws import generator
from symgraph.optimizers.lbfgs import Lbfgs
from symgraph.optimizers.problem import Optimizer, Problem, Run, Search, best_of
from symgraph.optimizers.settings import number, positive_whole
from symgraph.outcomes import NodeOutcomes
from symgraph.plan import Plan, PlanRun
from symgraph.plan_table import PlanRow
from symgraph.progress import Progress
from symgraph.situation import Situation
from symgraph.slots import Action, Array, Choices, Selection, State

ROUNDING, SMALL = 1e-7, 1e-9  # of a value, and of the spread of J: differences that are rounding
MOST_TOLD = 8  # requirements that a plan says to be missed

Guess = Plan | PlanRow | Mapping[str, Any]


def solve(
    objective: Objective,
    state: Mapping[str, Any],
    optimizer: Optimizer | None = None,
    *,
    guess: Guess | Sequence[Guess] | None = None,
    fixed: Mapping[str, Any] | None = None,
    seed: int = 0,
    time_limit: float | None = None,
    threads: int = 1,
    progress: bool = True,
) -> Plan:
    """Find the actions and selections with the highest expected sum of rewards that meet all requirements.

    Where no plan meets them, the one whose largest breach is least, and of these the best; its status says what is
    missed. The first call compiles the objective (a fraction of a second to a minute, kept on disk); later ones
    only search. While a learned model that the plan could meet has too few samples, the plan is a random one that leads
    to it, and its status begins with "exploring".

    Ctrl-C ends a search early: the plan is the best that was found, its status begins with "interrupted". Where nothing
    was found yet it is a KeyboardInterrupt.

    Args:
        objective: what to maximise.
        state: label → number, array or Gaussian [unit], as in `Objective.value`.
        optimizer: `Lbfgs()` if left out: it finds the best plan soonest; `Adadelta()`, `Ipopt()`, … otherwise.
        guess: start points to add: a plan, a row of `solve_many`, {label: value} of some actions and selections, or a
            list of them.
        fixed: {label: value} of actions and selections that are held.
        seed: of all that is random; the same seed gives the same plan, unless time runs out.
        time_limit: after which the best so far is returned [s]; building and compiling at first use come on top.
        threads: that share the work where J is compiled; plans are the same. More than one pays where a gradient
            takes long, as with wide networks, and where there is a free core for each; there are never more than cores.
        progress: show a progress bar where it takes longer than two seconds.

    Raises:
        InputError: a state, guess or fixed value that does not fit.
        SolveError: no start point led to a finite value.
    """
    if not isinstance(objective, Objective):
        raise InputError(f"solve takes an Objective, got {type(objective).__name__}; write Objective(unroll(graph))")
    optimizer = Lbfgs() if optimizer is None else optimizer
    if not isinstance(optimizer, Optimizer):
        raise InputError(f"optimizer is {optimizer!r}; give one, e.g. Lbfgs(), with its parentheses")
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InputError(f"seed = {seed!r}; give a whole number of at least 0")
    if time_limit is not None:
        number("time_limit", time_limit, "solve", 0.0)
    positive_whole("threads", threads, "solve")
    held = {} if fixed is None else fixed
    begin = time.perf_counter()
    situation = objective.situation(state)
    stop = Stop(time_limit)
    with Progress("planning", progress) as bar:
        if not situation.build.has_kernel:
            bar.wait("compiling")
        problem = _problem(objective, situation, guess, held, bar, stop, min(int(threads), cores()))
        bar.begin("planning")
        rng = generator(int(seed))
        selections = list(objective.graph.selections())
        lacking = lacking_models(objective.tree, dict(zip(selections, problem.allowed, strict=True)))
        search = _explored(objective, situation, problem, selections, lacking, int(seed)) if lacking else None
        explores = search is not None
        if search is None:
            with _set_in_time(stop):
                search = optimizer.run(problem, rng)
    found = _told_exactly(objective, situation, problem, search, explores)
    if found is None:
        if search.interrupted:
            raise KeyboardInterrupt
        raise SolveError(_why_not_finite(objective, situation, search))
    best, nodes = found
    chosen = _names(objective, best.choices)
    violation = float(objective.breaches(situation, best.point, objective.one_hot(chosen)).max(initial=0.0))
    status = search.status
    if search.interrupted:
        status = f"interrupted: best of {len(search.runs)} runs"
    elif stop:
        status = f"time limit: {status}"
    missed = _told(objective, problem, best)
    if missed:
        status = f"requirements are missed: {missed[0]}; {status}"
    planned_or_seen: dict[str, Action | State] = {**objective.graph.actions(), **objective.graph.states()}
    return Plan(
        actions=objective.unstack(best.point),
        selections=chosen,
        value=best.value,
        violation=violation,
        status=status,
        notes=(
            *missed[1:MOST_TOLD],
            *_held_outside(objective, held),
            *nodes.notes(),
            *([] if explores else _seldom(lacking)),
        ),
        nodes=nodes,
        runs=_Runs(objective, search.runs),
        optimizer="uniform draw" if explores else type(optimizer).__name__,
        seed=int(seed),
        seconds=time.perf_counter() - begin,
        units={label: slot.unit for label, slot in planned_or_seen.items() if slot.unit},
    )


@contextmanager
def _set_in_time(stop: Stop) -> Iterator[None]:
    """Set a stop after its seconds while something goes on."""
    timer = threading.Timer(min(float(stop.seconds or 0.0), threading.TIMEOUT_MAX), stop.set)
    if stop.seconds is not None:
        timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _told_exactly(
    objective: Objective, situation: Situation, problem: Problem, search: Search, explores: bool
) -> tuple[Run, NodeOutcomes] | None:
    """Return the best run with its outcomes, and give it the value that follows from these.

    Compiled code rounds otherwise than models do in numbers, and in single precision much more. Where a model jumps, a
    search may end on an edge where its own arithmetic alone stays: then the next best run counts.
    """
    told: set[int] = set()
    while (best := search.runs[0] if explores else best_of(search.runs)) is not None:
        nodes = objective.outcomes_of(situation, best.point, _names(objective, best.choices))
        value = nodes.worth(objective.risk)
        rounding = ROUNDING * abs(best.value) + SMALL * problem.scale(best.choices)
        if explores or id(best) in told or abs(value - best.value) <= rounding:
            return best, nodes
        best.value = value if np.isfinite(value) else -np.inf
        told.add(id(best))
    return None


def _told(objective: Objective, problem: Problem, run: Run) -> list[str]:
    """Say which constraints are missed and by how much, the worst first."""
    if problem.constrained is None:
        return []
    breaches = problem.constrained.breaches(run.point, run.choices, problem.one_hot(run.choices[None])[0])
    constraints = problem.situation.build.expectation.constraints
    worst = [k for k in np.argsort(-breaches) if breaches[k] != 0.0]
    return [f"{constraints[k].told(objective.tree)} by {breaches[k]:.3g}" for k in worst]


def _explored(
    objective: Objective,
    situation: Situation,
    problem: Problem,
    selections: list[str],
    lacking: Mapping[BoundModel, Decisions],
    seed: int,
) -> Search | None:
    """Return a random plan, or None where it would meet what lacks samples too seldom."""
    search = explore(problem, selections, lacking, seed)
    drawn = search.runs[0]
    nodes = objective.outcomes_of(situation, drawn.point, _names(objective, drawn.choices))
    return search if met(nodes, lacking) else None


def _seldom(lacking: Mapping[BoundModel, Decisions]) -> list[str]:
    """Say which models were planned with although they lack samples."""
    return [f"model {model.name!r} has {model.lacking}; it is met too seldom to explore" for model in lacking]


def _problem(
    objective: Objective,
    situation: Situation,
    guess: Guess | Sequence[Guess] | None,
    fixed: Mapping[str, Any],
    progress: Progress,
    stop: Stop,
    threads: int,
) -> Problem:
    low, high = (bound.copy() for bound in objective.bounds)
    selections = objective.graph.selections()
    where = stacked_index(objective.graph.actions())
    allowed = {label: tuple(range(slot.size)) for label, slot in selections.items()}
    if not isinstance(fixed, Mapping):
        raise InputError(f"fixed is {fixed!r}; give {{label: value}}")
    for label, value in fixed.items():
        slot = _planned_slot(objective, label, "fixed")
        if isinstance(slot, Action):
            low[where[label]] = high[where[label]] = checked_column(value, slot.size, f"fixed action {label!r}")
        else:
            check_choice(label, value, slot)
            allowed[label] = (slot.choices.index(value),)
    return Problem(
        kernel=situation.bind(low, high, stop, threads),
        situation=situation,
        low=low,
        high=high,
        sizes=tuple(slot.size for slot in selections.values()),
        allowed=tuple(allowed.values()),
        cut=lambda choices: objective.chosen(_names(objective, choices)).situation(situation.given),
        guesses=tuple(_guess(objective, one, allowed) for one in _listed(guess)),
        progress=progress,
        constrained=_constrained(objective, situation, low, high, stop, progress),
        stop=stop,
    )


def _constrained(
    objective: Objective, situation: Situation, low: Array, high: Array, stop: Stop, progress: Progress
) -> Constrained | None:
    constraints = situation.build.expectation.constraints
    if not constraints:
        return None

    def merit(multipliers: Array, weights: Array) -> BoundKernel:
        if not situation.build.has_merit_kernel:
            progress.wait("compiling")
            situation.build.merit_kernel.compile_for_one()
            progress.begin("planning")
        return situation.bind_merit(low, high, multipliers, weights, stop)

    return Constrained(
        constraints,
        *objective.bounds,
        lambda choices: counting(constraints, _names(objective, choices)),
        lambda actions, hot: situation.build.margins([actions, hot, *situation.shared])[0],
        merit,
    )


def _held_outside(objective: Objective, fixed: Mapping[str, Any]) -> list[str]:
    """Say which actions are held outside their bounds."""
    actions = objective.graph.actions()
    notes = []
    for label in fixed:
        if label in actions:
            column = np.ravel(fixed[label])
            if (column < actions[label].lower).any() or (column > actions[label].upper).any():
                notes.append(f"{label!r} is held at {fixed[label]!r}, outside its bounds")
    return notes


def _listed(guess: Guess | Sequence[Guess] | None) -> list[Guess]:
    if guess is None:
        return []
    if isinstance(guess, (Plan, PlanRow, Mapping)):
        return [guess]
    if isinstance(guess, Sequence) and all(isinstance(one, (Plan, PlanRow, Mapping)) for one in guess):
        return list(guess)
    raise InputError(f"guess is {guess!r}; give a plan, {{label: value}}, or a list of them")


def _guess(objective: Objective, guess: Guess, allowed: Mapping[str, tuple[int, ...]]) -> tuple[Any, Any]:
    """Turn a guess into actions (n,), NaN where left out, and choices (s,), -1 where left out or ruled out."""
    values = guess if isinstance(guess, Mapping) else {**guess.actions, **guess.selections}
    where = stacked_index(objective.graph.actions())
    point = np.full(objective.n_actions, np.nan)
    choices = dict.fromkeys(allowed, -1)
    for label, value in values.items():
        slot = _planned_slot(objective, label, "guess")
        if isinstance(slot, Action):
            point[where[label]] = checked_column(value, slot.size, f"guess for action {label!r}")
        else:
            check_choice(label, value, slot)
            choice = slot.choices.index(value)
            choices[label] = choice if choice in allowed[label] else -1
    return point, np.array(list(choices.values()), dtype=np.int64)


def _planned_slot(objective: Objective, label: str, place: str) -> Action | Selection:
    slots = objective.graph.slots
    slot = slots.get(label)
    if isinstance(slot, (Action, Selection)):
        return slot
    planned = [name for name, s in slots.items() if isinstance(s, (Action, Selection))]
    if slot is not None:
        raise InputError(
            f"{place}: {label!r} is a state; give it in the state. Actions and selections: {names(planned)}"
        )
    hint = did_you_mean(label, planned)
    raise InputError(f"{place}: {label!r} is no action or selection{hint} Actions and selections: {names(planned)}")


def _names(objective: Objective, choices: Choices) -> dict[str, str]:
    """Return {label: choice} of choices (s,)."""
    slots = objective.graph.selections().items()
    return {label: slot.choices[int(c)] for (label, slot), c in zip(slots, choices, strict=True)}


def _why_not_finite(objective: Objective, situation: Situation, search: Search) -> str:
    """Say where the first start point stopped being finite."""
    if not search.runs:
        return f"no start point was finished: {search.status}"
    run = search.runs[0]
    selections = _names(objective, run.choices)
    at = f"at actions {objective.unstack(run.start)}, selections {selections}"
    for node in objective.outcomes_of(situation, run.start, selections):
        if not node.probability:
            continue
        for label, gaussian in node.states.items():
            if not (np.isfinite(gaussian.mean).all() and np.isfinite(gaussian.covariance).all()):
                return f"no start point has a finite value: {label!r} is {gaussian} on the path {node.path!r} {at}"
        if not np.isfinite(node.reward):
            return f"no start point has a finite value: the reward is {node.reward} on the path {node.path!r} {at}"
    constraints = situation.build.expectation.constraints
    breaches = objective.breaches(situation, run.start, objective.one_hot(selections)) if constraints else np.zeros(0)
    for constraint, breach in zip(constraints, breaches, strict=True):
        if not np.isfinite(breach):
            return f"no start point can be judged: the requirement {constraint.told(objective.tree)} is {breach} {at}"
    return f"no start point has a finite value or gradient, e.g. {at}; look for square roots and divisions at 0"


class _Runs(Sequence[PlanRun]):
    """The runs by labels; each row is made when it is looked at."""

    def __init__(self, objective: Objective, runs: list[Run]) -> None:
        self._objective = objective
        self._runs = runs

    def __len__(self) -> int:
        return len(self._runs)

    @overload
    def __getitem__(self, index: int) -> PlanRun: ...
    @overload
    def __getitem__(self, index: slice) -> list[PlanRun]: ...
    def __getitem__(self, index: int | slice) -> PlanRun | list[PlanRun]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        run = self._runs[index]
        return PlanRun(
            selections=_names(self._objective, run.choices),
            start=self._objective.unstack(run.start),
            actions=self._objective.unstack(run.point),
            value=run.value,
            outcome=run.outcome,
            gradients=len(run.history),
            history=tuple(run.history.tolist()),
        )

    def __iter__(self) -> Iterator[PlanRun]:
        return (self[i] for i in range(len(self)))

    def __reduce__(self) -> tuple[Any, ...]:  # an objective holds the user's functions, which need not pickle
        return tuple, (list(self),)

    def __repr__(self) -> str:
        return f"<{len(self)} runs>"
