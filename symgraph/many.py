"""solve_many: plans for many situations, side by side in processes, kept in a file as they come."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import cloudpickle
import numpy as np
from joblib import Parallel, cpu_count, delayed, effective_n_jobs
from joblib.externals.loky.process_executor import TerminatedWorkerError
from joblib.parallel import get_active_backend

from symgraph.errors import InputError, SolveError, SymgraphError
from symgraph.objective import Objective
from symgraph.optimizers.lbfgs import Lbfgs
from symgraph.optimizers.problem import Optimizer
from symgraph.plan import Plan
from symgraph.plan_file import PlanFile
from symgraph.plan_table import PlanRow, PlanTable
from symgraph.planner import Guess, solve
from symgraph.progress import Progress
from symgraph.situation import Situation

BATCH_TIME = 0.2  # that a process should be busy with what it is handed at once [s]

Options = dict[str, Any]  # of solve


def solve_many(
    objective: Objective,
    states: Iterable[Mapping[str, Any]],
    optimizer: Optimizer | None = None,
    *,
    guess: Guess | Sequence[Guess] | None = None,
    fixed: Mapping[str, Any] | None = None,
    seed: int = 0,
    time_limit: float | None = None,
    processes: int | None = None,
    file: str | os.PathLike[str] | None = None,
    progress: bool = True,
) -> PlanTable:
    """Plan for many situations; each plan is the one that `solve` would find.

    Where no plan is found for a situation, its row says why and the others go on. Ctrl-C ends it with the rows so far.
    Inside joblib.parallel_config(backend="dask") or "ray" the situations go to that cluster.

    Args:
        objective: what to maximise.
        states: the situations, each as in `solve`.
        optimizer: as in `solve`.
        guess: likewise, for all situations.
        fixed: likewise.
        seed: likewise, the same for all.
        time_limit: likewise, for each [s].
        processes: among which the situations are shared; if left out, as many as joblib.parallel_config says, or as
            there are cores. With 1, all happens in this process.
        file: keeps every row as it comes, one line of JSON each. Called again with the same objective and options,
            after whatever ended the first call, only situations are planned for that are not in it.
        progress: show a progress bar where it takes longer than two seconds.

    Raises:
        InputError: a state or an option that does not fit; a file that was begun with another objective or options.
        StorageError: the file cannot be read or written.
    """
    if not isinstance(objective, Objective):
        raise InputError(f"solve_many takes an Objective, got {type(objective).__name__}")
    if isinstance(states, Mapping):
        raise InputError("states is one mapping; give a list of them, or take solve for one")
    given = list(states)
    situations = [_situation(objective, state, k) for k, state in enumerate(given)]
    count = _processes(processes)
    options: Options = {"optimizer": optimizer, "guess": guess, "fixed": fixed, "seed": seed, "time_limit": time_limit}
    keys = [_digest_of(situation) for situation in situations]
    rows: dict[str, PlanRow] = {}
    why = "interrupted"
    with Progress("planning", progress) as bar:
        kept = None
        if file is not None:
            bar.wait("building")
            kept = PlanFile(file, _belongs(objective, options))
            rows = kept.rows
        missing = list({key: k for k, key in reversed(list(enumerate(keys))) if key not in rows}.items())[::-1]
        total = len(rows) + len(missing)
        try:
            for key, row in _planned(objective, [(key, given[k]) for key, k in missing], options, count, bar):
                rows[key] = row
                if kept is not None:
                    kept.add(key, row)
                bar.update(len(rows), total)
        except KeyboardInterrupt:
            pass
        except TerminatedWorkerError:
            why = "a worker process died; call again with fewer processes"
        finally:
            if kept is not None:
                kept.close()
    return PlanTable(objective.graph, given, [rows.get(key, _unplanned(why)) for key in keys])


def _processes(given: int | None) -> int:
    """Return how many processes to plan in: those that were asked for, or that joblib was told, or the cores."""
    _, configured = get_active_backend()
    if given is None and configured is not None:
        return int(effective_n_jobs(configured))
    count = cpu_count() if given is None else given
    if isinstance(count, bool) or not isinstance(count, (int, np.integer)) or count < 1:
        raise InputError(f"processes = {given!r}; give a positive whole number")
    return int(count)


def _planned(
    objective: Objective, missing: list[tuple[str, Mapping[str, Any]]], options: Options, count: int, bar: Progress
) -> Iterator[tuple[str, PlanRow]]:
    """Yield the rows of situations as they are ready."""
    if count == 1 or len(missing) < 2:
        for key, state in missing:
            yield key, _row(objective, state, options)
        return
    bar.wait("compiling")
    build = objective.situation(missing[0][1]).build
    build.compile()  # once here: all others find it on the disk
    blob = cloudpickle.dumps((objective, options))
    token = hashlib.sha256(blob).hexdigest()
    bar.begin("planning")
    waiting = iter(missing)
    pace = _Pace()

    def batches() -> Iterator[Any]:
        left = len(missing)
        while left:
            # Smaller ones towards the end, so that no process is idle while another still has much to do.
            batch = list(itertools.islice(waiting, max(1, min(pace.size, left // (3 * count)))))
            left -= len(batch)
            yield delayed(_batch)(token, blob, batch, os.getpid())

    parallel = Parallel(n_jobs=count, return_as="generator_unordered", max_nbytes=None, pre_dispatch="2*n_jobs")
    for results, seconds in parallel(batches()):
        pace.learn(seconds, len(results))
        yield from results


class _Pace:
    """How many situations are handed over at once: few at first, then as many as fill the time."""

    def __init__(self) -> None:
        self.size = 1

    def learn(self, seconds: float, count: int) -> None:
        self.size = max(1, min(2 * self.size, round(BATCH_TIME * count / max(seconds, 1e-9))))


_objectives: dict[str, tuple[Objective, Options]] = {}  # of this worker process: building one takes longer than a plan
_loading = threading.Lock()  # some clusters plan in several threads of a process


def _batch(
    token: str, blob: bytes, batch: list[tuple[str, Mapping[str, Any]]], caller: int
) -> tuple[list[tuple[str, PlanRow]], float]:
    """Plan for some situations in a worker process; also say how long it took."""
    with _loading:
        if token not in _objectives:
            if not _objectives and os.getppid() == caller:
                threading.Thread(target=_follow, args=[caller], daemon=True).start()
            _objectives.clear()
            _objectives[token] = cloudpickle.loads(blob)
        objective, options = _objectives[token]
    begin = time.perf_counter()
    rows = [(key, _row(objective, state, options)) for key, state in batch]
    return rows, time.perf_counter() - begin


def _follow(caller: int) -> None:
    """End this worker process when the one that called it is gone, killed perhaps."""
    while os.getppid() == caller:
        time.sleep(1.0)
    os._exit(1)


def _row(objective: Objective, state: Mapping[str, Any], options: Options) -> PlanRow:
    try:
        plan = solve(objective, state, progress=False, **options)
    except SolveError as error:
        return _unplanned(str(error))
    if plan.status.startswith("interrupted"):
        raise KeyboardInterrupt
    found = plan.value, plan.deviation, plan.violation, plan.status, plan.notes, plan.seconds
    return PlanRow(plan.actions, plan.selections, *found)


def _unplanned(why: str) -> PlanRow:
    return PlanRow({}, {}, np.nan, np.nan, np.nan, f"not planned: {why}", (), 0.0)


def _situation(objective: Objective, state: Any, k: int) -> Situation:
    try:
        return objective.situation(state)
    except SymgraphError as error:
        raise InputError(f"states[{k}]: {error}") from None


def _digest_of(situation: Situation) -> str:
    """Return what tells situations apart: the moments of all given states."""
    parts = []
    for label, gaussian in sorted(situation.given.items()):
        parts += [label.encode(), np.ravel(gaussian.mean).tobytes(), np.ravel(gaussian.covariance).tobytes()]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:32]


def _belongs(objective: Objective, options: Options) -> dict[str, Any]:
    """Return what tells objectives and options apart: the slots, the expression itself, and the numbers in it."""
    guess = options["guess"]
    guesses = [] if guess is None else [guess] if isinstance(guess, (Plan, PlanRow, Mapping)) else guess
    build = objective.build(frozenset())
    content = {
        "slots": {label: repr(slot) for label, slot in objective.graph.slots.items()},
        "J": build.function.serialize(),
        "margins": build.expectation.margins_function().serialize(),
        "sides": [(one.side, one.way) for one in build.expectation.constraints],
    }
    weights = [parameter.value for parameter in build.expectation.inputs.parameters]
    planned = [{**one.actions, **one.selections} if isinstance(one, (Plan, PlanRow)) else one for one in guesses]
    return {
        "objective": hashlib.sha256(_text(content).encode()).hexdigest(),
        "set of weights": hashlib.sha256(_text(weights).encode()).hexdigest(),
        "risk": objective.risk,
        "optimizer": repr(Lbfgs() if options["optimizer"] is None else options["optimizer"]),
        "guess": _text(planned),
        "fixed": _text({} if options["fixed"] is None else options["fixed"]),
        "seed": _text(options["seed"]),
        "time_limit": _text(options["time_limit"]),
    }


def _text(value: Any) -> str:
    return json.dumps(value, sort_keys=True, default=_plain)


def _plain(value: Any) -> Any:
    """Return what JSON knows for what it does not."""
    return value.tolist() if isinstance(value, (np.ndarray, np.generic)) else repr(value)
