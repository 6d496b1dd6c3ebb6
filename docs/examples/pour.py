"""
Learning to pour
================

A robot holds a container with a narrow mouth and 100 spheres in it, which behave like water, like bouncing balls or like
paste. It is to pour 55 of them into another container. It can *tip*, or turn the container upside down and *shake* it;
neither is always best. How spheres flow it does not know: it learns while it pours, as in section VII of Yamaguchi &
Atkeson, *Differential Dynamic Programming for Graph-Structured Dynamical Systems*, Humanoids 2016.

``make pour`` runs this file. Other situations: ``make pour ARGS="--material vsc --mouth 0.13"``; all options:
``make pour ARGS=--help``.
"""

import enum
from pathlib import Path
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

import symgraph as sg
from models import pouring
from sims.pouring import MATERIALS, PouringWorld
from sims.pouring.rendering import Camera, film, write_video

# %%
# Where it pours
# --------------
# Each episode draws a situation. ``varied`` draws the wanted amount, the receiver's size and materials between the
# known ones as well: there no fixed rule will do.

Condition = enum.StrEnum("Condition", ["general", "setup1", "setup2", "varied"])
Material = enum.StrEnum("Material", list(MATERIALS))

SETUPS = {
    Condition.general: {"material": list(MATERIALS), "mouth": (0.11, 0.25), "target": 0.3},
    Condition.setup1: {"material": "bnc", "mouth": 0.23, "target": 0.3},
    Condition.setup2: {"material": "vsc", "mouth": 0.13, "target": 0.3},
    Condition.varied: {
        "material": list(MATERIALS),
        "blend": True,
        "mouth": (0.11, 0.25),
        "target": (0.1, 0.4),
        "receiver_size": ((0.22, 0.38), 0.4, (0.14, 0.22)),
    },
}

# %%
# The task as a graph
# -------------------
# ``models/pouring.py`` has the graph of the paper's figure 8: grasp, move to the receiver, move to the pouring position,
# choose a skill, pour. Moves are known. How a skill makes the spheres flow, and how a flow fills the receiver, is
# learned by three networks.


def learner(world, episodes, seed, folder):
    graph = pouring.graph(pouring.flow_network("tip"), pouring.flow_network("shake"), pouring.amount_network())
    return sg.learned.OnlineLoop(
        graph, [sg.learned.Stage("pouring", world, episodes)], folder, seed=seed, **pouring.LEARNING
    )


# %%
# What it tells while it learns
# -----------------------------


def name_of(material):
    nearest = min(MATERIALS, key=lambda name: np.abs(MATERIALS[name].features - material).sum())
    return nearest if np.allclose(MATERIALS[nearest].features, material) else f"~{nearest}"


def row(episode):
    seen = episode.known
    return [
        f"{episode.number + 1}",
        name_of(seen["material"]),
        f"{seen['mouth']:.2f}",
        episode.selections["skill"],
        f"{seen['poured_change']:.2f}/{seen['target']:.2f}",
        f"{seen['spilled_change'] / 0.1:.0f}",
        f"{episode.total:.2f}",
        episode.explored,
    ]


HEADS = ["episode", "material", "mouth", "skill", "poured/target", "spilled", "return", "tried"]
WIDTHS = [7, 8, 5, 5, 13, 7, 8, 30]


def line(cells):
    return "  ".join(f"{cell:>{width}}" for cell, width in zip(cells[:-1], WIDTHS, strict=False)) + f"  {cells[-1]}"


def learn(loop, console):
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    returns = []
    with Progress(*columns, TimeRemainingColumn(), console=console) as progress:
        task = progress.add_task("preparing the planner, once", total=loop.episodes, completed=loop.done)
        console.print(line(HEADS))
        for episode in loop:
            returns.append(episode.total)
            console.print(line(row(episode)), highlight=False)
            progress.update(task, advance=1, description=f"learning, latest returns {np.median(returns[-10:]):.2f}")


# %%
# What it has learned
# -------------------
# Situations that it has never met, without learning from them.


def prove(loop, world, count, console, folder):
    table = Table(*HEADS[1:-1], "expected", title="Situations it has never met")
    frames = []
    camera = Camera(world)
    for seed in range(10**6, 10**6 + count):
        world.reset(seed)

        episode = loop.perform(world, seed)
        table.add_row(*row(episode)[1:-1], f"{episode.expected['poured_change']:.2f}")
    console.print(table)
    return table
