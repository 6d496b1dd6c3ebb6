"""Visits, an episode and processes for the tests of the episode store."""

import os
import subprocess
import sys
from pathlib import Path

from symgraph.learned import Visit

ROOT = Path(__file__).parents[1]


def script(code, *arguments, **options):
    """Start Python with code that finds this symgraph."""
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-c", f"import os, sys\nfrom symgraph.learned import EpisodeStore, Visit\n{code}", *arguments],
        env=os.environ | {"PYTHONPATH": paths},
        stdout=subprocess.PIPE,
        text=True,
        **options,
    )


def output_of(process, timeout=300):
    out, _ = process.communicate(timeout=timeout)  # [s]
    assert process.returncode == 0
    return out


def visit(step, parent=0, node="a", episode=0, observed=None, actions=None, selections=None, reward=0.0):
    return Visit(episode, step, parent, node, observed or {}, actions or {}, selections or {}, reward)


def grown(store):
    """An episode of a grasp, two attempts and what each of two groups observed."""
    store.begin(0, "water", 7, {"amount": 0.0, "position": [1.0, 2.0]}, reward=-0.5, node="start")
    store.add([visit(1, 0, "grasped", observed={"height": 0.25}, actions={"ratio": 0.5})])
    pour = {"actions": {"rate": [0.1, 0.2]}, "selections": {"skill": "tip"}}
    store.add(
        [
            visit(2, 1, "poured", observed={"amount": 0.3}, **pour, reward=-1.0),
            visit(3, 1, "moved", observed={"position": [1.5, 2.0]}, **pour),
        ]
    )
    store.add([visit(4, 2, "poured", observed={"amount": 0.4, "height": 0.125}, reward=-0.25)])
