"""What has been made of a module: a function, and where its weights come from."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from symgraph.learned.torch_modules.tape import Tape


@dataclass(frozen=True)
class Weight:
    """An input of the lowered function: what to read it from, and its shape in CasADi.

    Attributes:
        sources: names of the parameters and buffers that it follows from.
        step: of the tape.
        shape: (rows, columns).
    """

    sources: tuple[str, ...]
    step: int
    shape: tuple[int, int]


@dataclass(frozen=True)
class Lowered:
    """A module as a function.

    Attributes:
        function: inputs, each (n, 1), then weights → outputs, each (m, 1); in torch's order.
        shapes: of the outputs.
        tape: what torch computes from weights.
        weights: the function's inputs after those of the module.
        kept: names of buffers that became constants.
        names: of the outputs, where the module returns a dict of tensors.
        coarsest: the rounding of the coarsest precision that the module asks for inside; 0 for double throughout.
    """

    function: ca.Function
    shapes: tuple[tuple[int, ...], ...]
    tape: Tape
    weights: tuple[Weight, ...]
    kept: tuple[str, ...]
    names: tuple[str, ...]
    coarsest: float
