"""The main job, killed again and again: nothing is lost, and it ends like one that was left alone."""

import os
import random
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import symgraph as sg
from symgraph.learned import EpisodeStore, StochasticNetwork

ROOT = Path(__file__).parents[1]
EPISODES, KILLS = 14, 10
LONGEST = 900  # that a run, or what comes before a kill, may take on a busy machine [s]
NETWORKS = "F_flow_tip", "F_flow_shake", "F_release_tip", "F_release_shake", "F_amount"


def started(folder, *options):
    words = sys.executable, ROOT / "docs/examples/pour.py", "--output", folder, "--episodes", EPISODES, "--seed", 5
    return subprocess.Popen(
        [str(word) for word in (*words, *options)],
        env=os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"},
        stdout=subprocess.DEVNULL,
    )


def experience(folder):
    """All that was seen, decided and paid, and what the networks make of it; without times."""
    with EpisodeStore(folder / "episodes.sqlite", read_only=True) as store:
        episodes = [(e.number, e.setup, e.seed, e.status, e.reason, e.total, e.info) for e in store.episodes()]
        visits, plans = store.visits(), [store.plans(number) for number, *_ in episodes]
    networks = [StochasticNetwork.load(folder / f"{name}.safetensors") for name in NETWORKS]
    return episodes, visits, plans, networks


@pytest.mark.slow
@pytest.mark.timeout(4 * LONGEST)
def test_ten_kills_at_random_moments_change_nothing(tmp_path):
    assert started(tmp_path / "alone").wait(LONGEST) == 0
    with EpisodeStore(tmp_path / "alone/episodes.sqlite", read_only=True) as alone:
        learning = sum(sum(episode.seconds.values()) for episode in alone.episodes())
    store = tmp_path / "killed/episodes.sqlite"
    moments = random.Random(0)
    steps = 0
    for kill in range(KILLS):
        process = started(tmp_path / "killed", *(["--resume"] if kill else []))
        try:
            deadline = time.monotonic() + LONGEST
            while visits_in(store, begun=steps > 0) <= steps:  # it gets to work, and a little further
                assert process.poll() is None, f"over before kill {kill}"
                assert time.monotonic() < deadline, f"nothing new before kill {kill}"
                time.sleep(0.02)
            time.sleep(moments.uniform(0.0, learning / (2 * KILLS)))
        finally:
            process.kill()
            process.wait()
        assert visits_in(store) >= steps  # what was there is there
        steps = visits_in(store)
    assert started(tmp_path / "killed", "--resume").wait(LONGEST) == 0

    alone, killed = experience(tmp_path / "alone"), experience(tmp_path / "killed")
    assert len(alone[0]) == EPISODES
    for mine, other in zip(alone[:3], killed[:3], strict=True):
        assert mine == other
    for mine, other in zip(alone[3], killed[3], strict=True):
        assert mine.samples == other.samples
        for parameter, same in zip(mine.parameters, other.parameters, strict=True):
            np.testing.assert_array_equal(parameter.value, same.value)


def visits_in(store, begun=True):
    """How many; 0 while there is no store, if it need not be begun yet."""
    try:
        with EpisodeStore(store, read_only=True) as reader:
            return len(reader.visits())
    except sg.StorageError:
        if begun:
            raise
        return 0
