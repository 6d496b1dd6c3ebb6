"""Which steps of a program several threads share, and where they must wait for each other."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from symgraph.compile.differentiate import called
from symgraph.compile.program import CALLS, Program
from symgraph.compile.schedule import Place, Step

MANY_WEIGHTS = 1024  # of a matrix from which on a product is shared
MANY_ROWS = 32  # of arrays from which on elementwise operations are


class By(Enum):
    """Who touches an array."""

    FIRST = 0  # one thread alone
    ROWS = 1  # each thread its own rows
    ALL = 2  # each thread all of it


class Access(NamedTuple):
    """A step reads an array or writes it."""

    place: Place
    size: int
    by: By
    writes: bool


class Meetings:
    """Keeps what was touched since threads last met, to say when they must meet again."""

    def __init__(self) -> None:
        self._since: dict[str, list[Access]] = {}

    @property
    def is_due(self) -> bool:
        """Whether anything was touched since."""
        return bool(self._since)

    def hold(self) -> None:
        self._since = {}

    def needed(self, accesses: list[Access]) -> bool:
        """Whether threads must meet before a step, since some thread touches what another one does; note the step."""
        conflict = any(
            _conflict(before, access) for access in accesses for before in self._since.get(access.place.base, [])
        )
        if conflict:
            self.hold()
        for access in accesses:
            self._since.setdefault(access.place.base, []).append(access)
        return conflict


def _conflict(one: Access, other: Access) -> bool:
    if not (one.writes or other.writes):
        return False
    begin, end = (one.place.offset, other.place.offset), (one.place.offset + one.size, other.place.offset + other.size)
    if max(begin) >= min(end):
        return False
    if one.by != other.by or one.by == By.ALL:
        return True
    return one.by == By.ROWS and (begin[0], end[0]) != (begin[1], end[1])


class Sharing:
    """Says of programs and their steps whether several threads share them."""

    def __init__(self) -> None:
        self._known: dict[Program, bool] = {}

    def of_program(self, program: Program) -> bool:
        """Whether a program, or one that it calls, has products that are worth sharing."""
        if program not in self._known:
            self._known[program] = any(
                any(map(self.of_program, called(operation)))
                if operation.code in CALLS
                else _has_weights(operation.detail)
                for operation in program.operations
                if operation.code in (*CALLS, "packed product", "pack")
            )
        return self._known[program]

    @staticmethod
    def of_step(step: Step) -> bool:
        """Whether threads have rows of their own in a step of a program that is shared."""
        operation = step[0]
        if operation.is_elementwise:
            return operation.outputs[0].size >= MANY_ROWS
        return operation.code in ("packed product", "pack") and _has_weights(operation.detail)


def _has_weights(detail: tuple[int, ...]) -> bool:
    return detail[0] * detail[1] >= MANY_WEIGHTS
