"""Threads that share evaluations, or points."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache
from typing import Any

from symgraph.compile.sharing import PARTS

MOST_THREADS = 10_000


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
    """Threads, in teams whose members do the same work together; of more members than parts some only wait."""

    def __init__(self, teams: int, members: int) -> None:
        self._teams = [_Team(threads=members) for _ in range(teams)]
        parts = [sum(1 << part for part in range(i, PARTS, members)) for i in range(members)]
        self._members = [
            [_Member(ctypes.addressof(team), i, mine) for i, mine in enumerate(parts)] for team in self._teams
        ]

    def work(self, task: Callable[..., None], arguments: Sequence[tuple[Any, ...]]) -> None:
        """Call task(member, …) with other arguments for each team, side by side; return when all are done."""
        calls = [
            (ctypes.addressof(member), *given)
            for members, given in zip(self._members, arguments, strict=False)
            for member in members
        ]
        if len(calls) <= 1:
            for call in calls:
                task(*call)
            return
        futures: list[Future[None]] = []
        interrupt: KeyboardInterrupt | None = None
        try:
            futures.extend(_pool(os.getpid()).submit(task, *call) for call in calls[1:])
            task(*calls[0])
        except BaseException:
            for team in self._teams:
                team.broken = 1  # who did not come will not come
            raise
        finally:
            while not all(future.done() for future in futures):  # arrays must stay until nobody writes to them
                try:
                    wait(futures)
                except KeyboardInterrupt as error:
                    interrupt = error
        if interrupt is not None:
            raise interrupt
        for future in futures:
            future.result()


@cache
def _pool(process: int) -> ThreadPoolExecutor:
    """Return the threads of a process; a forked one has none of its parent's."""
    # As many as are asked for: members of a team wait for each other, so each must have a thread.
    return ThreadPoolExecutor(MOST_THREADS, thread_name_prefix=f"symgraph-{process}")
