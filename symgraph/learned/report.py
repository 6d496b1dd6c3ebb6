"""EpisodeReport: what happened in an episode of an on-line loop."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from symgraph.learned.knowledge import Known


@dataclass(frozen=True)
class EpisodeReport:
    """What happened in an episode.

    Attributes:
        number: counted from 0.
        setup: the name of its stage.
        seed: that the world was reset with.
        status: "done", "failed" or "interrupted".
        reason: why it failed or was interrupted, else empty.
        returns: of each attempt, from one going through the graph to the next, the sum of its rewards.
        actions: {label: value} decided last.
        selections: {label: choice} decided last.
        expected: {label: mean} of what the last plan promised.
        value: that the last plan promised; while the stage explores, as if learned models were certain, and so is
            `expected`.
        explored: why the last decision was not the best plan, "drawn: selections, actions" or "exploring: …"; empty if
            it was, but for noise. While the stage explores, best is what is best as if learned models were certain.
        known: {label: value} of all that was observed, decided or follows from it, the latest.
        seconds: {"simulating", "planning", "fitting": time} [s].
    """

    number: int
    setup: str
    seed: int
    status: str
    reason: str
    returns: tuple[float, ...]
    actions: dict[str, Any]
    selections: dict[str, str]
    expected: dict[str, Any]
    value: float
    explored: str
    known: Known
    seconds: dict[str, float]

    @property
    def attempts(self) -> int:
        """How often the graph was gone through, at least to its first node."""
        return len(self.returns)

    @property
    def total(self) -> float:
        """The return of the whole episode."""
        return math.fsum(self.returns)

    def __str__(self) -> str:
        chosen = ", ".join(f"{label} = {choice}" for label, choice in self.selections.items())
        # What an episode that broke off was paid until then would pass for what it is worth.
        end = f"return {self.total:.3g}" if self.status == "done" else f"{self.status}: {self.reason}"
        parts = [f"{self.setup} {self.number}", chosen, end, self.explored]
        return "; ".join(part for part in parts if part)
