"""Episodes: what a learning loop has experienced, kept in a file as it happens."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from types import TracebackType
from typing import Any, NoReturn, Self, TypeVar

from symgraph.errors import InputError, StorageError, did_you_mean, names
from symgraph.learned.database import Database
from symgraph.learned.records import (
    Episode,
    Value,
    Visit,
    changes,
    checked_name,
    checked_names,
    checked_number,
    checked_seconds,
    checked_text,
    checked_visit,
    checked_whole,
    episode_of,
    json_of,
    mapping_of,
    number_cell,
    shown,
    values_of,
    values_text,
    visit_of,
)
from symgraph.learned.storage import checked_path
from symgraph.learned.tables import Groups, write_table

__all__ = ["Episode", "EpisodeStore", "Value", "Visit"]

Record = TypeVar("Record")

APPLICATION = int.from_bytes(b"symg", "big")  # the mark by which SQLite files are told apart
VERSION = 1  # of the tables below
RUNNING = "running"
ENDED = ("done", "failed", "interrupted")
NOTHING = "{}"  # the JSON of an empty mapping

# Rewards and totals have no type: SQLite would make NULL of NaN, which is therefore kept as text.
TABLES = (
    "CREATE TABLE settings (one INTEGER PRIMARY KEY CHECK (one = 1), settings TEXT NOT NULL)",
    "CREATE TABLE episodes (number INTEGER PRIMARY KEY, setup TEXT NOT NULL, seed INTEGER NOT NULL, "
    "status TEXT NOT NULL, reason TEXT NOT NULL, total, seconds TEXT NOT NULL, info TEXT NOT NULL, "
    "begun TEXT NOT NULL, ended TEXT)",
    "CREATE TABLE visits (episode INTEGER NOT NULL REFERENCES episodes, step INTEGER NOT NULL, parent INTEGER, "
    "node TEXT NOT NULL, observed TEXT NOT NULL, actions TEXT NOT NULL, selections TEXT NOT NULL, reward NOT NULL, "
    "PRIMARY KEY (episode, step))",
    "CREATE TABLE plans (episode INTEGER NOT NULL, step INTEGER NOT NULL, plan TEXT NOT NULL, "
    "PRIMARY KEY (episode, step))",
)
VISIT_COLUMNS = "episode, step, parent, node, observed, actions, selections, reward"
EPISODE_COLUMNS = "number, setup, seed, status, reason, total, seconds, info, begun, ended"


class EpisodeStore:
    """What an on-line learning loop has experienced, in one SQLite file.

    Every call that writes is one transaction: it is stored as a whole or not at all, and once it has returned, nothing
    that happens to the process takes it back. A power cut may take what was added since the last `end`, no more.
    Nothing is ever changed or deleted, but a plan that is noted again. An episode that was running when
    its process was killed stays as it is until somebody calls `end`.

    One store writes at a time; any number read meanwhile, in any process, and see whole transactions only. A store
    belongs to the thread and the process that opened it. It cannot be pickled, nor used in a forked child:
    hand on its path. Beside the file stand `<path>-lock`, and while it is open SQLite's `<path>-wal` and `<path>-shm`.

    A number or a 0-d array is a scalar and comes back as a float; a list or an array comes back as a 1-D array, even
    if it has one element. Numbers come back to the last bit, infinities and NaN too.

    Args:
        path: of the file; made if it is not there.
        read_only: look on while another store writes.

    Raises:
        StorageError: the file cannot be read or written, is damaged, holds something else, or has a writer already.
        InputError: what a call was given makes no sense, or comes in the wrong order.
    """

    def __init__(self, path: str | os.PathLike[str], *, read_only: bool = False) -> None:
        self._database = Database(
            path,
            read_only=read_only,
            application=APPLICATION,
            version=VERSION,
            tables=TABLES,
            what="an episode store",
        )
        # What was observed up to each visit of one episode. Visits never change, so this can only lack some.
        self._known: tuple[int, dict[int, dict[str, Value]]] = (-1, {})

    @property
    def settings(self) -> dict[str, Any]:
        """What the run is made of; empty until it was set."""
        with self._database.reading() as connection:
            row = connection.execute("SELECT settings FROM settings").fetchone()
        return {} if row is None else self._decoded(mapping_of, row[0])

    def set_settings(self, settings: Mapping[str, Any]) -> None:
        """Say what the run is made of, once; saying the same again changes nothing.

        Args:
            settings: what JSON can hold; arrays become lists.

        Raises:
            InputError: they are others than before, or JSON cannot hold them.
        """
        text = json_of(settings, "settings")
        with self._database.writing(durable=True) as connection:
            row = connection.execute("SELECT settings FROM settings").fetchone()
            if row is None:
                connection.execute("INSERT INTO settings VALUES (1, ?)", (text,))
                return
            before, now = self._decoded(mapping_of, row[0]), mapping_of(text)
        changed = changes(before, now)
        if changed:
            raise InputError(
                f"{self._database.path} already has settings, with others for {names(changed)}: "
                f"{'; '.join(changed.values())}. Go on with those it has, or give another path"
            )

    def begin(
        self,
        number: int,
        setup: str,
        seed: int,
        observed: Mapping[str, Any],
        reward: float = 0.0,
        *,
        node: str = "start",
    ) -> Visit:
        """Begin an episode: store it, and its visit of step 0.

        Args:
            number: that no episode has yet, from 0 on.
            setup: the name of the situation.
            seed: that the world was reset with.
            observed: {label: value} at the start.
            reward: that the graph pays at the start.
            node: where it starts.

        Raises:
            InputError: the number is taken, or something is of the wrong kind.
        """
        number = checked_whole(number, "number of the episode")
        place = f"episode {number}"
        setup, seed = checked_name(setup, f"{place}: setup"), checked_whole(seed, f"{place}: seed")
        visit = checked_visit(Visit(number, 0, None, node, observed, {}, {}, reward))  # type: ignore[arg-type]  # what is checked here
        with self._database.writing() as connection:
            if self._status(connection, number) is not None:
                last = connection.execute("SELECT max(number) FROM episodes").fetchone()[0]
                raise InputError(f"{place} is already in {self._database.path}; the next free number is {last + 1}")
            connection.execute(
                f"INSERT INTO episodes ({EPISODE_COLUMNS}) VALUES (?, ?, ?, ?, '', NULL, ?, ?, ?, NULL)",
                (number, setup, seed, RUNNING, NOTHING, NOTHING, _now()),
            )
            self._insert(connection, visit)
        return visit

    def add(self, visits: Sequence[Visit]) -> None:
        """Store visits, all or none: hand over together what one executed node led to.

        Args:
            visits: of running episodes; a parent comes before its children, here or in an earlier call.

        Raises:
            InputError: an episode that does not run, a step that exists, a parent that does not, or a wrong value.
        """
        if isinstance(visits, Visit) or not isinstance(visits, Iterable):
            raise InputError(f"visits = {shown(visits)}; give a list of Visit")
        checked = [checked_visit(visit) for visit in visits]
        with self._database.writing() as connection:
            for episode in dict.fromkeys(visit.episode for visit in checked):
                self._check_running(connection, episode, "add to")
            for visit in checked:
                place = f"episode {visit.episode}, step {visit.step}"
                if self._has_visit(connection, visit.episode, visit.step):
                    raise InputError(f"{place} is already there; give every visit of an episode a step of its own")
                if visit.parent is None or not self._has_visit(connection, visit.episode, visit.parent):
                    raise InputError(f"{place}: parent {visit.parent} is no step of this episode; add the parent first")
                self._insert(connection, visit)

    def note_plan(self, episode: int, step: int, plan: Mapping[str, Any]) -> None:
        """Store the decision that was made at a step, in place of an earlier one at that step.

        Args:
            episode: that is running.
            step: of the visit at which it was made.
            plan: what JSON can hold (actions, selections, value, status, seconds, …); arrays become lists.

        Raises:
            InputError: the episode does not run, the step does not exist, or JSON cannot hold the plan.
        """
        episode, step = checked_whole(episode, "episode"), checked_whole(step, "step")
        text = json_of(plan, f"episode {episode}, step {step}: plan")
        with self._database.writing() as connection:
            self._check_running(connection, episode, "note a plan in")
            if not self._has_visit(connection, episode, step):
                raise InputError(f"episode {episode} has no step {step} to note a plan at; add its visit first")
            connection.execute("INSERT OR REPLACE INTO plans VALUES (?, ?, ?)", (episode, step, text))

    def plans(self, episode: int) -> dict[int, dict[str, Any]]:
        """Return {step: plan} of an episode, in order of the steps."""
        episode = checked_whole(episode, "episode")
        with self._database.reading() as connection:
            rows = connection.execute("SELECT step, plan FROM plans WHERE episode = ? ORDER BY step", (episode,))
            found = rows.fetchall()
        return {step: self._decoded(mapping_of, text) for step, text in found}

    def end(
        self,
        number: int,
        status: str,
        *,
        total: float | None = None,
        reason: str = "",
        seconds: Mapping[str, float] | None = None,
        info: Mapping[str, Any] | None = None,
    ) -> None:
        """End an episode; afterwards all that is stored is on the disk, safe from a power cut.

        Args:
            number: of a running episode.
            status: "done", "failed" or "interrupted".
            total: the return.
            reason: why it failed.
            seconds: {what was done: how long it took} [s].
            info: whatever else is worth a note, that JSON can hold.

        Raises:
            InputError: the episode does not run, or something is of the wrong kind.
        """
        number = checked_whole(number, "number of the episode")
        place = f"episode {number}"
        if not isinstance(status, str) or status not in ENDED:
            hint = did_you_mean(status, ENDED)
            raise InputError(f"{place}: status {shown(status)} is none of its options{hint} Options: {names(ENDED)}")
        cells = (
            status,
            checked_text(reason, f"{place}: reason"),
            None if total is None else number_cell(checked_number(total, f"{place}: total")),
            json_of(checked_seconds(seconds or {}, place), place),
            json_of({} if info is None else info, f"{place}: info"),
        )
        with self._database.writing(durable=True) as connection:
            self._check_running(connection, number, "end")
            connection.execute(
                "UPDATE episodes SET status = ?, reason = ?, total = ?, seconds = ?, info = ?, ended = ? "
                "WHERE number = ?",
                (*cells, _now(), number),
            )

    def episodes(
        self, *, setup: str | Iterable[str] | None = None, status: str | Iterable[str] | None = None
    ) -> list[Episode]:
        """Return episodes in order of their numbers.

        Args:
            setup: only of this setup, or of these.
            status: only of this status, or of these.
        """
        where, cells = _narrowed(setup=checked_names(setup, "setup"), status=checked_names(status, "status"))
        with self._database.reading() as connection:
            rows = connection.execute(f"SELECT {EPISODE_COLUMNS} FROM episodes{where} ORDER BY number", cells)
            found = rows.fetchall()
        return [self._decoded(episode_of, row) for row in found]

    def visits(
        self,
        episode: int | None = None,
        *,
        setup: str | Iterable[str] | None = None,
        node: str | Iterable[str] | None = None,
    ) -> list[Visit]:
        """Return visits in order of episodes and steps.

        Args:
            episode: only of this one.
            setup: only of this setup, or of these.
            node: only of this node, or of these.
        """
        where, cells = _narrowed(
            episode=None if episode is None else [checked_whole(episode, "episode")],
            setup=checked_names(setup, "setup"),
            node=checked_names(node, "node"),
        )
        join = "" if setup is None else " JOIN episodes ON number = episode"
        with self._database.reading() as connection:
            rows = connection.execute(f"SELECT {VISIT_COLUMNS} FROM visits{join}{where} ORDER BY episode, step", cells)
            found = rows.fetchall()
        return [self._decoded(visit_of, row) for row in found]

    def known(self, visit: Visit) -> dict[str, Value]:
        """Return all that was observed on the path from the start to a visit, later values over earlier ones.

        Args:
            visit: stored or about to be; its parent must be stored.

        Raises:
            InputError: its parent is not stored.
        """
        visit = checked_visit(visit)
        before = {} if visit.parent is None else self._known_at(visit.episode, visit.parent)
        # Copies, so that whoever writes into one does not write into what is kept for later calls.
        return {label: v if isinstance(v, float) else v.copy() for label, v in {**before, **visit.observed}.items()}

    def export(self, path: str | os.PathLike[str]) -> int:
        """Write all visits to a Parquet file, a row each, and return the number of rows.

        Columns are `episode`, `setup`, `seed`, `status`, `total`, `step`, `parent`, `node` and `reward`, then
        `observed.label`, `action.label` and `selection.label`; the elements of an array are `observed.label[0]`,
        `observed.label[1]` and so on. What a visit lacks is null, also what was observed before it. Plans, settings,
        and an episode's reason, seconds, info and times are left out. A file that was there is replaced once all is
        written.

        Args:
            path: that ends in .parquet.

        Raises:
            StorageError: the file cannot be written.
            InputError: a path that ends in something else, or two labels that lead to one column.
            MissingExtraError: pyarrow is not installed.
        """
        if checked_path(path).suffix.lower() != ".parquet":
            raise InputError(
                f"path = {os.fspath(path)!r}: the file will be in the format Parquet; give a name that ends in .parquet"
            )
        with self._database.reading() as connection:
            about = connection.execute("SELECT number, setup, seed, status, total FROM episodes").fetchall()
            rows = connection.execute(f"SELECT {VISIT_COLUMNS} FROM visits ORDER BY episode, step").fetchall()
        visits = [self._decoded(visit_of, row) for row in rows]
        of = {row[0]: (*row[1:4], None if row[4] is None else self._decoded(float, row[4])) for row in about}
        fixed = {
            "episode": ("int64", [visit.episode for visit in visits]),
            "setup": ("string", [of[visit.episode][0] for visit in visits]),
            "seed": ("int64", [of[visit.episode][1] for visit in visits]),
            "status": ("string", [of[visit.episode][2] for visit in visits]),
            "total": ("float64", [of[visit.episode][3] for visit in visits]),
            "step": ("int64", [visit.step for visit in visits]),
            "parent": ("int64", [visit.parent for visit in visits]),
            "node": ("string", [visit.node for visit in visits]),
            "reward": ("float64", [visit.reward for visit in visits]),
        }
        groups: list[Groups] = [
            {"observed": v.observed, "action": v.actions, "selection": v.selections} for v in visits
        ]
        write_table(path, fixed, groups)
        return len(visits)

    def close(self) -> None:
        """Close the file and let another store write; a second call does nothing."""
        self._database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __len__(self) -> int:
        with self._database.reading() as connection:
            return int(connection.execute("SELECT count(*) FROM episodes").fetchone()[0])

    def __repr__(self) -> str:
        if self._database.closed:
            state = "closed"
        else:
            try:
                state = f"{len(self)} episodes{', read only' if self._database.read_only else ''}"
            except StorageError:
                state = "cannot be read here"
        return f"<EpisodeStore {str(self._database.path)!r}, {state}>"

    def __reduce__(self) -> NoReturn:
        raise InputError(
            f"the store of {self._database.path} cannot leave its process; hand on its path, and open it there with "
            "read_only=True"
        )

    def _known_at(self, episode: int, step: int) -> dict[str, Value]:
        """Return what was known at a stored step; an episode is read once, and again when it has grown."""
        number, known = self._known
        if number != episode or step not in known:
            with self._database.reading() as connection:
                rows = connection.execute(
                    "SELECT step, parent, observed FROM visits WHERE episode = ? ORDER BY step", (episode,)
                ).fetchall()
            known = {}
            for at, parent, text in rows:
                if parent is not None and parent not in known:
                    raise self._database.damaged(f"episode {episode}, step {at}: its parent {parent} is missing")
                known[at] = {**known.get(parent, {}), **self._decoded(values_of, text)}
            self._known = episode, known
        if step not in known:
            raise InputError(f"episode {episode} has no step {step} in {self._database.path}; add that visit first")
        return known[step]

    def _decoded(self, decode: Callable[[Any], Record], cells: Any) -> Record:
        """Return what cells of the file stand for; raise StorageError where they make no sense."""
        try:
            return decode(cells)
        except (ValueError, TypeError, AttributeError, RecursionError) as error:
            raise self._database.damaged(f"{shown(cells)} is nothing that a store writes ({error})") from None

    def _status(self, connection: sqlite3.Connection, number: int) -> str | None:
        row = connection.execute("SELECT status FROM episodes WHERE number = ?", (number,)).fetchone()
        return None if row is None else str(row[0])

    def _check_running(self, connection: sqlite3.Connection, number: int, purpose: str) -> None:
        status = self._status(connection, number)
        if status is None:
            raise InputError(f"there is no episode {number} to {purpose}; call begin first")
        if status != RUNNING:
            raise InputError(f"cannot {purpose} episode {number}: it has ended ({status}); begin another one")

    def _has_visit(self, connection: sqlite3.Connection, episode: int, step: int) -> bool:
        found = connection.execute("SELECT 1 FROM visits WHERE episode = ? AND step = ?", (episode, step))
        return found.fetchone() is not None

    def _insert(self, connection: sqlite3.Connection, visit: Visit) -> None:
        connection.execute(
            f"INSERT INTO visits ({VISIT_COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
            (
                visit.episode,
                visit.step,
                visit.parent,
                visit.node,
                values_text(visit.observed),
                values_text(visit.actions),
                json_of(visit.selections, ""),
                number_cell(visit.reward),
            ),
        )


def _narrowed(**wanted: list[Any] | None) -> tuple[str, list[Any]]:
    """Return the WHERE of a query and its cells: each column is one of its values; None leaves it open."""
    narrow = {column: values for column, values in wanted.items() if values is not None}
    terms = [f"{column} IN ({', '.join('?' * len(values))})" for column, values in narrow.items()]
    return (f" WHERE {' AND '.join(terms)}" if terms else ""), [value for values in narrow.values() for value in values]


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
