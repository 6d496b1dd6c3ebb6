"""PlanFile: rows of plans as lines of JSON, each written as it comes, from which a run that was killed goes on."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

from symgraph.errors import InputError, StorageError
from symgraph.plan_table import PlanRow

FORMAT = "symgraph plans, version 1"


class PlanFile:
    """The rows of one objective under the same options.

    The first line says what they belong to; it is written with the first row, so that a call that fails leaves nothing.

    Args:
        path: of the file; need not be there.
        belongs: what the rows belong to, {what: text or number}.

    Attributes:
        rows: {situation: row} that the file held when it was opened.

    Raises:
        StorageError: it cannot be read or written, is something else, or another process writes it.
        InputError: it belongs to another objective or other options.
    """

    def __init__(self, path: str | os.PathLike[str], belongs: Mapping[str, Any]) -> None:
        try:
            self._path = Path(path)
        except TypeError:
            raise InputError(f"file = {path!r} is no path") from None
        self._belongs = {"format": FORMAT, **belongs}
        self._head = _line(self._belongs)
        self.rows: dict[str, PlanRow] = {}
        try:
            new = not self._path.exists()
            self._file: IO[bytes] = self._path.open("a+b")
        except OSError as error:
            raise StorageError(f"{self._path}: {error.strerror}; give another file") from None
        try:
            self._lock()
            self._file.seek(0)
            whole = self._read(self._file.read())
            self._file.truncate(whole)
        except BaseException:
            self._file.close()
            if new:
                self._path.unlink(missing_ok=True)
            raise
        self._begun = whole > 0

    def _lock(self) -> None:
        if sys.platform == "win32":  # two writers are not noticed there
            return
        import fcntl

        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise StorageError(
                f"{self._path} is being written by another call of solve_many; wait for it, or give another file"
            ) from None

    def _read(self, content: bytes) -> int:
        """Take over the rows; return how many bytes are whole lines."""
        end = content.rfind(b"\n") + 1  # a killed process may have left half a line
        lines = content[:end].splitlines(keepends=True)
        begun = lines[0] if lines else content
        found = _head_of(begun) if lines and begun != self._head else None
        if found is not None:
            other = [what for what in self._belongs if found.get(what) != self._belongs[what]]
            raise InputError(
                f"{self._path} was begun with another {' and '.join(other) or 'version of symgraph'}; give another "
                f"file, or take this one away"
            )
        if begun != self._head and (lines or not self._head.startswith(begun)):
            raise StorageError(f"{self._path} is no file of plans; give another")
        for number, line in enumerate(lines[1:], start=2):
            try:
                entry = json.loads(line)
                key = entry.pop("situation")
                self.rows[key] = PlanRow.of(entry)
            except (ValueError, KeyError, TypeError, AttributeError):
                raise StorageError(
                    f"{self._path}: line {number} is no row of plans; take the line away, or give another file"
                ) from None
        return end

    def add(self, situation: str, row: PlanRow) -> None:
        """Write a row; once this returns, it survives the process."""
        line = _line({"situation": situation, **row.plain()})
        try:
            self._file.write(line if self._begun else self._head + line)
            self._file.flush()
        except OSError as error:
            raise StorageError(f"{self._path}: {error.strerror}; make room, and call again to go on") from None
        self._begun = True

    def close(self) -> None:
        self._file.close()
        if not self._begun:
            self._path.unlink(missing_ok=True)


def _line(entry: Mapping[str, Any]) -> bytes:
    return json.dumps(entry, allow_nan=False).encode() + b"\n"


def _head_of(line: bytes) -> dict[str, Any] | None:
    """Return what a first line says, None if it is of something else."""
    try:
        found = json.loads(line)
        return found if found["format"].startswith("symgraph plans") else None
    except (ValueError, KeyError, TypeError, AttributeError):
        return None
