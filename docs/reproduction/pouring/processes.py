"""Jobs in processes of their own, each as soon as what it needs is there."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from typing import TypeVar

import typer
from joblib.externals.loky import get_reusable_executor
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

Job = TypeVar("Job")
LOOKS = 0.5  # between two looks at what was done [s]


def display() -> Progress:
    """Return bars with what is done, of how much, and for how long."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    return Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn())


def work(
    function: Callable[[Job], object],
    jobs: Sequence[Job],
    processes: int,
    *,
    after: Callable[[Job], Job | None] = lambda job: None,
    look: Callable[[], None] = lambda: None,
) -> None:
    """Do jobs. One that fails lets the others go on; those that wait for it are left undone.

    Args:
        function: called with a job in some process.
        jobs: the first ones first.
        processes: how many.
        after: the job that must be over before this one is begun, if it is among them.
        look: called every now and then.

    Raises:
        Exit: of the program, after all else is done, if a job failed.
    """
    waiting, running, failed = list(jobs), {}, []
    executor = get_reusable_executor(processes, initializer=_follow, initargs=(os.getpid(),))
    try:
        while True:
            failures = [job for job, _ in failed]
            for job in [job for job in waiting if after(job) not in (*waiting, *running.values(), *failures)]:
                waiting.remove(job)
                running[executor.submit(function, job)] = job
            if not running:
                break
            over, _ = wait(running, LOOKS, FIRST_COMPLETED)
            for future in over:
                job = running.pop(future)
                if future.exception() is not None:
                    failed.append((job, future.exception()))
            look()
    finally:
        executor.shutdown(kill_workers=True)
    for job, error in failed:
        typer.echo(f"{job} failed: {type(error).__name__}: {error}", err=True)
    if failed or waiting:
        typer.echo(f"{len(failed)} failed, {len(waiting)} wait for them", err=True)
        raise typer.Exit(1)


def _follow(parent: int) -> None:
    """End this process when its parent was killed; else it would go on and hold its store against the next one."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(LOOKS / 2)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
