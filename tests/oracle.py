"""The expected reward of a graph, by plain recursion over its paths: an oracle for the library's results.

Nothing here is shared with symgraph: tasks are the dataclasses below, models are numpy functions that hand
over their own derivatives, and nothing is unrolled, differentiated or compiled.  The rules it follows:

* every slot is a Gaussian, independent of every other slot; actions and selections are exact;
* a model y = f(x) sees the covariance S of what it reads, block-diagonal by slot, and gives
      "mean"          f(m),                    0
      "linear"        f(m),                    J S J'
      "second-order"  f(m) + 1/2 tr(H_i S),    J S J'
  and each slot it writes keeps its own block of the output covariance, plus the model's process noise;
* edges and probabilities are "linear" unless they say otherwise, rewards "second-order";
* the value at a node is the sum over its groups of the sum over the group's branches of P_b J_b; of a
  probability and of a reward only the mean counts, of a choose only the chosen branch;
* a branch that would enter a node for the (max_visits + 1)-th time on one path is cut and worth `cut_value`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

# What the models of the three kinds of place do when they do not say how they propagate.
EDGE_RULE, PROBABILITY_RULE, REWARD_RULE = "linear", "linear", "second-order"


@dataclass(frozen=True)
class Slot:
    """A labelled quantity; a selection is read as a one-hot vector, so its size is its number of choices."""

    kind: str  # "action", "state" or "selection"
    size: int = 1
    low: np.ndarray | None = None  # (size,), actions only
    high: np.ndarray | None = None  # (size,), actions only
    choices: tuple[str, ...] = ()  # selections only


class Function(Protocol):
    """A numpy function of stacked vectors: x in the order of `reads`, y in the order of `writes`."""

    @property
    def reads(self) -> Mapping[str, int]: ...  # the function's own name -> size

    @property
    def writes(self) -> Mapping[str, int]: ...

    def derivatives(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """y: (m,), its Jacobian (m, n) and its Hessians (m, n, n), all exact."""


@dataclass(frozen=True)
class Model:
    """A function set to work in a graph."""

    function: Function
    rename: Mapping[str, str] = field(default_factory=dict)  # own name -> label
    propagation: str | None = None  # None: the rule of the place where the model stands
    noise: Mapping[str, np.ndarray] = field(default_factory=dict)  # label -> covariance, added when written

    def label(self, name: str) -> str:
        return self.rename.get(name, name)


@dataclass(frozen=True)
class Branch:
    target: str
    model: Model | None = None  # None: the identity


@dataclass(frozen=True)
class Edge:
    branch: Branch


@dataclass(frozen=True)
class Choose:
    selection: str
    branches: Mapping[str, Branch]  # choice -> branch


@dataclass(frozen=True)
class Chance:
    branches: Mapping[str, Branch]
    probability: Mapping[str, float] | Model  # the model writes one number per branch


@dataclass(frozen=True)
class Reward:
    model: Model


Group = Edge | Choose | Chance | Reward


@dataclass(frozen=True)
class Task:
    slots: Mapping[str, Slot]
    groups: Mapping[str, tuple[Group, ...]]  # node -> what leaves it; a node without groups ends its path
    start: str
    max_visits: int = 3
    cut_value: float = 0.0


Gaussian = tuple[np.ndarray, np.ndarray]  # mean (n,), covariance (n, n)
Beliefs = Mapping[str, Gaussian]


def value(task: Task, state: Mapping, actions: Mapping, selections: Mapping[str, str]) -> float:
    """Expected sum of rewards from the start node.

    Args:
        task: what to evaluate.
        state: label -> number, array (n,) or (mean, covariance).
        actions: label -> number or array (n,).
        selections: label -> choice.
    """
    beliefs: dict[str, Gaussian] = {}
    for label, given in state.items():
        size = task.slots[label].size
        mean, covariance = given if isinstance(given, tuple) else (given, np.zeros((size, size)))
        beliefs[label] = (_floats(mean, size), _floats(covariance, (size, size)))
    for label, given in actions.items():
        beliefs[label] = _exact(_floats(given, task.slots[label].size))
    for label, choice in selections.items():
        beliefs[label] = _exact(np.array([float(choice == name) for name in task.slots[label].choices]))
    return _value_at(task, task.start, beliefs, selections, {})


def branches_of(group: Group) -> tuple[Branch, ...]:
    match group:
        case Edge(branch):
            return (branch,)
        case Choose(branches=branches) | Chance(branches=branches):
            return tuple(branches.values())
        case Reward():
            return ()


def propagate(model: Model, beliefs: Beliefs, default: str) -> dict[str, Gaussian]:
    """What the model writes, by label, before it is put into the beliefs."""
    names = list(model.function.reads)
    labels = [model.label(name) for name in names]
    x = np.concatenate([beliefs[label][0] for label in labels])
    s = np.vstack([np.hstack([_covariance(row, column, beliefs) for column in labels]) for row in labels])
    y, jacobian, hessians = model.function.derivatives(x)
    rule = model.propagation or default
    if rule == "mean":
        covariance = np.zeros((len(y), len(y)))
    elif rule in ("linear", "second-order"):
        covariance = jacobian @ s @ jacobian.T
    else:
        raise ValueError(f"the oracle knows no propagation {rule!r}")
    if rule == "second-order":
        y = y + 0.5 * np.einsum("ijk,kj->i", hessians, s)

    written: dict[str, Gaussian] = {}
    first = 0
    for name, size in model.function.writes.items():
        block = slice(first, first + size)
        label = model.label(name)
        written[label] = (y[block], covariance[block, block] + model.noise.get(label, 0.0))
        first += size
    return written


def _value_at(
    task: Task, node: str, beliefs: Beliefs, selections: Mapping[str, str], visits: Mapping[str, int]
) -> float:
    visits = {**visits, node: visits.get(node, 0) + 1}

    def worth(branch: Branch) -> float:
        if visits.get(branch.target, 0) >= task.max_visits:
            return task.cut_value
        there = beliefs
        if branch.model is not None:
            there = {**beliefs, **propagate(branch.model, beliefs, EDGE_RULE)}
        return _value_at(task, branch.target, there, selections, visits)

    total = 0.0
    for group in task.groups.get(node, ()):
        match group:
            case Edge(branch):
                total += worth(branch)
            case Choose(selection, branches):
                total += worth(branches[selections[selection]])
            case Chance(branches, probability):
                if isinstance(probability, Model):
                    written = propagate(probability, beliefs, PROBABILITY_RULE)
                    probability = {name: written[name][0].item() for name in branches}
                total += sum(probability[name] * worth(branch) for name, branch in branches.items())
            case Reward(model):
                ((mean, _),) = propagate(model, beliefs, REWARD_RULE).values()
                total += mean.item()
    return total


def _covariance(row: str, column: str, beliefs: Beliefs) -> np.ndarray:
    if row == column:  # also where a model knows one slot by two names
        return beliefs[row][1]
    return np.zeros((len(beliefs[row][0]), len(beliefs[column][0])))


def _floats(given: object, shape: int | tuple[int, int]) -> np.ndarray:
    return np.reshape(np.asarray(given, dtype=float), shape)


def _exact(mean: np.ndarray) -> Gaussian:
    return mean, np.zeros((len(mean), len(mean)))
