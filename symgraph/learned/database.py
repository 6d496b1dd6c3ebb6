"""An SQLite file with one writer and any number of readers: opening, checks, the lock, transactions.

The journal is a write-ahead log (WAL), so readers and the writer never wait for each other and a reader sees whole
transactions only. What is committed has left the process: killing it, at any moment, takes nothing back. The log
goes to the disk with every transaction that asks for it (`durable`); what was committed since, a power cut may
undo, newest first. Measured on an SSD that takes 3 ms, and 0.02 ms without.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import sqlite3
import stat
import threading
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path
from urllib.parse import quote

from symgraph.errors import StorageError
from symgraph.learned.storage import checked_path

PATIENCE = 30.0  # [s] to wait for a lock of SQLite's own; a recovery or a checkpoint takes milliseconds
CHECKED_BYTES = 1 << 26  # [bytes]; a file up to here is read through when a writer opens it, in about 0.1 s
COPY = "take another copy of the file, or save what can be read with  sqlite3 FILE .recover"

# Stores that are open, and process and kind of whoever opened them. POSIX locks do not keep out a process's own
# second writer, and SQLite's own are lost to a child that was forked while a store was open.
_open: dict[tuple[str, int, bool], int] = {}  # {(file, process, writes): how often}
_guard = threading.RLock()  # the garbage collector may close a store while one is being opened


class Database:
    """A connection to an SQLite file that carries the mark of one application.

    It belongs to the thread and the process that made it.

    Args:
        path: of the file.
        read_only: never write; otherwise the file is made if it is not there, and locked against a second writer.
        application: the mark, SQLite's application_id.
        version: of the tables, SQLite's user_version.
        tables: statements that make them.
        what: what such a file is called in messages.

    Raises:
        StorageError: the file cannot be read or written, is damaged, holds something else, or has a writer.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        read_only: bool,
        application: int,
        version: int,
        tables: Sequence[str],
        what: str,
    ) -> None:
        self.path = checked_path(path)
        self.read_only = read_only
        self.closed = False
        self._mark, self._version, self._what = application, version, what
        self._process, self._thread = os.getpid(), threading.get_ident()
        file = os.path.realpath(self.path)  # two names of a file must lead to one lock
        self._check_place(file)
        with self._explained(), contextlib.ExitStack() as undo:
            mode = "ro" if read_only else "rwc"
            # Everything is looked at through SQLite: closing a descriptor of our own would drop SQLite's locks.
            self._connection = sqlite3.connect(
                f"file:{quote(os.fsencode(file))}?mode={mode}",
                uri=True,
                timeout=PATIENCE,
                isolation_level=None,  # transactions are begun and ended below, by hand
                check_same_thread=False,  # checked below; the garbage collector may close it from any thread
            )
            undo.callback(self._connection.close)
            self._is_new()  # before the lock, which would leave a file beside one that is not ours
            key = (file, self._process, not read_only)
            lock = self._entered(key)
            release = weakref.finalize(self, _release, self._connection, lock, key)
            undo.pop_all()
            undo.callback(release)
            self._prepare(tables)
            undo.pop_all()
        self._release = release

    def _check_place(self, file: str) -> None:
        """Raise StorageError where no such file can be; the message says what SQLite would not."""
        folder = Path(file).parent
        for process in {process for name, process, _ in list(_open) if name == file}:
            if process != self._process:
                raise StorageError(
                    f"{self.path} was open in process {process} when this one was forked from it, and SQLite does not "
                    "survive that; start processes anew (joblib, subprocess, multiprocessing's 'spawn')"
                )
        try:
            if not stat.S_ISDIR(folder.stat().st_mode):
                raise StorageError(f"{self.path}: {folder} is a file, not a folder; give another path")
            found = stat.S_ISREG(Path(file).stat().st_mode)
        except FileNotFoundError:
            if not folder.exists():
                raise StorageError(f"{self.path}: the folder {folder} does not exist; make it first") from None
            if self.read_only:
                raise StorageError(
                    f"{self.path} does not exist; give the path of {self._what}, or leave out read_only to begin one"
                ) from None
            found = True
        except OSError as error:
            if isinstance(error, StorageError):
                raise
            raise StorageError(
                f"{self.path} cannot be opened: {error.strerror}; give the path of a file that may be read"
            ) from None
        if not found:
            raise StorageError(f"{self.path} is a folder or a device, not a file; give the path of a file")
        if Path(file).exists() and not os.access(file, os.R_OK if self.read_only else os.R_OK | os.W_OK):
            raise StorageError(
                f"{self.path} may not be {'read' if self.read_only else 'written to'} by this user; change its "
                f"permissions{'' if self.read_only else ', or open it with read_only=True'}"
            )
        if not self.read_only and not os.access(folder, os.W_OK):
            raise StorageError(
                f"{self.path}: this user may not write to the folder {folder}, where SQLite's log would stand; change "
                "its permissions, or give another path"
            )

    def _entered(self, key: tuple[str, int, bool]) -> int | None:
        """Note who has the file open; return the descriptor of a writer's lock, which ends with the process."""
        with _guard:
            if self.read_only:
                _open[key] = _open.get(key, 0) + 1
                return None
            # A POSIX lock, not flock: children do not inherit it, so none that outlives its parent keeps the store
            # locked. Closing any other descriptor of the file would end it, hence the look at _open first.
            if key in _open:
                raise self._has_writer("this process")
            lock = os.open(f"{key[0]}-lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                try:
                    fcntl.lockf(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except (BlockingIOError, PermissionError):
                    raise self._has_writer(f"process {os.read(lock, 20).decode() or 'unknown'}") from None
                os.ftruncate(lock, 0)
                os.write(lock, str(self._process).encode())
            except BaseException:
                os.close(lock)
                raise
            _open[key] = 1
            return lock

    def _has_writer(self, holder: str) -> StorageError:
        return StorageError(
            f"{self.path} is being written by {holder}, and it can have only one writer; close that one or wait "
            "for its end, open it with read_only=True, or give another path"
        )

    def _is_new(self) -> bool:
        """Whether there is nothing in the file yet; raise StorageError if it is not ours."""
        mark, version = self._pragma("application_id"), self._pragma("user_version")
        if mark == self._mark:
            if version > self._version:
                raise StorageError(
                    f"{self.path} has version {version} of {self._what}, this symgraph knows {self._version}; "
                    "upgrade it"
                )
            if version < 1:
                raise self.damaged(f"it says it has version {version}")
            return False
        if mark or version or self._connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
            raise StorageError(
                f"{self.path} is an SQLite database of another program, not {self._what}; give another path"
            )
        if self.read_only:
            raise StorageError(f"{self.path} is empty; wait until a writer has begun {self._what} in it")
        return True

    def _prepare(self, tables: Sequence[str]) -> None:
        """Set the connection up, check the file, and make the tables of a new one."""
        if self.read_only:
            self._connection.execute("PRAGMA query_only = ON")
            return
        new = self._is_new()  # again: another process may have made it before the lock was ours
        if not new and self._pragma("page_count") * self._pragma("page_size") <= CHECKED_BYTES:
            found = self._connection.execute("PRAGMA quick_check(1)").fetchone()[0]
            if found != "ok":
                raise self.damaged(str(found).replace("\n", " "))
        if self._connection.execute("PRAGMA journal_mode = WAL").fetchone()[0] != "wal":
            raise StorageError(
                f"{self.path}: SQLite cannot keep a write-ahead log there; give a path on a disk of this machine"
            )
        if new:
            with self.writing(durable=True) as connection:
                for statement in tables:
                    connection.execute(statement)
                connection.execute(f"PRAGMA application_id = {self._mark}")
                connection.execute(f"PRAGMA user_version = {self._version}")

    def _pragma(self, name: str) -> int:
        return int(self._connection.execute(f"PRAGMA {name}").fetchone()[0])

    @contextlib.contextmanager
    def reading(self) -> Iterator[sqlite3.Connection]:
        """Lend the connection for queries that see one moment of the file."""
        self._check_usable()
        with self._explained():
            try:
                self._connection.execute("BEGIN")
                yield self._connection
            finally:
                self._connection.rollback()

    @contextlib.contextmanager
    def writing(self, *, durable: bool = False) -> Iterator[sqlite3.Connection]:
        """Lend the connection for one transaction, which an error undoes.

        Args:
            durable: it waits until this and all before it is on the disk.
        """
        self._check_usable()
        if self.read_only:
            raise StorageError(
                f"{self.path} was opened with read_only=True; to write, open it without, in one process at a time"
            )
        with self._explained():
            self._connection.execute(f"PRAGMA synchronous = {'FULL' if durable else 'NORMAL'}")
            try:
                self._connection.execute("BEGIN IMMEDIATE")
                yield self._connection
                self._connection.commit()
            except BaseException:
                self._connection.rollback()
                raise

    def close(self) -> None:
        """Close the file and give up the lock; a second call does nothing."""
        if not self.closed:
            self.closed = True
            self._release()

    def damaged(self, what: str) -> StorageError:
        """Return the error of a file that says what cannot be."""
        return StorageError(f"{self.path} is damaged: {what[:400]}; {COPY}")

    def _check_usable(self) -> None:
        if self.closed:
            raise StorageError(f"{self.path} is closed; open it again")
        if os.getpid() != self._process:
            raise StorageError(
                f"{self.path} was opened by process {self._process}, from which this one was forked, and SQLite does "
                "not survive that; start processes anew (joblib, subprocess, multiprocessing's 'spawn')"
            )
        if threading.get_ident() != self._thread:
            raise StorageError(
                f"{self.path} was opened by another thread; use it there, or open it here too, with read_only=True"
            )

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        """Turn what SQLite and the system raise into an error that names the file and the remedy."""
        try:
            yield
        except sqlite3.Error as error:
            code = getattr(error, "sqlite_errorcode", None)
            kind = None if code is None else code & 0xFF  # the rest are details
            what = str(error)
            if kind == sqlite3.SQLITE_NOTADB:
                raise StorageError(
                    f"{self.path} is no SQLite file, or its first bytes are damaged; give the path of {self._what}, or "
                    "take another copy of the file"
                ) from error
            if kind in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_ERROR) or kind is None:
                raise self.damaged(what) from error
            remedy = {
                sqlite3.SQLITE_FULL: "make room on the disk; what was stored before is there",
                sqlite3.SQLITE_READONLY: "SQLite's log stands beside it; copy it to a folder that may be written to",
                sqlite3.SQLITE_TOOBIG: "store less in one piece",
                sqlite3.SQLITE_BUSY: "another program holds it locked; end that one",
            }.get(kind, "look whether its folder is there and may be written to, for SQLite's log")
            raise StorageError(f"{self.path}: {what}; {remedy}") from error
        except OSError as error:
            if isinstance(error, StorageError):
                raise
            raise StorageError(
                f"{self.path}: {error.strerror}; look whether its folder is there and may be written to"
            ) from error


def _release(connection: sqlite3.Connection, lock: int | None, key: tuple[str, int, bool]) -> None:
    """Close a connection and then its lock, unless this is a forked child, to which neither belongs."""
    if os.getpid() != key[1]:
        return
    connection.close()
    with _guard:
        _open[key] -= 1
        if not _open[key]:
            del _open[key]
        if lock is not None:
            os.close(lock)
