"""Exploration: what to do while a model knows too little to be planned with."""

from __future__ import annotations

import zlib
from collections.abc import Mapping

import numpy as np

from symgraph.binding import BoundModel
from symgraph.optimizers.problem import Problem, Run, Search
from symgraph.outcomes import NodeOutcomes
from symgraph.tree import Tree

MOST_DRAWS = 100  # until one has a finite value
SELDOM = 0.01  # probability below which samples would take too many tries

Decisions = Mapping[str, int]  # selection → which of its choices


def lacking_models(tree: Tree, allowed: Mapping[str, tuple[int, ...]]) -> dict[BoundModel, Decisions]:
    """Return the models that allowed choices can lead to and that lack samples, each with the choices on a way there.

    Args:
        tree: the unrolled graph.
        allowed: {selection: the choices that are not ruled out}.
    """
    if not any(model.lacking for model in tree.models):
        return {}
    selections = tree.graph.selections()
    found: dict[BoundModel, Decisions] = {}
    ways: dict[int, Decisions] = {0: {}}

    def note(model: BoundModel | None, way: Decisions) -> None:
        if model is not None and model.lacking is not None:
            found.setdefault(model, way)

    for node in tree.nodes:
        if node.index not in ways:
            continue
        here = ways[node.index]
        for requirement in node.requirements:
            note(requirement.model, here)
        for group in node.groups:
            probability = group.group.probability
            note(probability if isinstance(probability, BoundModel) else None, here)
            for branch in group.branches:
                way = here
                if group.group.kind == "choose":
                    selection = str(group.group.selection)
                    choice = selections[selection].choices.index(branch.branch.label)
                    if choice not in allowed[selection]:
                        continue
                    way = {**here, selection: choice}
                note(branch.branch.model, way)
                if branch.child is not None:
                    ways[branch.child] = way
    return found


def explore(problem: Problem, selections: list[str], lacking: Mapping[BoundModel, Decisions], seed: int) -> Search:
    """Draw actions and choices at random, with the choices that lead to a model that lacks samples.

    A choice of the guesses is kept where it leads to one. The value, which such a model has a part in, need not be
    finite: otherwise the model might never get a sample. Of some draws, the one that misses requirements least is
    taken; those that such a model has a part in are only guessed at.

    Source: Yamaguchi & Atkeson, Humanoids 2016, section VII-A: if no model is available, the actions are random.
    """
    wanted = [dict(zip(selections, choices.tolist(), strict=True)) for _, choices in problem.guesses]
    ways = [
        way
        for way in lacking.values()
        if any(all(guess[label] in (-1, choice) for label, choice in way.items()) for guess in wanted)
    ] or list(lacking.values())
    needs = dict.fromkeys(f"model {model.name!r} has {model.lacking}" for model in lacking)
    status = f"exploring: {', '.join(needs)}"
    # Another draw with every sample that has come in, so that a loop that leaves the seed alone tries various actions.
    rng = np.random.default_rng([seed, zlib.crc32(status.encode())])
    best: Run | None = None
    for _ in range(MOST_DRAWS):
        choices = problem.draw_choices(rng, 1, evenly=False)
        for label, choice in ways[rng.integers(len(ways))].items():
            choices[0, selections.index(label)] = choice
        points = problem.draw_points(rng, 1, "uniform")
        value = float(problem.values(points, choices)[0])
        run = problem.judge(Run(points[0], points[0], choices[0], value, "drawn", np.array([value])))
        if best is None or _rank(run) > _rank(best):
            best = run
        if np.isfinite(run.value) and not run.missed:
            break
    best = best or run
    best.value = best.value if np.isfinite(best.value) else np.nan
    return Search([best], status)


def _rank(run: Run) -> tuple[bool, float]:
    return bool(np.isfinite(run.value)), -run.missed


def met(nodes: NodeOutcomes, lacking: Mapping[BoundModel, Decisions]) -> bool:
    """Whether a plan meets one of the models with a probability that is worth trying."""
    for node in nodes.tree.nodes:
        here = nodes.probabilities[node.index]
        if here >= SELDOM and any(requirement.model in lacking for requirement in node.requirements):
            return True
        for group in node.groups:
            if group.group.probability in lacking and here >= SELDOM:
                return True
            for branch in group.branches:
                reach = here if branch.child is None else nodes.probabilities[branch.child]
                if branch.branch.model in lacking and not reach < SELDOM:
                    return True
    return False
