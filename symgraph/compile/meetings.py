"""Where the threads that share a program must wait for each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from symgraph.compile.program import Operation, constant_of
from symgraph.compile.schedule import Place, Schedule, Step
from symgraph.compile.sharing import Costs

MOST_NOTED = 2000  # accesses between two meetings: to compare all costs more than to meet


class Access(NamedTuple):
    """A part reads an array or writes it."""

    place: Place
    size: int
    part: int
    writes: bool


class Notes:
    """What was touched since threads last met."""

    def __init__(self) -> None:
        self._since: dict[str, list[Access]] = {}
        self._count = 0

    def __bool__(self) -> bool:
        return self._count > 0

    def add(self, accesses: Sequence[Access]) -> None:
        for access in accesses:
            self._since.setdefault(access.place.base, []).append(access)
        self._count += len(accesses)

    def forbid(self, accesses: Sequence[Access]) -> bool:
        """Whether another part has touched what is written now, or written what is touched."""
        return self._count > MOST_NOTED or any(
            _conflict(before, access) for access in accesses for before in self._since.get(access.place.base, [])
        )


def _conflict(one: Access, other: Access) -> bool:
    if one.part == other.part or not (one.writes or other.writes):
        return False
    ends = (access.place.offset + access.size for access in (one, other))
    return max(one.place.offset, other.place.offset) < min(ends)


class Meetings:
    """Says of the steps of a shared program, in order, before which of them threads meet.

    Args:
        schedule: the steps, and where values are.
        parts: of which part an operation is; None for what all threads call together, and end with a meeting.
        costs: of operations.
    """

    def __init__(self, schedule: Schedule, parts: Mapping[Operation, int | None], costs: Costs) -> None:
        self._schedule = schedule
        self._parts = parts
        self._costs = costs
        self._notes = Notes()

    def before(self, i: int) -> bool:
        """Whether they meet before step i, which is noted."""
        steps = self._schedule.steps
        if self._parts[steps[i][0]] is None:
            due = bool(self._notes)
            self._notes = Notes()
            return due
        ahead = self._accesses(i)
        if self._is_costly(i) and not (i and self._is_costly(i - 1)):
            # For what any costly step of a level needs: between them one part would wait while another one works.
            for k in range(i + 1, len(steps)):
                if not self._is_costly(k):
                    break
                ahead += self._accesses(k)
        due = self._notes.forbid(ahead)
        if due:
            self._notes = Notes()
        self._notes.add(self._accesses(i))
        return due

    def before_end(self) -> bool:
        """Whether they meet before what follows the last step."""
        return bool(self._notes)

    def _is_costly(self, i: int) -> bool:
        return self._costs.is_costly(self._schedule.steps[i][0])

    def _accesses(self, i: int) -> list[Access]:
        """Return what a step reads and writes."""
        step: Step = self._schedule.steps[i]
        part = self._parts[step[0]]
        if part is None:
            return []
        made = [output for operation in step for output in operation.outputs]
        within = set(made)
        read = [arg for operation in step for arg in operation.args if arg not in within]
        return [
            Access(self._schedule.place(value), value.size, part, writes)
            for values, writes in ((read, False), (made, True))
            for value in values
            if constant_of(self._schedule.source(value)) is None
        ]
