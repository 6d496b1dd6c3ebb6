"""The structures of a generated header as ctypes has them."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np

from symgraph.codegen.description import Description
from symgraph.slots import Array


class Structures:
    """One class for each structure of a planner's header.

    Args:
        description: of the planner.
    """

    def __init__(self, description: Description) -> None:
        d = description
        count = sum(slot.size + slot.uncertain * slot.size**2 for slot in d.given)
        self.state = ctypes.c_double * max(count, 1)
        self.actions = ctypes.c_double * max(sum(slot.size for slot in d.actions), 1)
        self.selections = ctypes.c_int * max(len(d.selections), 1)
        long, double, whole, pointer = ctypes.c_long, ctypes.c_double, ctypes.c_int, ctypes.c_void_p
        numbers = ("value", "violation", "missed", "seconds")
        counts = ("worst", "found", "starts", "tried", "runs")
        points = [("actions", self.actions), ("selections", self.selections)]
        self.point = _structure("Point", points)
        self.plan = _structure(
            "Plan",
            [
                *points,
                *((name, double) for name in numbers),
                *((name, whole) for name in counts),
                ("evaluations", long),
                ("gradients", long),
            ],
        )
        self.run = _structure(
            "Run",
            [
                ("start", self.actions),
                *points,
                ("value", double),
                ("missed", double),
                ("outcome", whole),
                ("gradients", long),
            ],
        )
        self.options = _structure(
            "Options",
            [
                ("seed", ctypes.c_ulonglong),
                ("evaluations", long),
                ("seconds", double),
                ("clock", pointer),
                ("progress", pointer),
                ("user", pointer),
                ("starts", pointer),
                ("start_count", whole),
                ("held", pointer),
                ("runs", pointer),
                ("run_room", whole),
            ],
        )
        nodes = double * len(d.nodes)
        columns = ("probability", "reward", "value", "deviation")
        self.outcomes = _structure(
            "Outcomes", [*((name, nodes) for name in columns), ("moments", double * max(d.moments, 1))]
        )


def _structure(name: str, fields: list[tuple[str, Any]]) -> Any:
    return type(name, (ctypes.Structure,), {"_fields_": fields})


def array_of(numbers: Any) -> Array:
    """Return a copy of a ctypes array."""
    return np.array(numbers, dtype=float)
