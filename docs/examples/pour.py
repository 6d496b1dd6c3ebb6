"""
Learning to pour
================

A robot holds a container with a narrow mouth and 100 spheres in it, which behave like water, like bouncing balls or
like paste. It is to pour 55 of them into another container. It can *tip* its container, or turn it upside down and
*shake*; neither is best everywhere. How spheres flow it does not know: it learns that while it pours, as in section VII
of Yamaguchi & Atkeson, *Differential Dynamic Programming for Graph-Structured Dynamical Systems*, Humanoids 2016.

``make pour`` runs this file: about four minutes for 80 episodes. Other tasks are options, such as
``make pour ARGS="--material vsc --mouth 0.13"``; ``make pour ARGS=--help`` lists them.
"""

# %%
# Where it pours
# --------------
# Every episode draws a situation. In the setup "varied" that includes the wanted amount, the receiver's size, and
# materials between the known ones.

import enum
import itertools
from pathlib import Path
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

import symgraph as sg
from models import pouring
from sims.pouring import MATERIALS, PouringWorld
from sims.pouring.rendering import FilmedWorld, write_video

SETUPS = {
    "general": {"material": list(MATERIALS), "mouth": (0.11, 0.25), "target": 0.3},
    "setup1": {"material": "bnc", "mouth": 0.23, "target": 0.3},
    "setup2": {"material": "vsc", "mouth": 0.13, "target": 0.3},
    "varied": {
        "material": list(MATERIALS),
        "blend": True,
        "mouth": (0.11, 0.25),
        "target": (0.1, 0.4),
        "receiver_size": ((0.22, 0.38), 0.4, (0.14, 0.22)),
    },
}
PROOFS = 6  # situations at the end that it has never met
EXPLORED = 60  # episodes in which it tries something beside its plans, less often each time

# %%
# The task and the loop
# ---------------------
# ``models/pouring.py`` holds the graph of the paper's figure 8: grasp, move to the receiver, move to the pouring
# position, choose a skill, pour. Five networks are left to be learned: for each skill one that tells where a flow comes
# down and one that tells how much is released, and one for how much of that is poured and spilled. The loop plans,
# pours, stores what happened, fits the networks whose edges ran, and goes on. If too little was poured it tries again,
# up to four times in an episode.


def loop_in(world, name, episodes, seed, folder):
    graph = pouring.graph(*pouring.networks())
    return sg.learned.OnlineLoop(
        graph,
        [sg.learned.Stage(name, world, episodes, sg.learned.Exploration(episodes=EXPLORED, **pouring.EXPLORATION))],
        folder,
        **pouring.TRIALS,
        limits=pouring.LIMITS,
        optimizer=sg.Lbfgs(starts=8, iterations=60),
        seed=seed,
    )


# %%
# What it tells
# -------------

HEADS = ["material", "mouth", "skill", "attempts", "poured / target", "spilled", "return"]
WIDTHS = [8, 5, 5, 8, 15, 7, 8]


def aligned(cells):
    return "  ".join(f"{cell:>{width}}" for cell, width in zip(cells, WIDTHS, strict=True))


def told(episode):
    if episode.status != "done":
        return f"{episode.status}: {episode.reason}"
    seen = episode.known
    return aligned(
        [
            name_of(seen["material"]),
            f"{seen['mouth']:.2f}",
            episode.selections["skill"],
            f"{episode.attempts}",
            f"{seen['target'] - seen['target_change'] + seen['poured_change']:.3f} / {seen['target']:.3f}",
            f"{(seen['spilled'] + seen['spilled_change']) / 0.1:.0f}",
            f"{episode.total:.2f}",
        ]
    )


def name_of(features):
    name = min(MATERIALS, key=lambda one: np.abs(MATERIALS[one].features - features).sum())
    return name if np.allclose(MATERIALS[name].features, features) else f"near {name}"


def learn(loop, console):
    returns = []
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("preparing the planner", total=loop.episodes, completed=loop.done)
        console.print(f"episode  {aligned(HEADS)}  tried", highlight=False)
        for episode in loop:
            console.print(f"{episode.number + 1:7}  {told(episode)}  {episode.explored.split(':')[0]}", highlight=False)
            returns.append(episode.total if episode.status == "done" else np.nan)
            recent = np.nanmedian(returns[-10:])
            progress.update(task, advance=1, description=f"learning; median of the last 10 returns {recent:.2f}")


# %%
# What it has learned
# -------------------
# It pours in situations that it has never met, without exploring or learning. The film shows the first tip and the
# first shake among them.


def prove(loop, world, console, folder):
    console.print(f"\nSituations it has never met\n{aligned(HEADS)}  expected", highlight=False)
    films = {}
    for seed in range(10**6, 10**6 + PROOFS):
        filmed = FilmedWorld(world)
        episode = loop.perform(filmed, seed)
        expected = episode.expected.get("poured_change", np.nan)
        console.print(f"{told(episode)}  {expected:.3f}", highlight=False)
        films.setdefault(episode.selections["skill"], filmed.frames)
    write_video(folder / "pouring.mp4", [frame for frames in films.values() for frame in frames], fps=20)


# %%
# The returns tell how it got there. Most of what is lost is lost while it explores.


def draw_curve(loop, folder):
    episodes = loop.store.episodes(status="done")
    returns = np.array([episode.total for episode in episodes])
    skills = np.array([episode.info["selections"]["skill"] for episode in episodes])
    explored = np.array([bool(episode.info["explored"]) for episode in episodes])
    figure, axes = plt.subplots(figsize=(8, 3.5), layout="constrained")
    for skill, marker, colour in (("tip", "o", "tab:blue"), ("shake", "^", "tab:orange")):
        for tried in (True, False):
            at = (skills == skill) & (explored == tried)
            label = f"{skill}, {'explored' if tried else 'planned'}"
            shade = "none" if tried else colour
            axes.scatter(np.flatnonzero(at) + 1, returns[at], marker=marker, c=shade, edgecolors=colour, label=label)
    axes.set(yscale="symlog", xlabel="episode", ylabel="return", title="Learning to pour")
    axes.legend(ncols=2, fontsize="small")
    figure.savefig(folder / "learning_curve.png", dpi=150)


# %%
# The skill map shows what it would do in other situations: which skill, and the return that it expects.


def draw_map(loop, target, folder):
    mouths = np.linspace(0.11, 0.25, 8)
    figure, axes = plt.subplots(figsize=(8, 3), layout="constrained")
    for j, material in enumerate(MATERIALS):
        for mouth in mouths:
            situation = PouringWorld(material, float(mouth), target, receiver_x=0.8).reset(0)
            plan = loop.plan(situation)
            marker = {"tip": "o", "shake": "^"}[plan.selections["skill"]]
            picture = axes.scatter(mouth, j, marker=marker, s=120, c=[plan.value], vmin=-2, vmax=0, cmap="viridis")
    axes.set(xlabel="mouth", yticks=range(len(MATERIALS)), yticklabels=MATERIALS, ylim=(-0.5, len(MATERIALS) - 0.5))
    axes.set_title("Planned skill: ○ tip, △ shake")
    figure.colorbar(picture, label="expected return")
    figure.savefig(folder / "skill_map.png", dpi=150)


# %%
# All of it
# ---------

Setup = enum.StrEnum("Setup", list(SETUPS))
Material = enum.StrEnum("Material", list(MATERIALS))


def main(
    condition: Annotated[Setup, typer.Option(help="What situations are drawn.")] = Setup.general,
    material: Annotated[Material | None, typer.Option(help="Pour this only.")] = None,
    mouth: Annotated[float | None, typer.Option(help="Width of the mouth, 0.11 to 0.25.")] = None,
    target: Annotated[float | None, typer.Option(help="Amount to pour; a sphere is 0.0055.")] = None,
    episodes: Annotated[int, typer.Option(min=1)] = 80,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    output: Annotated[Path, typer.Option(help="Folder of all that is kept.")] = Path("output/pour"),
    resume: Annotated[bool, typer.Option(help="Go on with the run in that folder.")] = False,
):
    """Learn to pour from scratch, then pour in situations never met."""
    console = Console()
    given = {"material": material and str(material), "mouth": mouth, "target": target}
    given = {name: value for name, value in given.items() if value is not None}
    world = PouringWorld(**SETUPS[condition] | given)
    if not resume:
        output = unused(output)
    console.print(f"All is kept in {output}; --resume --output {output} goes on with it", highlight=False)
    name = " ".join([str(condition), *(f"{name}={value}" for name, value in given.items())])
    with loop_in(world, name, episodes, seed, output) as loop:
        learn(loop, console)
        prove(loop, world, console, output)
        draw_curve(loop, output)
        draw_map(loop, 0.3 if target is None else target, output)
    console.print(f"\nLearning curve, skill map, film, episodes and networks are in {output}", highlight=False)


def unused(folder):
    """The folder, or one beside it that holds no run yet."""
    beside = (folder.with_name(f"{folder.name}-{number}") for number in itertools.count(2))
    return next(one for one in itertools.chain([folder], beside) if not (one / "episodes.sqlite").exists())


if __name__ == "__main__":
    typer.run(main)
