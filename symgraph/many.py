"""solve_many: plans for many situations, side by side in processes, kept in a file as they come."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import cloudpickle
import numpy as np
from joblib import Parallel, cpu_count, delayed
from joblib.parallel import get_active_backend

from symgraph.errors import InputError, SolveError, StorageError, SymgraphError
from symgraph.objective import Objective, Situation
from symgraph.optimizers.problem import Optimizer
from symgraph.plan_table import PlanRow, PlanTable
from symgraph.planner import Guess, solve
from symgraph.progress import Progress

FORMAT = "symgraph plans, version 1"
BATCH_TIME = 0.2  # that a process should be busy with what it is handed at once [s]
NOT_PLANNED = "not planned"

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
    options: Options = {"optimizer": optimizer, "guess": guess, "fixed": fixed, "seed": seed, "time_limit": time_limit}
    keys = [_digest_of(situation) for situation in situations]
    rows: dict[str, PlanRow] = {}
    with Progress("planning", progress) as bar:
        kept = None
        if file is not None:
            bar.wait("compiling")
            kept = _File(Path(file), _digest(objective, situations, options))
            rows = kept.rows
        missing = list({key: k for k, key in reversed(list(enumerate(keys))) if key not in rows}.items())[::-1]
        try:
            for key, row in _planned(objective, [(key, given[k]) for key, k in missing], options, processes, bar):
                rows[key] = row
                if kept is not None:
                    kept.add(key, row)
                bar.update(len(rows), len(rows) + len(missing))
        except KeyboardInterrupt:
            pass
        finally:
            if kept is not None:
                kept.close()
    return PlanTable(objective.graph, given, [rows.get(key, _unplanned("interrupted")) for key in keys])


def _planned(
    objective: Objective,
    missing: list[tuple[str, Mapping[str, Any]]],
    options: Options,
    processes: int | None,
    bar: Progress,
) -> Iterator[tuple[str, PlanRow]]:
    """Yield the rows of situations as they are ready."""
    _, configured = get_active_backend()
    count = processes if processes is not None else configured if configured is not None else cpu_count()
    if isinstance(count, bool) or not isinstance(count, (int, np.integer)) or count == 0:
        raise InputError(f"processes = {processes!r}; give a positive whole number")
    if count == 1 or len(missing) < 2:
        for key, state in missing:
            yield key, _row(objective, state, options)
        return
    objective.situation(missing[0][1]).build.kernel  # noqa: B018 compiled once here, found on the disk by all others
    blob = cloudpickle.dumps((objective, options))
    token = hashlib.sha256(blob).hexdigest()
    bar.begin("planning")
    waiting = iter(missing)
    pace = _Pace()

    def batches() -> Iterator[Any]:
        while batch := list(itertools.islice(waiting, pace.size)):
            yield delayed(_batch)(token, blob, batch)

    parallel = Parallel(n_jobs=int(count), return_as="generator_unordered", max_nbytes=None, pre_dispatch="2*n_jobs")
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


def _batch(
    token: str, blob: bytes, batch: list[tuple[str, Mapping[str, Any]]]
) -> tuple[list[tuple[str, PlanRow]], float]:
    """Plan for some situations in a worker process; also say how long it took."""
    if token not in _objectives:
        _objectives.clear()
        _objectives[token] = cloudpickle.loads(blob)
    objective, options = _objectives[token]
    begin = time.perf_counter()
    rows = [(key, _row(objective, state, options)) for key, state in batch]
    return rows, time.perf_counter() - begin


def _row(objective: Objective, state: Mapping[str, Any], options: Options) -> PlanRow:
    try:
        plan = solve(objective, state, progress=False, **options)
    except SolveError as error:
        return _unplanned(str(error))
    if plan.status.startswith("interrupted"):
        raise KeyboardInterrupt
    return PlanRow(plan.actions, plan.selections, plan.value, plan.deviation, plan.violation, plan.status, plan.seconds)


def _unplanned(why: str) -> PlanRow:
    return PlanRow({}, {}, np.nan, np.nan, np.nan, f"{NOT_PLANNED}: {why}", 0.0)


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


def _digest(objective: Objective, situations: list[Situation], options: Options) -> str:
    """Return what tells objectives and options apart: the expression itself, and the numbers in it."""
    parts = [repr((objective.risk, options)).encode()]
    if situations:
        build = situations[0].build
        parts.append(build.function.serialize().encode())
        parts += [parameter.value.tobytes() for parameter in build.expectation.inputs.parameters]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()


class _File:
    """Rows as lines of JSON; the first line says what they belong to."""

    def __init__(self, path: Path, digest: str) -> None:
        self._path = path
        head = {"format": FORMAT, "objective": digest}
        self.rows: dict[str, PlanRow] = {}
        try:
            lines = path.read_bytes().split(b"\n") if path.exists() else []
            whole = lines[:-1]  # a killed process may have left half a line at the end
            if whole:
                self._read(whole, head)
            self._file: IO[bytes] = path.open("ab")
            if whole:
                self._file.truncate(sum(len(line) + 1 for line in whole))
            else:
                self._file.truncate(0)
                self._write(head)
        except OSError as error:
            if isinstance(error, StorageError):
                raise
            raise StorageError(f"{path}: {error.strerror}; give another file") from None

    def _read(self, lines: list[bytes], head: dict[str, str]) -> None:
        for number, line in enumerate(lines, start=1):
            try:
                entry = json.loads(line)
                if number == 1:
                    found = entry["format"], entry["objective"]
                else:
                    key = entry.pop("situation")
                    self.rows[key] = PlanRow.of(entry)
            except (ValueError, KeyError, TypeError):
                raise StorageError(
                    f"{self._path}: line {number} is no row of plans; give another file, or take this one away"
                ) from None
            if number == 1 and found != tuple(head.values()):
                raise InputError(
                    f"{self._path} was begun with another objective, other options or another version of symgraph; "
                    f"give another file, or take this one away"
                )

    def add(self, key: str, row: PlanRow) -> None:
        self._write({"situation": key, **row.plain()})

    def _write(self, entry: Mapping[str, Any]) -> None:
        try:
            self._file.write(json.dumps(entry).encode() + b"\n")
            self._file.flush()  # in the system's hands it survives the process
        except OSError as error:
            raise StorageError(f"{self._path}: {error.strerror}; make room, and call again to go on") from None

    def close(self) -> None:
        self._file.close()
