"""Programs in two: what the first outputs follow from, and the rest, which goes on from there."""

from __future__ import annotations

import numpy as np

from symgraph.compile.differentiate import copied
from symgraph.compile.hoist import is_free, used
from symgraph.compile.program import Kind, Operation, Program, Value


def in_halves(program: Program, count: int) -> tuple[Program, Program]:
    """Cut a program in two.

    Args:
        program: what to cut.
        count: of outputs that the first half returns.

    Returns:
        inputs → the first outputs and a tape, all that the second half needs of the first one; inputs and tape → the
        other outputs.
    """
    first = set(used(program.operations, program.outputs[:count]))
    rest = [o for o in used(program.operations, program.outputs[count:]) if o not in first]
    tape = list(
        dict.fromkeys(
            value
            for values in (*(operation.args for operation in rest), program.outputs[count:])
            for value in values
            if value.maker in first and not is_free(value)
        )
    )
    forward = Program(program.name, [Value(x.size, x.kind) for x in program.inputs])
    new = dict(zip(program.inputs, forward.inputs, strict=True))
    for operation in program.operations:
        if operation in first:
            copied(forward, operation, new)
    forward.outputs = (*(new[value] for value in program.outputs[:count]), forward.concatenate([new[v] for v in tape]))
    forward.operations = used(forward.operations, forward.outputs)
    return forward, _second(program, count, tape, [o for o in program.operations if o in first], rest)


def _second(program: Program, count: int, tape: list[Value], first: list[Operation], rest: list[Operation]) -> Program:
    kept = Value(sum(value.size for value in tape), Kind.LANE)
    backward = Program(f"{program.name}_reverse", [*(Value(x.size, x.kind) for x in program.inputs), kept])
    new = dict(zip(program.inputs, backward.inputs, strict=False))
    begin = 0
    for value in tape:
        new[value] = backward.gather([kept], begin + np.arange(value.size))
        begin += value.size
    for operation in first:
        if is_free(operation.outputs[0]) and all(arg in new for arg in operation.args):
            copied(backward, operation, new)
    for operation in rest:
        copied(backward, operation, new)
    backward.outputs = tuple(new[value] for value in program.outputs[count:])
    backward.operations = used(backward.operations, backward.outputs)
    return backward
