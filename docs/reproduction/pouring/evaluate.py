"""Let finished runs pour in situations that none of them has met, without exploring or learning.

From the repository's root, after `learn.py run`: `python docs/reproduction/pouring/evaluate.py --runs 2`. Every episode
becomes a row of evaluation.csv beside this program; those that are there are not made again, unless the run was.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from processes import display, work
from setups import FOLDER, FRESH, OUTCOME, RUNS, Run, append, chosen, outcome, read, rounded, write

from sims.pouring import SETUPS, PouringWorld

EVALUATION = FOLDER / "evaluation.csv"
COLUMNS = (
    "setup",
    "condition",
    "run",
    "learned",
    "situation",
    "seed",
    "status",
    *OUTCOME,
    "expected",
    "simulating",
    "planning",
)
Job = tuple[Run, tuple[int, ...]]  # which situations are to come


def main(
    runs: Annotated[int, typer.Option(min=1, help="Of each condition.")] = 2,
    situations: Annotated[int, typer.Option(min=1, help="The same ones for all runs in a setup.")] = 100,
    processes: Annotated[int, typer.Option(min=1)] = 2,
    only: Annotated[list[str] | None, typer.Option(help='Conditions such as "general*".')] = None,
    episodes: Annotated[int | None, typer.Option(min=1, help="That learn.py was given, if it was.")] = None,
    folder: Annotated[Path, typer.Option(help="Of the runs.")] = RUNS,
    results: Annotated[Path, typer.Option(help="File of the episodes.")] = EVALUATION,
) -> None:
    """Pour, where it has not been done already."""
    rows = read(results)
    jobs: list[Job] = []
    for condition in chosen(only or ["*"], episodes, bases=False):
        for run in (Run(condition, number, folder) for number in range(runs)):
            key = {"setup": condition.setup, "condition": condition.name, "run": str(run.number)}
            mine = [row for row in rows if key.items() <= row.items()]
            if not run.finished:
                typer.echo(f"{condition.key}, run {run.number}: not finished, left out")
                continue
            rows = [row for row in rows if row not in mine or row["learned"] == run.ended]
            done = {row["situation"] for row in mine if row["learned"] == run.ended}
            missing = tuple(k for k in range(situations) if str(k) not in done)
            if missing:
                jobs.append((run, missing))
    write(results, COLUMNS, rows)
    with display() as progress:
        bar = progress.add_task("evaluating", total=sum(len(missing) for _, missing in jobs))
        work(
            functools.partial(pour, results=results),
            jobs,
            processes,
            look=lambda: progress.update(bar, completed=len(results.read_text().splitlines()) - 1 - len(rows)),
        )


def pour(job: Job, results: Path) -> None:
    """Pour in situations with what a run has learned, and write down each."""
    run, situations = job
    append(results, COLUMNS, rows_of(run, situations))


def rows_of(run: Run, situations: Sequence[int]) -> Iterator[dict[str, Any]]:
    """Yield the rows of a finished run, one after the other."""
    world = PouringWorld(**SETUPS[run.condition.setup])
    no_bonus = replace(run.condition, favoured=None).bonus(0)
    with run.loop() as loop:
        for number in situations:
            report = loop.perform(world, FRESH + number, {"bonus": no_bonus})
            returns = report.returns if report.status == "done" else None
            yield {
                "setup": run.condition.setup,
                "condition": run.condition.name,
                "run": run.number,
                "learned": run.ended,
                "situation": number,
                "seed": FRESH + number,
                "status": report.status,
                **outcome(report.known, report.selections["skill"], returns),
                "expected": rounded(report.value),
                "simulating": rounded(report.seconds["simulating"]),
                "planning": rounded(report.seconds["planning"]),
            }


if __name__ == "__main__":
    import evaluate  # by that name its processes find it

    typer.run(evaluate.main)
