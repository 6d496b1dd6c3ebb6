"""What the programs of this folder share: setups, conditions, runs, and the rows of their files."""

from __future__ import annotations

import os

# Before numpy: the matrices are small, and processes share the cores already.
os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

import contextlib
import csv
import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[2]
sys.path.insert(0, str(ROOT))

import symgraph as sg
from models import pouring
from sims.pouring import MATERIALS, SETUPS, PouringWorld
from symgraph.learned import EpisodeStore, Exploration, OnlineLoop, Stage
from symgraph.learned.episodes import Episode
from symgraph.learned.execution import returns_of

RUNS = ROOT / "output/reproduction/pouring"  # a folder per run, not committed
RESULTS = FOLDER / "results.csv"
BONUS, BONUS_EPISODES = 10.0, 10  # the paper's reward shaping: for the favoured skill, in the first episodes of a stage
LAST = 20  # episodes of a run that count as "after learning"
SEEDS = 800  # of run 0, the next ones count from there: lower seeds served to find out what works
FRESH = 10**6  # seeds of situations that no run meets: those of runs are spread over 32 bits


@dataclass(frozen=True)
class Condition:
    """How is learned in a setup.

    Attributes:
        setup: the name of its situations.
        name: as in the paper, PT for pre-training, R for reward shaping.
        episodes: in this setup.
        explore: how much is tried in them.
        after: the condition whose finished run this one goes on from.
        favoured: the skill that reward shaping favours.
        attempts: in an episode, at most.
        hidden: units in the layers of the networks.
    """

    setup: str
    name: str
    episodes: int
    explore: Exploration
    after: Condition | None = None
    favoured: str | None = None
    attempts: int = pouring.TRIALS["attempts"]
    hidden: tuple[int, ...] = pouring.NETWORK["hidden"]

    @property
    def key(self) -> str:
        """The name by which it is asked for."""
        return f"{self.setup}/{self.name}"

    @property
    def total(self) -> int:
        """How many episodes there are with those of the pre-training."""
        return self.episodes + (0 if self.after is None else self.after.total)

    @property
    def stages(self) -> list[Stage]:
        """What a loop goes through, beginning with the pre-training."""
        world = PouringWorld(**SETUPS[self.setup])
        own = Stage(self.setup, world, self.episodes, self.explore, lambda k: {"bonus": self.bonus(k)})
        return [*([] if self.after is None else self.after.stages), own]

    def bonus(self, episode: int) -> np.ndarray:
        """Return the bonus (2,) of tip and shake in an episode of this setup."""
        given = BONUS if episode < BONUS_EPISODES else 0.0
        return np.array([given * (skill == self.favoured) for skill in pouring.SKILLS])

    def shortened(self, episodes: int) -> Condition:
        """Return it with fewer episodes in every setup, to try the programs."""
        after = None if self.after is None else self.after.shortened(episodes)
        return replace(self, episodes=min(episodes, self.episodes), after=after)


FEW = Exploration(selections=0.0, episodes=20, **pouring.EXPLORATION)
MANY = Exploration(selections=0.0, episodes=50, **pouring.EXPLORATION)
BOTH_SKILLS = Exploration(selections=0.4, episodes=50, **pouring.EXPLORATION)
BOTH_SKILLS_VARIED = Exploration(selections=0.4, episodes=100, **pouring.EXPLORATION)

PT0_SETUP1 = Condition("setup1", "PT0-Rnone", 50, FEW)
PT1_SETUP2 = Condition("setup2", "PT1-Rnone", 50, FEW, after=PT0_SETUP1)
CONDITIONS = [
    PT0_SETUP1,
    Condition("setup1", "PT0-Rtip", 50, FEW, favoured="tip"),
    PT1_SETUP2,
    Condition("setup2", "PT1-Rshake", 50, FEW, after=PT0_SETUP1, favoured="shake"),
    Condition("setup2", "PT0-Rnone", 50, FEW),
    Condition("general", "PT2-Rnone", 80, MANY, after=PT1_SETUP2),
    Condition("general", "PT1-Rnone", 80, MANY, after=PT0_SETUP1),
    Condition("general", "PT0-Rnone", 80, MANY),
    Condition("general", "PT0-Rnone, both skills tried", 80, BOTH_SKILLS),
    Condition("general", "PT0-Rnone, both skills tried, one attempt", 80, BOTH_SKILLS, attempts=1),
    # What narrow layers make of 80 episodes wider ones do not; with 300 or more, plans of wider ones are better.
    Condition("varied", "PT0-Rnone, both skills tried", 500, BOTH_SKILLS_VARIED, hidden=(64, 64)),
]


@dataclass(frozen=True)
class Run:
    """One run of a condition.

    Attributes:
        condition: how is learned.
        number: of the run, which decides the seed of all that is random in it.
        runs: the folder of all runs.
    """

    condition: Condition
    number: int
    runs: Path

    @property
    def folder(self) -> Path:
        """Where it is kept."""
        name = self.condition.name.replace(",", "").replace(" ", "-")
        return self.runs / self.condition.setup / name / str(self.number)

    @property
    def seed(self) -> int:
        """Of the loop."""
        return SEEDS + self.number

    @property
    def seeds(self) -> set[int]:
        """Of the world in its episodes, with those of the pre-training."""
        return {seed_of(self.number, number) for number in range(self.condition.total)}

    @property
    def basis(self) -> Run | None:
        """The run that it goes on from."""
        return None if self.condition.after is None else replace(self, condition=self.condition.after)

    @property
    def done(self) -> int:
        """How many of its own episodes are over, without the pre-training."""
        with self._store() as store:
            return 0 if store is None else len(self._ended(store))

    @property
    def finished(self) -> bool:
        """Whether all are."""
        return self.done >= self.condition.episodes

    @property
    def ended(self) -> str:
        """When its last episode ended, UTC, ISO 8601; empty if none has."""
        with self._store() as store:
            ended = [] if store is None else self._ended(store)
        return str(ended[-1].ended) if ended else ""

    def loop(self) -> OnlineLoop:
        """Return the loop in its folder; the graph has a bonus in all conditions, so that runs can build on others."""
        return OnlineLoop(
            pouring.graph(*pouring.networks(hidden=self.condition.hidden), shaped=True),
            self.condition.stages,
            self.folder,
            **pouring.TRIALS | {"attempts": self.condition.attempts},
            limits=pouring.LIMITS,
            optimizer=sg.Lbfgs(starts=8, iterations=60),
            seed=self.seed,
        )

    def rows(self, start: int = 0) -> list[dict[str, Any]]:
        """Return the rows of its own episodes that are over.

        Args:
            start: from which on.
        """
        with self._store() as store:
            if store is None:
                return []
            return [self._row(store, *pair) for pair in list(enumerate(self._ended(store)))[start:]]

    @contextlib.contextmanager
    def _store(self) -> Iterator[EpisodeStore | None]:
        """Lend its store, which another process may be writing; None if nothing is there yet.

        Raises:
            SystemExit: the run was begun with another seed.
        """
        try:
            store = EpisodeStore(self.folder / "episodes.sqlite", read_only=True)
        except sg.StorageError:  # a damaged one the loop reports
            yield None
            return
        with store:
            begun_with = store.settings.get("seed", self.seed)
            if begun_with != self.seed:
                raise SystemExit(
                    f"{self.folder} was begun with seed {begun_with}, but SEEDS in setups.py makes it {self.seed}; "
                    f"move that folder away, or give another --folder"
                )
            yield store

    def _ended(self, store: EpisodeStore) -> list[Episode]:
        return store.episodes(setup=self.condition.setup, status=["done", "failed", "interrupted"])

    def _row(self, store: EpisodeStore, number: int, episode: Episode) -> dict[str, Any]:
        visits = store.visits(episode.number)
        known = store.known(visits[-1]) | episode.info.get("observed", {})
        skill = episode.info["selections"].get("skill", "")
        bonus = float(self.condition.bonus(number) @ [name == skill for name in pouring.SKILLS])
        # The bonus is all that is paid at "ready"; returns without it need no difference.
        paid = [replace(visit, reward=0.0) if visit.node == "ready" else visit for visit in visits]
        returns = returns_of(paid, pouring.TRIALS["again"]) if episode.status == "done" else None
        return {
            "setup": self.condition.setup,
            "condition": self.condition.name,
            "run": self.number,
            "episode": number,
            "seed": episode.seed,
            "status": episode.status,
            **outcome(known, skill, returns),
            "explored": episode.info["explored"].removeprefix("drawn: ").split(":")[0],
            "expected": rounded(episode.info["value"] - bonus),
            **{name: rounded(seconds) for name, seconds in episode.seconds.items()},
        }


OUTCOME = (
    "material",
    "mouth",
    "target",
    "receiver_length",
    "receiver_height",
    "skill",
    "poured",
    "spilled",
    "released",
    "attempts",
    "first_return",
    "return",
)
COLUMNS = (
    *("setup", "condition", "run", "episode", "seed", "status"),
    *OUTCOME,
    *("explored", "expected", "simulating", "planning", "fitting"),
)


def outcome(known: Mapping[str, Any], skill: str, returns: Sequence[float] | None) -> dict[str, Any]:
    """Return the columns `OUTCOME`: situation, skill, amounts and returns of an episode.

    Args:
        known: all that was observed.
        skill: that was used last.
        returns: of each attempt; None if the episode broke off, then its amounts are left out too.
    """
    length, _, height = known["receiver_size"]
    values = {
        "mouth": known["mouth"],
        "target": known["target"],
        "receiver_length": length,
        "receiver_height": height,
    }
    named: dict[str, Any] = {"material": name_of(known["material"]), "skill": skill}
    if returns is not None:
        # What the last attempt changed, and what earlier ones had poured, spilled and let out.
        values |= {
            "poured": known["target"] - known["target_change"] + known["poured_change"],
            "spilled": known["spilled"] + known["spilled_change"],
            "released": known["released"] + known["released_change"],
            "first_return": returns[0],
            "return": math.fsum(returns),
        }
        named["attempts"] = len(returns)
    return dict.fromkeys(OUTCOME, "") | {name: rounded(value) for name, value in values.items()} | named


def rounded(value: float | None) -> str:
    """Return a number as it is written, empty if there is none."""
    return "" if value is None or math.isnan(value) else f"{value:.5g}"


def name_of(features: np.ndarray) -> str:
    """Return the name of a material, or its four numbers if it is a blend."""
    known = [name for name, one in MATERIALS.items() if np.allclose(one.features, features)]
    return known[0] if known else " ".join(rounded(value) for value in features)


def features_of(material: str) -> np.ndarray:
    """Return bounce, friction, attraction and reach of a material that `name_of` wrote."""
    return MATERIALS[material].features if material in MATERIALS else np.array([float(x) for x in material.split()])


def seed_of(run: int, number: int) -> int:
    """Return the world's seed in an episode of a run, counted with the pre-training, as the loop draws it."""
    return int(np.random.SeedSequence([SEEDS + run, number]).generate_state(1)[0])


def chosen(only: Sequence[str], episodes: int | None = None, *, bases: bool = True) -> list[Condition]:
    """Return the conditions whose key fits a pattern such as "setup2*".

    Args:
        only: the patterns.
        episodes: of each, at most.
        bases: whether those that they build on come with them.

    Raises:
        SystemExit: none fits.
    """
    found = {one for one in CONDITIONS if any(fnmatch(one.key, pattern) for pattern in only)}
    if not found:
        raise SystemExit(f"no condition fits {list(only)}; there are {[one.key for one in CONDITIONS]}")
    while bases and (more := {one.after for one in found} - found - {None}):
        found |= more
    return [one if episodes is None else one.shortened(episodes) for one in CONDITIONS if one in found]


def read(path: Path) -> list[dict[str, str]]:
    """Return the rows of a file; a line that a killed program left half-written is dropped from it."""
    if not path.exists():
        return []
    lines = path.read_text().splitlines(keepends=True)
    if lines and not lines[-1].endswith("\n"):
        path.write_text("".join(lines[:-1]))
    return list(csv.DictReader(line for line in lines if line.endswith("\n")))


def write(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write a file, all at once."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.part")
    with part.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    part.replace(path)


def append(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Add rows to a file; several processes may, since a line is one write."""
    for row in rows:
        with path.open("a", newline="") as file:
            csv.DictWriter(file, columns, lineterminator="\n").writerow(row)
