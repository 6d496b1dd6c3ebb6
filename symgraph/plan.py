"""Plan: the best actions and selections found, what they lead to, and how they were found."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from symgraph.drawing import Diagram
from symgraph.errors import GraphError
from symgraph.outcomes import NodeOutcome, NodeOutcomes
from symgraph.slots import Gaussian
from symgraph.tree import MOST_SHOWN

SHOWN_NODES = 12  # nodes that a printed plan lists


@dataclass(frozen=True, eq=False)
class PlanRun:
    """What became of one start point.

    Attributes:
        selections: {label: choice}, which a run keeps.
        start: {label: value} of the actions at the start [unit].
        actions: {label: value} at the end [unit].
        value: expected reward at the end; -inf where nothing finite was met.
        outcome: "converged", "iteration limit", "oscillation", "stalled" (no step gains any more), "not finite",
            "time limit", "worker died", or "drawn" (at random, by a plan that explores).
        gradients: gradient evaluations.
        history: the values on the way.
    """

    selections: dict[str, str]
    start: dict[str, Any]
    actions: dict[str, Any]
    value: float
    outcome: str
    gradients: int
    history: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Plan:
    """The best actions and selections that were found.

    Attributes:
        actions: {label: float or (size,)} [unit].
        selections: {label: choice}.
        value: the expected sum of rewards, less what the objective's risk takes away.
        violation: the largest breach of a requirement, in the unit of its model; 0 if all are met.
        status: what is known: "converged", "best of N starts", "time limit: …", "requirements are missed: …",
            "exploring: model 'm' has 2 of 3 samples", …
        notes: what makes the value less than it seems, e.g. paths that are cut.
        nodes: the outcome at every tree node, in tree order.
        runs: a row per start point.
        optimizer: what found it.
        seed: of all that was random.
        seconds: wall time, building and compiling at first use included [s].
        units: {label: unit} of the actions and states that have one.
    """

    actions: dict[str, Any]
    selections: dict[str, str]
    value: float
    violation: float
    status: str
    notes: tuple[str, ...]
    nodes: Sequence[NodeOutcome]
    runs: Sequence[PlanRun]
    optimizer: str
    seed: int
    seconds: float
    units: Mapping[str, str]

    @property
    def deviation(self) -> float:
        """The standard deviation of the sum of rewards, with rewards on the way independent of each other."""
        return self.nodes[0].deviation

    def __str__(self) -> str:
        lines = [f"{label} = {choice}" for label, choice in self.selections.items()]
        lines += [f"{label} = {self._quantity(label, value)}" for label, value in self.actions.items()]
        gradients = sum(run.gradients for run in self.runs)
        lines.append(f"value {self.value + 0.0:.6g}: {self.status}")
        lines.append(f"  {gradients} gradients in {1e3 * self.seconds:.1f} ms by {self.optimizer}, seed {self.seed}")
        lines += [f"  note: {note}" for note in self.notes]
        if self.nodes and self.deviation:
            lines.append(f"  expected return {self.nodes[0].value:.6g}, its standard deviation {self.deviation:.4g}")
        reached = [node for node in self.nodes if node.probability]
        for node in reached[:SHOWN_NODES]:
            reward = f", reward {node.reward:.4g}" if node.reward else ""
            lines.append(f"  {node.path}: probability {node.probability:.3g}{reward}{' (cut)' if node.cut else ''}")
        if len(reached) > SHOWN_NODES:
            lines.append(f"  … and {len(reached) - SHOWN_NODES} more nodes")
        return "\n".join(lines)

    def _quantity(self, label: str, value: Any) -> str:
        numbers = ", ".join(f"{x:.5g}" for x in np.ravel(value))
        return " ".join(
            part for part in (f"[{numbers}]" if np.ndim(value) else numbers, self.units.get(label, "")) if part
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as dictionaries, lists, strings and numbers, fit for JSON."""
        return {
            "actions": _plain(self.actions),
            "selections": dict(self.selections),
            "value": self.value,
            "violation": self.violation,
            "deviation": self.deviation,
            "status": self.status,
            "notes": list(self.notes),
            "nodes": [
                {
                    "path": node.path,
                    "node": node.node,
                    "probability": node.probability,
                    "reward": node.reward,
                    "value": node.value,
                    "deviation": node.deviation,
                    "cut": node.cut,
                    "states": {label: _plain(gaussian) for label, gaussian in node.states.items()},
                }
                for node in self.nodes
            ],
            "runs": [
                {
                    "selections": dict(run.selections),
                    "start": _plain(run.start),
                    "actions": _plain(run.actions),
                    "value": run.value,
                    "outcome": run.outcome,
                    "gradients": run.gradients,
                    "history": list(run.history),
                }
                for run in self.runs
            ],
            "optimizer": self.optimizer,
            "seed": self.seed,
            "seconds": self.seconds,
            "units": dict(self.units),
        }

    def to_json(self, indent: int | None = 2) -> str:
        """Return the plan as JSON; numbers that are not finite become null, since JSON has none."""
        return json.dumps(_finite(self.to_dict()), indent=indent)

    def diagram(self) -> Diagram:
        """Return the picture of the tree with probabilities and expected values; unselected branches are pale.

        Raises:
            GraphError: the plan comes from another process, or from C, and has no tree with it.
        """
        if not isinstance(self.nodes, NodeOutcomes):
            raise GraphError("this plan came without its tree, from another process or from C; draw one of solve's own")
        notes = {}
        for i, node in enumerate(self.nodes):
            if node.probability:
                notes[i] = (f"p = {node.probability:.3g}", f"J = {node.value:.4g}")
        reach = dict(enumerate(self.nodes.probabilities.tolist()))
        shares = dict(enumerate(self.nodes.shares.tolist()))
        return self.nodes.tree.diagram(notes, reach, shares)

    def _repr_svg_(self) -> str | None:
        drawn = isinstance(self.nodes, NodeOutcomes) and len(self.nodes) <= MOST_SHOWN
        return self.diagram().svg() if drawn else None


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {label: _plain(item) for label, item in value.items()}
    if isinstance(value, Gaussian):
        return {"mean": _plain(value.mean), "covariance": _plain(value.covariance)}
    return value.tolist() if isinstance(value, np.ndarray) else value


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {label: _finite(item) for label, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
