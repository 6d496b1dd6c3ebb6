"""Progress on the terminal for anything that takes longer than two seconds; silent otherwise and where nobody looks."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType
from typing import Any

DELAY = 2.0  # [s] what is done sooner needs no display


class Progress:
    """A progress bar on stderr that appears when the work takes longer than `DELAY`.

    Args:
        task: what is going on, e.g. "planning".
        shown: False keeps it away altogether.
    """

    def __init__(self, task: str, shown: bool = True) -> None:
        self._task = task
        self._shown = shown
        self._stream = sys.stderr  # of now: what is done may silence it
        self._bar: Any = None
        self._row: Any = None
        self._lock = threading.Lock()
        self._timer: threading.Timer | None = None
        self._done, self._total = 0.0, 0.0
        self._ended = False
        self._begin = time.monotonic()

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._lock:
            self._ended = True
            if self._timer is not None:
                self._timer.cancel()
            if self._bar is not None:
                self._bar.stop()

    def update(self, done: float, total: float) -> None:
        """Say how much is done; cheap enough for every iteration."""
        self._done, self._total = done, total
        if self._bar is not None:
            self._bar.update(self._row, completed=done, total=total, description=self._task)
        elif self._shown and time.monotonic() - self._begin > DELAY:
            self._show()

    def begin(self, task: str) -> None:
        """Announce work that will report how far it is."""
        self._task = task
        if self._bar is not None:
            self._bar.update(self._row, description=task)

    def wait(self, task: str) -> None:
        """Announce work that cannot report how far it is, such as a compiler's; costs the start of a thread."""
        self.begin(task)
        if self._shown and self._timer is None and self._bar is None:
            self._timer = threading.Timer(DELAY, self._show)
            self._timer.daemon = True
            self._timer.start()

    def _show(self) -> None:
        with self._lock:
            if self._bar is not None or self._ended:
                return
            from rich.console import Console
            from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
            from rich.progress import Progress as Bar

            console = Console(file=self._stream)
            if not (console.is_terminal or console.is_jupyter):
                self._shown = False
                return
            columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()
            self._bar = Bar(*columns, console=console, transient=True)
            self._row = self._bar.add_task(self._task, total=self._total or None, completed=int(self._done))
            self._bar.start()
