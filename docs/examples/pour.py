"""
Learning to pour
================

A robot holds a container with a narrow mouth and 100 spheres in it, which behave like water, like bouncing balls or
like paste. It is to pour 55 of them into another container. It can *tip* its container, or turn it upside down and
*shake*; neither is best everywhere. How spheres flow it does not know: it learns that while it pours, as in section VII
of Yamaguchi & Atkeson, *Differential Dynamic Programming for Graph-Structured Dynamical Systems*, Humanoids 2016.

``make pour`` runs this file: four to six minutes for 80 episodes. Other tasks are options, such as
``make pour ARGS="--material vsc --mouth 0.13"``; ``make pour ARGS=--help`` lists them. It prints the command that
goes on with it where it was stopped.
"""

# %%
# Where it pours
# --------------
# Every episode draws a situation. In the setup "varied" that includes the wanted amount, the receiver's size, and
# materials between the known ones.

import enum
import itertools
import json
import os
import shlex
import sys
from pathlib import Path
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from typer import Option

import symgraph as sg
from models import pouring
from sims.pouring import MATERIALS, SETUPS, PouringWorld
from sims.pouring.behaviour import SPHERE_AMOUNT, SPILL_AMOUNT
from sims.pouring.rendering import RecordedWorld, write_video

PROOFS = 6  # situations at the end that it has never met
EXPLORED = 50  # episodes in which it tries something beside its plans
OPTIMIZER = sg.Lbfgs(starts=8, iterations=60)

# %%
# The task and the loop
# ---------------------
# ``models/pouring.py`` holds the graph of the paper's figure 8: grasp, move to the receiver, move to the pouring
# position, choose a skill, pour. Five networks are left to be learned: for each skill one that tells where a flow comes
# down and one that tells how much is released, and one for how much of that is poured and spilled. The loop plans,
# pours, stores what happened, fits the networks whose edges ran, and goes on. If too little was poured it tries again,
# up to four times in an episode.


def loop_in(world, name, options, folder):
    explore = sg.learned.Exploration(episodes=EXPLORED, **pouring.EXPLORATION)
    return sg.learned.OnlineLoop(
        pouring.graph(*pouring.networks()),
        [sg.learned.Stage(name, world, options["episodes"], explore)],
        folder,
        **pouring.TRIALS,
        limits=pouring.LIMITS,
        optimizer=OPTIMIZER,
        seed=options["seed"],
    )


# %%
# What it tells
# -------------
# A line for each episode, with the skill of each attempt. The returns of the attempts add up.

COLUMNS = {"material": 8, "mouth": 5, "poured": 7, "spilled": 7, "return": 7}
WHY = {"": "", "drawn": "*", "exploring": "?"}  # an attempt was not the best plan


def aligned(cells):
    return "  ".join(f"{cell:>{width}}" for cell, width in zip(cells, COLUMNS.values(), strict=True))


def told(episode):
    if episode.status != "done":
        return f"{episode.status}: {episode.reason}"
    seen, name = episode.known, nearest(episode.known["material"])
    material = name if np.allclose(MATERIALS[name].features, seen["material"]) else f"~{name}"
    poured, target = (seen["poured"] + seen["poured_change"]) / SPHERE_AMOUNT, np.ceil(seen["target"] / SPHERE_AMOUNT)
    spilled = (seen["spilled"] + seen["spilled_change"]) / SPILL_AMOUNT
    amounts = f"{poured:.0f}/{target:.0f}", f"{spilled:.0f}"
    return aligned([material, f"{seen['mouth']:.2f}", *amounts, f"{episode.total:z.2f}"])


def nearest(features, materials=MATERIALS):
    return min(materials, key=lambda one: np.abs(MATERIALS[one].features - features).sum())


def attempts(loop, number):
    """The (skill, why it was not the best plan) of each attempt of an episode."""
    plans = list(loop.store.plans(number).values())[1:]  # the first is made again at the receiver
    return [(plan["selections"]["skill"], plan["explored"].split(":")[0]) for plan in plans]


def learn(loop, progress):
    task = progress.add_task(recent(loop), total=loop.episodes, completed=loop.done)
    if loop.done < loop.episodes:
        progress.console.print(f"no.  {aligned(COLUMNS)}  skills")
        progress.console.print("     amounts in spheres; * drawn to learn more, ? random: seen too little to plan")
    for episode in loop:
        skills = ", ".join(skill + WHY[why] for skill, why in attempts(loop, episode.number))
        progress.console.print(f"{episode.number + 1:3}  {told(episode)}  {skills}")
        progress.update(task, advance=1, description=recent(loop))


def recent(loop):
    returns = [episode.total for episode in loop.store.episodes(status="done")[-10:]]
    return f"learned; median of the last 10 returns {np.median(returns):z.2f}" if returns else "preparing the planner"


# %%
# The returns of the attempts tell how it got there. Most of what is lost is lost while it explores.


def draw_curve(loop, path):
    series = {}
    for episode in loop.store.episodes(status="done"):
        for (skill, why), gained in zip(attempts(loop, episode.number), episode.info["returns"], strict=True):
            series.setdefault((skill, "explored" if why else "planned"), []).append((episode.number + 1, gained))
    figure, axes = plt.subplots(figsize=(8, 3.5), layout="constrained")
    for (skill, how), points in sorted(series.items()):
        marker, colour = {"tip": ("o", "tab:blue"), "shake": ("^", "tab:orange")}[skill]
        face = colour if how == "planned" else "none"
        axes.scatter(*np.transpose(points), marker=marker, c=face, edgecolors=colour, label=f"{skill}, {how}")
    axes.set(yscale="symlog", xlabel="episode", ylabel="return of each attempt", title="Learning to pour")
    axes.xaxis.get_major_locator().set_params(integer=True)
    figure.legend(loc="outside right upper", fontsize="small")
    figure.savefig(path, dpi=150)


# %%
# What it has learned
# -------------------
# It pours in situations that it has never met, without exploring or learning. The film shows the first tip and the
# first shake among them.


def prove(loop, world, progress):
    progress.console.print(f"\nSituations it has never met\n{aligned(COLUMNS)}  promised  skills")
    progress.console.print("promised: the return that the plan of the last attempt expects of it")
    first = {}
    for seed in progress.track(range(10**6, 10**6 + PROOFS), description="pouring where it has never been"):
        episode = loop.perform(world, seed)
        promised = "random" if episode.explored else f"{episode.value:z.2f}"
        skills = ", ".join(attempt.selections["skill"] for attempt in world.attempts)
        progress.console.print(f"{told(episode)}  {promised:>8}  {skills}")
        for attempt in world.attempts if episode.status == "done" else ():
            first.setdefault(attempt.selections["skill"], attempt)
    return list(first.values())


# %%
# The skill map shows what it would do elsewhere: which skill, and the return that it expects; a cross where it has seen
# too little to plan. Dots below are the episodes that it has learned from.


def draw_map(loop, setup, target, path):
    materials, mouth = np.atleast_1d(setup["material"]).tolist(), setup["mouth"]
    situations = list(itertools.product(range(len(materials)), np.unique(np.linspace(np.min(mouth), np.max(mouth), 8))))
    if len(situations) == 1:
        return
    seen = [PouringWorld(materials[j], float(at), target, receiver_x=0.8).reset(0) for j, at in situations]
    states = [{label: one[label] for label in loop.graph.states() if label in one} for one in seen]
    table = sg.solve_many(loop.objectives["start"], states, OPTIMIZER, processes=1)
    figure = sg.plot_map(table, "mouth", [j for j, _ in situations])
    figure.set_size_inches(8, 1.8 + 0.5 * len(materials))
    axes = figure.axes[0]
    met = [visit.observed for visit in loop.store.visits(node="start")]
    rows = [materials.index(nearest(one["material"], materials)) - 0.3 for one in met]
    axes.scatter([one["mouth"] for one in met], rows, s=4, color="black")
    axes.set(yticks=range(len(materials)), yticklabels=materials, ylim=(-0.5, len(materials) - 0.5))
    axes.set_title(f"Planned for an amount of {target:g}; dots: episodes", fontsize="medium")
    figure.savefig(path, dpi=150)


# %%
# All of it
# ---------
# A run's options are kept in its folder, so that ``--resume`` needs no others.

DEFAULTS = {"condition": "general", "episodes": 80, "seed": 0}
OPTIONS = "options.json"
Setup = enum.StrEnum("Setup", list(SETUPS))
Material = enum.StrEnum("Material", list(MATERIALS))


def pour(folder, options):
    given = {name: options[name] for name in ("material", "mouth", "target") if name in options}
    setup = SETUPS[options["condition"]] | given
    if setup.get("blend") and "material" in given:
        raise sg.InputError(f"--material {given['material']}: --condition varied blends all; leave one of them out")
    try:
        world = RecordedWorld(PouringWorld(**setup))
    except ValueError as error:
        raise sg.InputError(f"--{error}") from None
    keep(folder, options)
    console = Console(highlight=False, markup=False, soft_wrap=True)
    console.print(f"All is kept in {folder}; {resuming(folder)} goes on with it")
    name = " ".join([options["condition"], *(f"{name}={value}" for name, value in given.items())])
    curve, skill_map, film = pictures = [folder / one for one in ("learning_curve.png", "skill_map.png", "pouring.mp4")]
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    try:
        with Progress(*columns, console=console) as progress, loop_in(world, name, options, folder) as loop:
            for path in pictures:  # of a run that is gone on with
                path.unlink(missing_ok=True)
            learn(loop, progress)
            draw_curve(loop, curve)
            shown = prove(loop, world, progress)
            draw_map(loop, setup, options.get("target", 0.3), skill_map)
            if shown:
                films = [world.film(attempt) for attempt in progress.track(shown, description="filming")]
                write_video(film, list(itertools.chain(*films)), fps=8)
    except KeyboardInterrupt:
        console.print(f"Stopped after episode {done_in(folder)}; {resuming(folder)} goes on with it")
        raise typer.Exit(130) from None
    there = ", ".join(path.name for path in pictures if path.exists())
    console.print(f"\n{there}, episodes and networks are in {folder}")


def kept(folder):
    path = folder / OPTIONS
    if not path.exists():
        return {}
    try:
        return DEFAULTS | json.loads(path.read_text())
    except (ValueError, TypeError):
        raise sg.InputError(f"{path} holds no options of a run; give another --output, or take it away") from None


def keep(folder, options):
    new = folder / f"{OPTIONS}.new"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        new.write_text(json.dumps(options))
        new.replace(folder / OPTIONS)
    except OSError as error:
        raise sg.InputError(f"--output {folder}: {error.strerror}; give another folder") from None


def done_in(folder):
    try:
        with sg.learned.EpisodeStore(folder / "episodes.sqlite", read_only=True) as store:
            return len(store) - len(store.episodes(status="running"))
    except sg.StorageError:  # stopped before there was one
        return 0


def resumed(folder, asked):
    options = kept(folder)
    if not options:
        raise sg.InputError(f"--resume: there is no run in {folder}; name the folder of one with --output")
    for name, value in asked.items():
        has = options.get(name, "none")
        if value < has if name == "episodes" else value != has:
            raise sg.InputError(f"--{name} {value}: the run in {folder} has {has}; leave --{name} or --resume out")
    return options | asked


def resuming(folder):
    words = shlex.join(["--resume", "--output", str(folder)])
    if "MAKELEVEL" in os.environ:
        return f'make pour ARGS="{words}"'
    path = shlex.quote(os.environ.get("PYTHONPATH", "."))
    return f"PYTHONPATH={path} {shlex.join([sys.executable, sys.argv[0]])} {words}"


def unused(folder):
    beside = (folder.parent / f"{folder.name}-{number}" for number in itertools.count(2))
    for one in itertools.chain([folder], beside):
        options = kept(one)
        if not options and not (one / "episodes.sqlite").exists():
            break
        if options:
            print(f"{one} is taken ({done_in(one)} of {options['episodes']} episodes); {resuming(one)} goes on with it")
    return one


def main(
    condition: Annotated[Setup | None, Option(help="What is drawn, see above.", show_default="general")] = None,
    material: Annotated[Material | None, Option(help="Pour this only; not with varied, which blends.")] = None,
    mouth: Annotated[float | None, Option(help="Width of the mouth.", min=0.11, max=0.25)] = None,
    target: Annotated[float | None, Option(help="Amount to pour, 0.0055 a sphere.", min=0, max=0.54)] = None,
    episodes: Annotated[int | None, Option(help="To learn from; may grow later.", min=1, show_default="80")] = None,
    seed: Annotated[int | None, Option(help="Of all that is random.", min=0, show_default="0")] = None,
    output: Annotated[Path, Option(help="Folder of all that is kept; numbered if taken.")] = Path("output/pour"),
    resume: Annotated[bool, Option("--resume", help="Go on with the run in that folder and its options.")] = False,
):
    """Learn to pour from scratch, then pour in situations never met.

    Every episode draws a situation: "general" any material and mouth; "setup1"
    is bnc through 0.23, "setup2" vsc through 0.13; "varied" also blends
    materials, and draws the amount and the receiver's size.
    """
    given = {"material": material, "mouth": mouth, "target": target}
    asked = {"condition": condition, **given, "episodes": episodes, "seed": seed}
    asked = {name: value for name, value in asked.items() if value is not None}
    try:
        folder, options = (output, resumed(output, asked)) if resume else (unused(output), DEFAULTS | asked)
        pour(folder, options)
    except sg.SymgraphError as error:
        typer.echo(error, err=True)
        raise typer.Exit(2) from None


if __name__ == "__main__":
    typer.run(main)
