"""Past: what a loop remembers of the episodes that are over."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from symgraph.learned.deciding import Notes
from symgraph.learned.novelty import Try

STARTS = 1  # joined with other numbers, what is drawn for start points


@dataclass(frozen=True)
class PastEpisode:
    """What is remembered of an episode.

    Attributes:
        setup: the name of its stage.
        total: its return; None if it ended early, and may not have come to what it would have been punished for.
        decision: the last one, {label: value or choice}.
        tries: the choices that were executed.
    """

    setup: str
    total: float | None
    decision: dict[str, Any]
    tries: list[Try]


class Past:
    """The episodes that are over, in their order.

    Args:
        seed: of the loop.
        remembered: how many start points are drawn from them, at most.
    """

    def __init__(self, seed: int, remembered: int) -> None:
        self._seed = seed
        self.remembered = remembered
        self.episodes: list[PastEpisode] = []

    @property
    def tries(self) -> list[Try]:
        """The choices that were executed in every episode."""
        return [one for episode in self.episodes for one in episode.tries]

    def add(
        self, setup: str, status: str, total: float | None, plans: Mapping[int, Notes], tries: Sequence[Try]
    ) -> None:
        """Remember an episode, given {step: notes} of its plans, and its tries."""
        last: Notes = plans[max(plans)] if plans else {"actions": {}, "selections": {}}
        counts = status == "done" and bool(plans) and total is not None and math.isfinite(total)
        decision = {**last["actions"], **last["selections"]}
        self.episodes.append(PastEpisode(setup, total if counts else None, decision, list(tries)))

    def rewind(self, count: int) -> None:
        """Forget all episodes but the first so many."""
        del self.episodes[count:]

    def starts(self, number: int, setup: str | None) -> list[dict[str, Any]]:
        """Draw start points for an episode from the better half of those of a stage, of all stages if None."""
        done = [
            (one.total, one.decision) for one in self.episodes if one.total is not None and setup in (None, one.setup)
        ]
        better = sorted(done, key=lambda one: -one[0])[: (len(done) + 1) // 2]
        rng = np.random.default_rng([self._seed, number, STARTS])
        return [better[i][1] for i in rng.permutation(len(better))[: self.remembered]]
