"""Threads that share evaluations, or points."""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Callable, Sequence
from typing import Any

from symgraph.compile.sharing import PARTS


def cores() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Team(ctypes.Structure):
    """`struct team` of team.c."""

    _fields_ = (
        ("threads", ctypes.c_long),
        ("arrived", ctypes.c_long),
        ("lanes", ctypes.c_long),
        ("broken", ctypes.c_int),
    )


class _Member(ctypes.Structure):
    """`struct member` of team.c."""

    _fields_ = (
        ("team", ctypes.c_void_p),
        ("index", ctypes.c_long),
        ("parts", ctypes.c_uint),
        ("meetings", ctypes.c_long),
        ("apart", ctypes.c_char * 64),
    )


class Crew:
    """Threads, in teams whose members do the same work together.

    Args:
        teams: that work side by side.
        members: of each.
    """

    def __init__(self, teams: int, members: int) -> None:
        parts = [sum(1 << part for part in range(i, PARTS, members)) for i in range(members)]
        self._teams = [_Team(threads=members) for _ in range(teams)]
        self._members = [
            [_Member(ctypes.addressof(team), i, mine) for i, mine in enumerate(parts)] for team in self._teams
        ]

    def work(self, task: Callable[..., None], arguments: Sequence[tuple[Any, ...]]) -> None:
        """Call task(member, …) with other arguments for each team, side by side; return when all are done."""
        calls = [
            (team, (ctypes.addressof(member), *given))
            for team, members, given in zip(self._teams, self._members, arguments, strict=False)
            for member in members
        ]
        if len(calls) <= 1:
            for _, call in calls:
                task(*call)
            return
        others = _Others(task)
        error: BaseException | None = None
        try:
            for team, call in calls[1:]:
                others.start(team, call)
            task(*calls[0][1])
        except BaseException as raised:
            error = raised
            for team, _ in calls:
                team.broken = 1  # who did not come will not come
        error = others.wait(over=error is not None) or error
        if any(team.broken for team in self._teams):
            for team, members in zip(self._teams, self._members, strict=True):
                team.arrived = team.broken = 0
                for member in members:
                    member.meetings = 0
        if error is not None:
            raise error


class _Others:
    """Threads beside the one that called. They write to arrays, so it must not go on before they are done."""

    def __init__(self, task: Callable[..., None]) -> None:
        self._task = task
        self._changed = threading.Condition()
        self._started = self._running = self._done = 0
        self._over = False  # who comes now need not begin
        self._error: BaseException | None = None

    def start(self, team: _Team, call: tuple[Any, ...]) -> None:
        self._started += 1
        threading.Thread(target=self._run, args=(team, call), name="symgraph").start()

    def _run(self, team: _Team, call: tuple[Any, ...]) -> None:
        with self._changed:
            if self._over:
                return
            self._running += 1
        try:
            self._task(*call)
        except BaseException as error:
            self._error = error
            team.broken = 1  # or the others would wait for it for ever
        finally:
            with self._changed:
                self._running -= 1
                self._done += 1
                self._changed.notify_all()

    def wait(self, over: bool) -> BaseException | None:
        """Wait for all, or once it is over for those that run; return what one of them, or the user, raised."""
        interrupt: KeyboardInterrupt | None = None
        while True:
            try:
                with self._changed:
                    self._over = over
                    self._changed.wait_for(lambda: self._running == 0 and (over or self._done == self._started))
                return interrupt or self._error
            except KeyboardInterrupt as raised:
                interrupt = raised
