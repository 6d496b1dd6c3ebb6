"""Schedule: which world for how many episodes, how much is explored, and what is given beside what is observed."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from symgraph.errors import InputError
from symgraph.learned.inputs import checked_number
from symgraph.learned.records import shown


class World(Protocol):
    """What an on-line loop drives: a simulator or a robot."""

    def reset(self, seed: int) -> Mapping[str, Any]:
        """Begin an episode; return {label: value} of the states that are observed at the start node."""
        ...

    def execute(
        self, node: str, actions: Mapping[str, Any], selections: Mapping[str, str]
    ) -> Mapping[str, Mapping[str, Any]]:
        """Do what leaves a node.

        Returns:
            {node reached: {label: value} observed on the way there}, one entry for each group that happened; {} where
            the graph ends and the world does not lead back.

        Raises:
            Exception: it failed; what was observed until then is the exception's attribute `observed`, {label: value}.
        """
        ...

    def close(self) -> None:
        """Let go of everything; whoever made the world calls it, not the loop."""
        ...


@dataclass(frozen=True)
class Exploration:
    """How much is tried beside what is planned, in the first episodes.

    As long as anything is tried, plans take learned models for certain: what they do not know of a choice is no reason
    to leave it alone. Actions come closer and closer to plans; selections do not, for a choice is learned best by tries
    that are as good as can be, and those come last. Beside that, `solve` explores by itself while a model has too few
    samples.

    Args:
        selections: probability that an attempt's selections are drawn instead of planned. What is drawn is the choice
            known least: the one with the lowest density of tries, of all stages, in the situation. Situations are told
            apart by those states that learned models read and that are known where an episode starts.
        actions: probability that its actions are drawn from their whole range, in the first episode; falls linearly.
        noise: standard deviation of what is added to actions that are not drawn, as a share of their range, in the
            first episode; falls linearly.
        episodes: after how many nothing is tried any more; 0 to try nothing at all.

    Raises:
        InputError: a number outside its range.
    """

    selections: float = 0.4
    actions: float = 1.0
    noise: float = 0.1
    episodes: int = 50

    def __post_init__(self) -> None:
        for name, most in (("selections", 1.0), ("actions", 1.0), ("noise", 1.0), ("episodes", math.inf)):
            checked_number(getattr(self, name), f"Exploration: {name}", most)

    @property
    def explores(self) -> bool:
        """Whether anything is tried."""
        return bool(self.episodes and (self.selections or self.actions or self.noise))

    def at(self, episode: int) -> Exploration:
        """Return how much is tried in an episode, from 0 on, and in no other."""
        share = max(0.0, 1.0 - episode / self.episodes) if self.episodes else 0.0
        return Exploration(self.selections if share else 0.0, self.actions * share, self.noise * share, 1)


@dataclass(frozen=True)
class Stage:
    """A part of what is to be learned from: so many episodes in one world.

    Args:
        name: under which its episodes are stored; no two stages of a loop share one.
        world: where they happen, see `World`.
        episodes: how many.
        explore: how much is tried, `Exploration()` if left out, which draws all actions at first and two selections
            in five; nothing with `Exploration(episodes=0)`. Counts the episodes of this stage.
        given: {label: value} of states that the world's `reset` does not observe, or a function of the stage's episode,
            from 0 on, that returns it: reward shaping gives, say, a bonus that ends after ten episodes.

    Raises:
        InputError: an argument that does not fit.
    """

    name: str
    world: World
    episodes: int
    explore: Exploration = field(default_factory=Exploration)
    given: Mapping[str, Any] | Callable[[int], Mapping[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise InputError(f"Stage: name is {self.name!r}; give a non-empty string")
        for method in ("reset", "execute", "close"):
            if not callable(getattr(self.world, method, None)):
                raise InputError(
                    f"stage {self.name!r}: world is {self.world!r}, which has no method {method!r}; see World"
                )
        if isinstance(self.episodes, bool) or not isinstance(self.episodes, (int, np.integer)) or self.episodes < 1:
            raise InputError(f"stage {self.name!r}: episodes = {self.episodes!r}; give a positive whole number")
        if not isinstance(self.given, Mapping) and not callable(self.given):
            raise InputError(
                f"stage {self.name!r}: given is {self.given!r}; give {{label: value}}, or a function of it"
            )
        if callable(self.given) and not _takes_episode(self.given):
            raise InputError(
                f"stage {self.name!r}: given is a function that cannot be called with the stage's episode alone; give "
                f"one of one argument, or {{label: value}}"
            )
        if not isinstance(self.explore, Exploration):
            raise InputError(f"stage {self.name!r}: explore is {self.explore!r}; give an Exploration")

    def given_at(self, episode: int) -> Mapping[str, Any]:
        """Return the states that are given in an episode of this stage."""
        if not callable(self.given):
            return self.given
        given = self.given(episode)
        if not isinstance(given, Mapping):
            raise InputError(
                f"stage {self.name!r}: given returned {shown(given)} for its episode {episode}; return {{label: value}}"
            )
        return given


def _takes_episode(function: Callable[..., Any]) -> bool:
    try:
        signature = inspect.signature(function)
    except ValueError:  # a builtin that tells nobody what it takes
        return True
    try:
        signature.bind(0)
    except TypeError:
        return False
    return True
