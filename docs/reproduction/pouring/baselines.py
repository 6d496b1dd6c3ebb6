"""Pour without learning: random actions, fixed ones, a rule that chooses between these, and the best of many tries.

From the repository's root, `python docs/reproduction/pouring/baselines.py --runs 4`. Every policy has as many attempts
in an episode as the loop, and does the same in each. Every episode becomes a row of baselines.csv beside this program;
those that are there are not made again. The situations are those of the last episodes of runs without pre-training, in
the general setup, and the fresh ones of `evaluate.py`. Nothing is learned here; should the world change, remove the
file.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from processes import display, work
from setups import CONDITIONS, FOLDER, FRESH, LAST, OUTCOME, append, outcome, read, rounded, seed_of, write

import symgraph as sg
from models import pouring
from sims.pouring import ACTIONS, SETUPS, SKILLS, PouringWorld
from sims.pouring.world import RECEIVER_RANGE
from symgraph.learned.execution import Execution, WorldFailed, returns_of
from symgraph.learned.knowledge import Knowledge
from symgraph.learned.records import Visit
from symgraph.outcomes import ModelNumbers

BASELINES = FOLDER / "baselines.csv"
COLUMNS = ("setup", "policy", "run", "situation", "seed", "status", *OUTCOME, "tried", "simulating")
FRESH_RUN = "fresh"  # stands in place of a run's number

Actions = Mapping[str, Any]

GOOD: dict[str, dict[str, Any]] = {  # one set of actions for each skill, good in many situations
    "tip": {"pour_position": (-0.19, 0.327), "tilt_rate": 0.014, "search_rate": 0.003},
    "shake": {
        "pour_position": (-0.20, 0.33),
        "tilt_rate": 0.010,
        "shake_speed": 0.75,
        "shake_stroke": (0.06, -math.pi / 2),
    },
}
GRASP = 0.3  # share of the source's height; it changes little
# Further back everything falls short of the receiver, further forward or higher it flies over it.
USEFUL_POSITIONS = (-0.26, 0.32), (-0.10, 0.42)
FRICTION = 0.225  # halfway between wat or bnc, which are to be tipped, and vsc or vsc+
EPISODES = next(one.episodes for one in CONDITIONS if one.setup == "general")
TRIES, BALLOT = 1, 2  # joined with other numbers, what is drawn for them


@dataclass(frozen=True)
class Job:
    """One episode: which policy in which situation.

    Attributes:
        setup: of the situation.
        policy: a name of `POLICIES`.
        run: whose situation it is, or "fresh".
        situation: its number.
        tries: of the best of many.
    """

    setup: str
    policy: str
    run: str
    situation: int
    tries: int

    @property
    def seed(self) -> int:
        """Of the world."""
        return FRESH + self.situation if self.run == FRESH_RUN else seed_of(int(self.run), self.situation)

    @property
    def key(self) -> tuple[str, ...]:
        """What tells it from others in the file."""
        return self.setup, self.policy, self.run, str(self.situation)


def job_of(row: Mapping[str, str]) -> Job:
    """Return the job that a row came from, but for the number of tries."""
    return Job(row["setup"], row["policy"], row["run"], int(row["situation"]), tries=0)


def random_choice(job: Job, world: PouringWorld) -> tuple[str, Actions]:
    """Both skills in turn, with actions from their whole range."""
    rng = np.random.default_rng([job.seed, BALLOT])
    return SKILLS[job.situation % 2], {
        label: bounds.scale(rng.random(len(bounds.low))) for label, bounds in ACTIONS.items()
    }


def always_tip(job: Job, world: PouringWorld) -> tuple[str, Actions]:
    """The same tip everywhere."""
    return "tip", GOOD["tip"]


def always_shake(job: Job, world: PouringWorld) -> tuple[str, Actions]:
    """The same shake everywhere."""
    return "shake", GOOD["shake"]


def rule(job: Job, world: PouringWorld) -> tuple[str, Actions]:
    """Tip wat, bnc and what is like them, shake all else."""
    world.reset(job.seed)
    skill = "shake" if world.behaviour.simulation.material.friction > FRICTION else "tip"
    return skill, GOOD[skill]


POLICIES = {"random": random_choice, "always tip": always_tip, "always shake": always_shake, "rule": rule}
BEST = "best of tries"


@functools.cache
def task() -> tuple[sg.Graph, ModelNumbers]:
    """The graph, whose networks nobody asks here, and what evaluates its rewards."""
    return pouring.graph(*pouring.networks()), ModelNumbers()


def episode(
    world: PouringWorld, seed: int, skill: str, actions: Actions, attempts: int = pouring.TRIALS["attempts"]
) -> dict[str, Any]:
    """Pour, with the rewards that an on-line loop would get; return the columns from "status" on."""
    graph, models = task()
    knowledge = Knowledge(graph, models, pouring.TRIALS["decisions"])
    execution = Execution(graph, world, knowledge, 0)
    decision = {"grasp_ratio": GRASP, **actions}, {"skill": skill}
    status, observed = "done", {}
    left = attempts

    def goes_on(visit: Visit) -> bool:
        nonlocal left
        left -= visit.node == pouring.TRIALS["again"]
        return left > 0 and visit.node != "receiver_moved"

    try:
        execution.run(
            seed,
            {},
            decide=lambda visit: decision,
            reached=lambda visits, new: None,
            goes_on=goes_on,
        )
    except WorldFailed as failure:
        status, observed = "failed", failure.observed or {}
    known = knowledge.at[execution.visits[-1].step] | observed
    returns = returns_of(execution.visits, pouring.TRIALS["again"]) if status == "done" else None
    return {"status": status, **outcome(known, skill, returns), "simulating": rounded(execution.seconds)}


def best_of_tries(job: Job, world: PouringWorld) -> dict[str, Any]:
    """Try actions of both skills once in a situation, then do the best ones in the same situation with new noise.

    What is noise in the world is how the spheres have settled in the source. A world in which nothing is left to draw
    has the situation under every seed, and the seed decides the settling alone.
    """
    world.reset(job.seed)
    rng = np.random.default_rng([job.seed, TRIES])
    tried: list[tuple[float, str, Actions]] = []
    for number in range(job.tries):
        skill = SKILLS[number % 2]
        actions = GOOD[skill] if number < len(SKILLS) else _useful(rng)
        total = episode(world, job.seed, skill, actions, attempts=1)["return"]
        tried.append((float(total or -math.inf), skill, actions))
    total, skill, actions = max(tried, key=lambda one: one[0])
    return {**episode(same_situation(world), job.seed + 1, skill, actions), "tried": rounded(total)}


def _useful(rng: np.random.Generator) -> Actions:
    """Draw actions from their whole range, but positions where most is poured into the receiver."""
    drawn = {label: bounds.scale(rng.random(len(bounds.low))) for label, bounds in ACTIONS.items()}
    return drawn | {"pour_position": rng.uniform(*USEFUL_POSITIONS)}


def same_situation(world: PouringWorld) -> PouringWorld:
    """Return a world whose every reset leads to the situation of this one's episode, and settles the spheres anew."""
    simulation, behaviour = world.behaviour.simulation, world.behaviour
    return PouringWorld(
        simulation.material,
        simulation.source.mouth,
        behaviour.target,
        # The receiver is free-standing; what little it was moved since may have taken it out of the range.
        float(np.clip(simulation.receiver_pose[0], *RECEIVER_RANGE)),
        simulation.receiver.size,
    )


def pour(job: Job, results: Path) -> None:
    """Do a job and write it down."""
    world = PouringWorld(**SETUPS[job.setup])
    if job.policy == BEST:
        row = best_of_tries(job, world)
    else:
        row = episode(world, job.seed, *POLICIES[job.policy](job, world))
    about = dict(zip(COLUMNS[:4], job.key, strict=True))
    append(results, COLUMNS, [{**about, "seed": job.seed, **row}])


def main(
    runs: Annotated[int, typer.Option(min=0, help="In whose last situations is poured.")] = 8,
    fresh: Annotated[int, typer.Option(min=0, help="Situations that no run meets, of each setup.")] = 100,
    tries: Annotated[int, typer.Option(min=2, help="Of which the best is taken, in the setup varied.")] = 30,
    processes: Annotated[int, typer.Option(min=1)] = 2,
    only: Annotated[list[str] | None, typer.Option(help='Policies such as "always*".')] = None,
    results: Annotated[Path, typer.Option(help="File of the episodes.")] = BASELINES,
) -> None:
    """Pour, where it has not been done already."""
    found = read(results)
    rows = [row for row in found if row["seed"] == str(job_of(row).seed)]
    if len(rows) < len(found):
        typer.echo(f"{len(found) - len(rows)} rows of other seeds are dropped")
    write(results, COLUMNS, rows)
    done = {job_of(row).key for row in rows}
    where = [(setup, FRESH_RUN, k) for k in range(fresh) for setup in ("general", "varied")]
    last = range(EPISODES - LAST, EPISODES)
    where += [("general", str(run), k) for run in range(runs) for k in last]
    jobs = [Job(setup, name, run, k, tries) for setup, run, k in where for name in POLICIES]
    jobs += [Job("varied", BEST, FRESH_RUN, k, tries) for k in range(fresh)]
    wanted = [job for job in jobs if any(fnmatch(job.policy, pattern) for pattern in only or ["*"])]
    jobs = [job for job in wanted if job.key not in done]
    with display() as progress:
        bar = progress.add_task("pouring", total=len(jobs))
        work(
            functools.partial(pour, results=results),
            jobs,
            processes,
            look=lambda: progress.update(bar, completed=len(results.read_text().splitlines()) - 1 - len(rows)),
        )


if __name__ == "__main__":
    import baselines  # by that name its processes find it

    typer.run(baselines.main)
