"""Run the pouring experiments of the paper's section VII, and one with more variety.

From the repository's root, `python docs/reproduction/pouring/learn.py run --runs 2 --processes 2`. It may be killed at
any time and goes on when it is run again. Every episode that is over gets a row in results.csv beside this program;
`learn.py collect` makes that file anew from the runs. `figures.py` draws it.
"""

from __future__ import annotations

import shutil
from collections import defaultdict
from collections.abc import Collection
from pathlib import Path
from typing import Annotated

import typer
from processes import display, work
from setups import COLUMNS, CONDITIONS, RESULTS, RUNS, Run, append, chosen, read, write

app = typer.Typer(add_completion=False, help=__doc__)

Folder = Annotated[Path, typer.Option(help="Of the runs.")]
Results = Annotated[Path, typer.Option(help="File of the episodes.")]


@app.command()
def run(
    runs: Annotated[int, typer.Option(min=1, help="Of each condition.")] = 2,
    processes: Annotated[int, typer.Option(min=1)] = 2,
    only: Annotated[list[str] | None, typer.Option(help='Conditions as "setup2*", and what they build on.')] = None,
    episodes: Annotated[int | None, typer.Option(min=1, help="In each setup, fewer than usual: for a try.")] = None,
    folder: Folder = RUNS,
    results: Results = RESULTS,
) -> None:
    """Learn, or go on with it."""
    conditions = chosen(only or ["*"], episodes)
    jobs = [Run(condition, number, folder) for number in range(runs) for condition in conditions]
    rebuild(folder, results, begun=jobs)
    told = {job: job.done for job in jobs}
    with display() as progress:
        total = progress.add_task("all", total=sum(job.condition.episodes for job in jobs))
        bars = {one: progress.add_task(one.key, total=runs * one.episodes) for one in conditions}

        def look() -> None:
            for job in jobs:
                if told[job] < job.condition.episodes:
                    rows = job.rows(told[job])
                    append(results, COLUMNS, rows)
                    told[job] += len(rows)
            progress.update(total, completed=sum(told.values()))
            for condition, bar in bars.items():
                progress.update(bar, completed=sum(done for job, done in told.items() if job.condition == condition))

        look()
        try:
            work(
                go_on,
                [job for job in jobs if not job.finished],
                processes,
                after=lambda job: job.basis,
                look=look,
            )
        finally:
            rebuild(folder, results)


@app.command()
def collect(folder: Folder = RUNS, results: Results = RESULTS) -> None:
    """Make the file of the episodes anew; rows of runs that are not in the folder stay, if their seeds are those."""
    rebuild(folder, results)


def go_on(job: Run) -> None:
    """Do what is left of a run; it begins with a copy of the run that it builds on."""
    if job.basis is not None and not job.folder.exists():
        part = job.folder.with_name(f"{job.folder.name}.part")
        shutil.rmtree(part, ignore_errors=True)  # of a copy that was stopped
        shutil.copytree(job.basis.folder, part, ignore=shutil.ignore_patterns("*-lock", "*-shm"))
        part.rename(job.folder)
    with job.loop() as loop:
        for _ in loop:
            pass


def rebuild(folder: Path, results: Path, begun: Collection[Run] = ()) -> None:
    """Make the file of the episodes anew, without the old rows of runs that are begun, and of other seeds."""
    old = defaultdict(list)
    for row in read(results):
        old[row["setup"], row["condition"], int(row["run"])].append(row)
    for job in begun:
        old.pop((job.condition.setup, job.condition.name, job.number), None)
    rows = []
    for condition in CONDITIONS:
        numbers = {number for *key, number in old if key == [condition.setup, condition.name]}
        places = Run(condition, 0, folder).folder.parent.glob("*")
        numbers |= {int(place.name) for place in places if place.name.isdecimal()}
        for number in sorted(numbers):
            one = Run(condition, number, folder)
            rows += one.rows() or of_its_seed(one, old[condition.setup, condition.name, number])
    write(results, COLUMNS, rows)


def of_its_seed(one: Run, rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """Return those rows of a run that its seed led to; say what is left out."""
    seeds = one.seeds
    kept = [row for row in rows if int(row["seed"]) in seeds]
    if len(kept) < len(rows):
        typer.echo(f"{one.condition.key}, run {one.number}: {len(rows) - len(kept)} rows of other seeds are dropped")
    return kept


if __name__ == "__main__":
    import learn  # by that name its processes find it

    learn.app()
