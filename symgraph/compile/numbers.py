"""Programs in numbers, operation by operation: slow, but it needs no compiler."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from symgraph.compile.program import STEP, Operation, Program, Value
from symgraph.slots import Array


def run(program: Program, inputs: Sequence[Array]) -> list[Array]:
    """Return the outputs of a program."""
    numbers: dict[Value, Array] = dict(zip(program.inputs, inputs, strict=True))
    for operation in program.operations:
        args = [numbers[arg] for arg in operation.args]
        numbers.update(zip(operation.outputs, _carried_out(operation, args), strict=True))
    return [numbers[value] for value in program.outputs]


def _carried_out(operation: Operation, args: list[Array]) -> list[Array]:
    detail: Any = operation.detail
    sizes = [output.size for output in operation.outputs]
    match operation.code:
        case "constant":
            return [detail]
        case "held" | "spread":
            return args[:1]
        case "gather":
            return [np.concatenate([*args, np.zeros(1)])[detail]]  # -1 stands for zero
        case "transpose":
            rows, columns = detail
            return [args[0].reshape(columns, rows).ravel(order="F")]
        case "product" | "weighted product":
            return [_product(args[0], args[1], *detail)]
        case "accumulate":
            targets, *indices = detail
            terms = np.prod([arg[index] for arg, index in zip(args, indices, strict=True)], axis=0)
            return [np.asarray(np.bincount(targets, terms, sizes[0]), dtype=float)]
        case "call":
            return run(detail, args)
        case "repeat":
            program, times = detail
            parts = [np.split(arg, times) for arg in args]
            made = [run(program, [part[i] for part in parts]) for i in range(times)]
            return [np.concatenate(column) for column in zip(*made, strict=True)]
        case int(code):
            if code == STEP:
                return [np.where(args[0] > args[1], 1.0, np.where(args[0] < args[1], 0.0, 0.5))]
            columns = [ca.DM(arg) for arg in args]
            result = ca.DM.unary(code, *columns) if len(args) == 1 else ca.DM.binary(code, *columns)
            return [np.broadcast_to(np.asarray(ca.densify(result)).ravel(), sizes[0])]
    raise AssertionError(f"{operation.code!r} is nothing that follows from parameters alone")


def _product(
    left: Array, right: Array, m: int, k: int, n: int, transposed: bool = False, squared: bool = False
) -> Array:
    matrix = left.reshape(m, k) if transposed else left.reshape(k, m).T
    return np.asarray((matrix**2 if squared else matrix) @ right.reshape(n, k).T).ravel(order="F")
