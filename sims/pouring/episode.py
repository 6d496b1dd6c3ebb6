"""Whole episodes with a policy, one after the other or on several cores."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import joblib
from numpy.typing import ArrayLike

from sims.pouring.actions import Clamp
from sims.pouring.behaviour import End
from sims.pouring.observation import Observation
from sims.pouring.simulation import SimulationFailed
from sims.pouring.world import PouringWorld

Choice = tuple[Mapping[str, ArrayLike], Mapping[str, str]]
Policy = Callable[[str, Observation], Choice]


@dataclass
class Episode:
    """What happened in an episode.

    Attributes:
        seed: With which the world was reset.
        steps: (node reached, what was observed on the way there), from "start" on.
        stops: Why the skill stopped, trial by trial.
        end: Why the episode was over; None if it was left although it could have gone on.
        metrics: Counts at the end.
        clamps: Commands that could not be followed as given.
    """

    seed: int
    steps: list[tuple[str, Observation]] = field(default_factory=list)
    stops: list[str | None] = field(default_factory=list)
    end: End | None = None
    metrics: dict[str, float] = field(default_factory=dict)
    clamps: list[Clamp] = field(default_factory=list)


def run_episode(
    world: PouringWorld,
    policy: Policy,
    seed: int,
    trials: int | None = None,
    begin: Callable[[PouringWorld], None] | None = None,
) -> Episode:
    """Run an episode to its end.

    Args:
        world: Where.
        policy: (node, all that is known) -> (actions, selections).
        seed: Of the episode.
        trials: After how many to leave; None goes on until the episode is over.
        begin: Called after the reset, to attach a camera or a viewer to the episode.

    Returns:
        What happened; a failed simulation ends the episode as End.FAILED with what was measured.
    """
    episode = Episode(seed)
    known = world.reset(seed)
    if begin is not None:
        begin(world)
    episode.steps.append(("start", dict(known)))
    while world.end is None and len(episode.stops) != trials:
        actions, selections = policy(world.node, known)
        try:
            reached = world.execute(world.node, actions, selections)
        except SimulationFailed as failure:
            reached = {"failed": failure.observed}
        episode.steps.extend(reached.items())
        for observed in reached.values():
            known = {**known, **observed}
        if "poured" in reached:
            episode.stops.append(world.behaviour.trial.stopped)
    episode.end = world.end or world.behaviour.end
    episode.metrics, episode.clamps = world.metrics, list(world.clamps)
    return episode


def fixed_policy(actions: Mapping[str, ArrayLike], skill: str) -> Policy:
    """Return the policy that always does the same."""
    return lambda node, known: (actions, {"skill": skill})


def run_episodes(
    jobs: Sequence[tuple[Mapping[str, Any], Mapping[str, ArrayLike], str, int]],
    trials: int | None = None,
    processes: int = 1,
) -> list[Episode]:
    """Run episodes with fixed actions side by side.

    Args:
        jobs: (arguments of PouringWorld, actions, skill, seed) of each.
        trials: After how many to leave each.
        processes: How many processes; the results do not depend on it.

    Returns:
        The episodes in the order of the jobs.
    """
    run = joblib.delayed(_run_job)
    return list(joblib.Parallel(n_jobs=processes)(run(job, trials) for job in jobs))


def _run_job(job: tuple[Mapping[str, Any], Mapping[str, ArrayLike], str, int], trials: int | None) -> Episode:
    arguments, actions, skill, seed = job
    return run_episode(PouringWorld(**arguments), fixed_policy(actions, skill), seed, trials)
