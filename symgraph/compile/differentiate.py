"""Gradients of programs by one reverse sweep, whose operations join those of the forward sweep.

What the forward sweep computed is used, not computed again: equal operations are one. A program that others call is
cut in two for that, a forward one that also returns what the reverse one will need. The slopes of elementwise
operations are CasADi's own.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from symgraph.compile.program import CALLS, STEP, Indices, Kind, Operation, Program, Value, constant_of
from symgraph.compile.reading import write_scalars


class Differentiator:
    """Differentiates programs; what stands for those that are called is kept and used again."""

    def __init__(self) -> None:
        self._pairs: dict[Program, tuple[Program, Program]] = {}

    def with_gradient(self, program: Program, by: int) -> Program:
        """Return the program with one more output: the gradient of the first one, a number, by an input."""
        target = Program(program.name, [Value(x.size, x.kind) for x in program.inputs])
        sweep = _Sweep(self, target, target.inputs)
        results = sweep.forward(program)
        sweep.reverse([(results[0], target.constant(1.0))])
        target.outputs = (*results, sweep.adjoint(target.inputs[by]))
        return target

    def with_weighted_gradient(self, program: Program, by: int) -> Program:
        """Return the program with one more input, a weight for each number of its second output, and one more output.

        This is the gradient, by an input, of the first output, a number, plus the weighted sum of the second one.
        Numbers of weight 0 have no part in it, even if their slopes are not finite.
        """
        inputs = [Value(x.size, x.kind) for x in program.inputs]
        weights = Value(program.outputs[1].size, Kind.BLOCK)
        target = Program(program.name, [*inputs, weights])
        sweep = _Sweep(self, target, inputs)
        results = sweep.forward(program)
        sweep.guard(results[1:])
        sweep.reverse([(results[0], target.constant(1.0)), (results[1], weights)])
        target.outputs = (*results, sweep.adjoint(inputs[by]))
        return target

    def pair(self, program: Program) -> tuple[Program, Program]:
        """Cut a program in two for its derivative.

        Returns:
            inputs → outputs and the tape, all numbers that the second one needs; inputs, tape and the outputs' adjoints
            → the adjoints of those inputs that follow from actions.
        """
        if program not in self._pairs:
            self._pairs[program] = self._cut(program)
        return self._pairs[program]

    def _cut(self, program: Program) -> tuple[Program, Program]:
        seeds = [Value(y.size, Kind.LANE) for y in program.outputs]
        inputs = [Value(x.size, x.kind) for x in program.inputs]
        joint = Program(program.name, [*inputs, *seeds])
        sweep = _Sweep(self, joint, inputs)
        results = sweep.forward(program)
        made = set(map(id, joint.operations))
        sweep.guard(results)  # wherever it is called the adjoints may be guarded
        sweep.reverse(zip(results, seeds, strict=True))
        adjoints = [sweep.adjoint(x) for x in inputs if x.kind == Kind.LANE]
        forward, tape = _forward_part(joint, inputs, results, adjoints, made)
        return forward, _reverse_part(joint, inputs, seeds, adjoints, tape)


def _forward_part(
    joint: Program, inputs: list[Value], results: list[Value], adjoints: list[Value], made: set[int]
) -> tuple[Program, list[Value]]:
    """Return the operations that a joint program begins with as a program, and what of theirs the others use."""
    reverse = _needed(adjoints, made)
    tape = dict.fromkeys(
        value
        for values in (adjoints, *(operation.args for operation in reverse))
        for value in values
        if value.kind == Kind.LANE and id(value.maker) in made
    )
    forward = Program(joint.name, [Value(x.size, x.kind) for x in inputs])
    new = dict(zip(inputs, forward.inputs, strict=True))
    for operation in joint.operations:
        if id(operation) in made:
            copied(forward, operation, new)
    forward.outputs = (*(new[value] for value in results), forward.concatenate([new[value] for value in tape]))
    return forward, list(tape)


def _reverse_part(
    joint: Program, inputs: list[Value], seeds: list[Value], adjoints: list[Value], tape: list[Value]
) -> Program:
    """Return the other operations as a program."""
    block = Value(sum(value.size for value in tape), Kind.LANE)
    given = [Value(x.size, x.kind) for x in (*inputs, *seeds)]
    reverse = Program(f"{joint.name}_reverse", [*given[: len(inputs)], block, *given[len(inputs) :]])
    new = dict(zip([*inputs, *seeds], given, strict=True))
    begin = 0
    for value in tape:
        new[value] = reverse.gather([block], begin + np.arange(value.size))
        begin += value.size
    for operation in _needed(adjoints, {id(value.maker) for value in tape}):
        copied(reverse, operation, new)
    reverse.outputs = tuple(new[value] for value in adjoints)
    return reverse


def _needed(values: Iterable[Value], known: set[int]) -> list[Operation]:
    """Return the operations that values follow from, in order, but those of lanes that are known."""
    found: dict[int, Operation] = {}
    waiting = [(value.maker, False) for value in values]
    while waiting:
        operation, complete = waiting.pop()
        if operation is None or id(operation) in found:
            continue
        if id(operation) in known and operation.outputs[0].kind == Kind.LANE:
            continue
        if complete:
            found[id(operation)] = operation
        else:
            waiting.append((operation, True))
            waiting += [(arg.maker, False) for arg in operation.args]
    return list(found.values())


def copied(target: Program, operation: Operation, new: dict[Value, Value]) -> None:
    """Write an operation into another program, where its arguments are `new`."""
    args = tuple(new[arg] for arg in operation.args)
    made: Sequence[Value]
    target.reversing = operation.reverse
    if operation.is_elementwise:
        made = [target.elementwise(int(operation.code), *args)]
    elif operation.code == "gather":
        made = [target.gather(args, operation.detail)]
    elif operation.code == "constant":
        made = [target.constant(operation.detail)]
    elif operation.code == "product":
        made = [target.product(args[0], args[1], operation.detail)]
    elif operation.code == "transpose":
        rows, columns = operation.detail
        made = [target.transpose(args[0], rows, columns)]
    elif operation.code == "accumulate":
        targets, *indices = operation.detail
        made = [target.accumulate(operation.outputs[0].size, targets, args, indices)]
    elif operation.code == "held":
        made = [target.held(args[0])]
    else:
        sizes = [output.size for output in operation.outputs]
        made = target.add(operation.code, args, operation.detail, sizes, operation.detail)
        for copy, output in zip(made, operation.outputs, strict=True):
            copy.kind = output.kind
    new.update(zip(operation.outputs, made, strict=True))


def called(operation: Operation) -> tuple[Program, ...]:
    """Return the programs that a call, a switch or a repetition calls."""
    if operation.code == "switch":
        return tuple(operation.detail)
    return (operation.detail if operation.code == "call" else operation.detail[0],)


def handed(operation: Operation) -> list[tuple[Value, ...]]:
    """Return the arguments that each of the called programs gets.

    A switch has its index first; then those for all programs; then, once or several times, one for each of them.
    """
    programs = called(operation)
    args = operation.args[operation.code == "switch" :]
    own = (len(args) - len(programs[0].inputs)) // (len(programs) - 1) if len(programs) > 1 else 0
    common = len(programs[0].inputs) - own
    return [(*args[:common], *args[common + i :: len(programs)]) for i in range(len(programs))]


def recalled(operation: Operation, programs: Sequence[Program]) -> Any:
    """Return the detail of an operation that calls other programs in the same way."""
    if operation.code == "switch":
        return tuple(programs)
    return programs[0] if operation.code == "call" else (programs[0], operation.detail[1])


class _Sweep:
    """A forward and a reverse sweep in one program."""

    def __init__(self, differentiator: Differentiator, target: Program, inputs: Sequence[Value]) -> None:
        self._differentiator = differentiator
        self._target = target
        self._inputs = inputs
        self._full: dict[Value, Value] = {}  # adjoints so far
        self._parts: dict[Value, list[tuple[Value, Indices]]] = {}  # and of some of a value's numbers
        self._taped: dict[Operation, tuple[Program, ...]] = {}  # calls and the programs that reverse them
        self._zero = target.constant(0.0)
        # Values whose adjoints a condition may set to zero: slopes there, which may not be finite, must not count.
        self._guarded: set[Value] = set()
        self._guards = False  # whether the adjoint that is passed on is one of them

    def forward(self, source: Program) -> list[Value]:
        """Write a program, and keep a tape of what it calls."""
        new = dict(zip(source.inputs, self._inputs, strict=True))
        for operation in source.operations:
            if operation.code in CALLS and operation.outputs[0].kind == Kind.LANE:
                self._write_taped(operation, new)
            else:
                copied(self._target, operation, new)
        return [new[value] for value in source.outputs]

    def _write_taped(self, operation: Operation, new: dict[Value, Value]) -> None:
        target, pair = self._target, self._differentiator.pair
        args = tuple(new[arg] for arg in operation.args)
        sizes = [output.size for output in operation.outputs]
        programs = called(operation)
        pairs = [pair(program) for program in programs]
        detail = recalled(operation, [forward for forward, _ in pairs])
        times = operation.detail[1] if operation.code == "repeat" else 1
        tape = max(forward.outputs[-1].size for forward, _ in pairs) * times
        made = target.add(operation.code, args, detail, [*sizes, tape], detail)
        self._taped[made[0].maker] = tuple(reverse for _, reverse in pairs)  # type: ignore[index]  # calls have a maker
        new.update(zip(operation.outputs, made, strict=False))

    def reverse(self, seeds: Iterable[tuple[Value, Value]]) -> None:
        """Go back from adjoints of values to those of all that they follow from."""
        self._target.reversing = True
        for value, seed in seeds:
            self._give(value, seed)
        for operation in reversed(list(self._target.operations)):
            if operation.outputs and any(output.kind == Kind.LANE for output in operation.outputs):
                adjoints = [self._taken(output) for output in operation.outputs]
                if any(adjoint is not None for adjoint in adjoints):
                    self._guards = operation.code == ca.OP_IF_ELSE_ZERO or not self._guarded.isdisjoint(
                        operation.outputs
                    )
                    self._pass_on(operation, adjoints)
                    self._guards = False

    def guard(self, values: Iterable[Value]) -> None:
        """Expect that conditions set adjoints of values to zero."""
        self._guarded.update(values)

    def adjoint(self, value: Value) -> Value:
        """Return the adjoint of an input."""
        return self._taken(value) or self._target.constant(np.zeros(value.size))

    def _give(self, value: Value, adjoint: Value) -> None:
        if value.kind < Kind.LANE or _is_zero(adjoint):
            return
        target = self._target
        if self._guards:
            self._guarded.add(value)
        if value.size == 1 < adjoint.size:
            adjoint = target.total(adjoint)
        if adjoint.size == 1 < value.size:
            adjoint = target.gather([adjoint], np.zeros(value.size))
        before = self._full.get(value)
        self._full[value] = adjoint if before is None else target.elementwise(ca.OP_ADD, before, adjoint)

    def _give_some(self, value: Value, adjoint: Value, where: Indices) -> None:
        if value.kind == Kind.LANE and where.size:
            if self._guards:
                self._guarded.add(value)
            self._parts.setdefault(value, []).append((adjoint, where))

    def _taken(self, value: Value) -> Value | None:
        parts = self._parts.pop(value, [])
        if parts:
            where = np.concatenate([part for _, part in parts])
            given = [adjoint for adjoint, _ in parts]
            if len(np.unique(where)) == where.size:
                inverse = np.full(value.size, -1)
                inverse[where] = np.arange(where.size)
                self._give(value, self._target.gather(given, inverse))
            else:
                column = self._target.concatenate(given)
                summed = self._target.accumulate(value.size, where, [column], [np.arange(where.size)])
                self._give(value, summed)
        return self._full.pop(value, None)

    def _pass_on(self, operation: Operation, adjoints: list[Value | None]) -> None:
        target, args = self._target, operation.args
        adjoint = adjoints[0]
        if operation in self._taped:
            self._reverse_call(operation, adjoints)
        elif operation.code == "ruled":
            self._reverse_ruled(operation, adjoints)
        elif operation.code == "external":
            self._reverse_external(operation, adjoints)
        elif adjoint is None or operation.code in ("held", "constant"):
            return
        elif operation.is_elementwise:
            self._reverse_elementwise(operation, adjoint)
        elif operation.code == "gather":
            edges = np.cumsum([0, *(arg.size for arg in args)])
            for arg, begin, end in zip(args, edges[:-1], edges[1:], strict=True):
                (places,) = np.nonzero((operation.detail >= begin) & (operation.detail < end))
                self._give_some(arg, target.gather([adjoint], places), operation.detail[places] - begin)
        elif operation.code == "transpose":
            rows, columns = operation.detail
            self._give(args[0], target.transpose(adjoint, columns, rows))
        elif operation.code == "product":
            m, k, n = operation.detail
            left, right = args
            if left.kind == Kind.LANE:
                given = target.product(adjoint, target.transpose(right, k, n), (m, n, k))
                self._give(left, given if adjoint.size > 1 else self._times(adjoint, given))
            if right.kind == Kind.LANE:
                given = target.product(target.transpose(left, m, k), adjoint, (k, m, n))
                self._give(right, given if adjoint.size > 1 else self._times(adjoint, given))
        else:
            targets, *indices = operation.detail
            if len(args) == 1:
                self._give_some(args[0], target.gather([adjoint], targets), indices[0])
                return
            for this, other in ((0, 1), (1, 0)):
                if args[this].kind == Kind.LANE:
                    factors = [adjoint, args[other]]
                    terms = [targets, indices[other]]
                    given = target.accumulate(args[this].size, indices[this], factors, terms)
                    self._give(args[this], given if adjoint.size > 1 else self._times(adjoint, given))

    def _reverse_elementwise(self, operation: Operation, adjoint: Value) -> None:
        target, args, result = self._target, operation.args, operation.outputs[0]
        code = int(operation.code)
        if code == ca.OP_DIV:
            share = self._times(adjoint, target.elementwise(ca.OP_DIV, adjoint, args[1]))
            self._give(args[0], share)
            if args[1].kind == Kind.LANE:
                loss = target.elementwise(ca.OP_MUL, share, result)
                self._give(args[1], target.elementwise(ca.OP_NEG, self._times(adjoint, loss)))
        elif code == ca.OP_SQRT:
            half = target.elementwise(ca.OP_MUL, target.constant(0.5), adjoint)
            self._give(args[0], self._times(adjoint, target.elementwise(ca.OP_DIV, half, result)))
        elif code in (ca.OP_FMAX, ca.OP_FMIN):
            for one, other in (args, args[::-1]):
                if one.kind == Kind.LANE:
                    slope = target.elementwise(STEP, *((one, other) if code == ca.OP_FMAX else (other, one)))
                    self._give(one, self._times(adjoint, target.elementwise(ca.OP_MUL, slope, adjoint)))
        elif code == ca.OP_IF_ELSE_ZERO:
            self._give(args[1], target.elementwise(code, args[0], adjoint))
        else:
            for arg, slope in zip(args, self._slopes(code, args), strict=True):
                if arg.kind == Kind.LANE and not _is_zero(slope):
                    given = target.elementwise(ca.OP_MUL, slope, adjoint)
                    self._give(arg, given if constant_of(slope) is not None else self._times(adjoint, given))

    def _times(self, adjoint: Value, product: Value) -> Value:
        """Return an elementwise product with an adjoint, 0 where a condition may have set the adjoint to 0."""
        return self._target.elementwise(ca.OP_IF_ELSE_ZERO, adjoint, product) if self._guards else product

    def _slopes(self, code: int, args: Sequence[Value]) -> list[Value]:
        return write_scalars(self._target, _slope_function(code, len(args)), args, each=True, spread=False)

    def _reverse_ruled(self, operation: Operation, adjoints: list[Value | None]) -> None:
        count, rule = operation.detail
        results, inputs = operation.args[:count], operation.args[count:]
        seeds = [adjoint or self._zero for adjoint in adjoints]
        made = write_scalars(self._target, rule, [*inputs, *results, *seeds], each=True)
        for arg, adjoint in zip(inputs, made, strict=True):
            self._give(arg, adjoint)

    def _reverse_call(self, operation: Operation, adjoints: list[Value | None]) -> None:
        target, reverse = self._target, self._taped[operation]
        *results, tape = operation.outputs
        seeds = [
            target.constant(np.zeros(result.size)) if adjoint is None else adjoint
            for result, adjoint in zip(results, adjoints, strict=False)
        ]
        given = (*operation.args, tape, *seeds)
        inputs = [arg for arg in operation.args[operation.code == "switch" :] if arg.kind == Kind.LANE]
        detail = recalled(operation, reverse)
        made = target.add(operation.code, given, detail, [arg.size for arg in inputs], detail)
        for arg, adjoint in zip(inputs, made, strict=True):
            self._give(arg, adjoint)

    def _reverse_external(self, operation: Operation, adjoints: list[Value | None]) -> None:
        target, function = self._target, operation.detail.reverse(1)
        seeds = [
            target.constant(np.zeros(result.size)) if adjoint is None else adjoint
            for result, adjoint in zip(operation.outputs, adjoints, strict=True)
        ]
        given = (*operation.args, *operation.outputs, *seeds)
        sizes = [function.nnz_out(i) for i in range(function.n_out())]
        made = target.add("external", given, function, sizes, hash(function))
        for arg, adjoint in zip(operation.args, made, strict=True):
            if adjoint.size == arg.size:  # where it never changes anything CasADi returns an empty one
                self._give(arg, adjoint)


def _is_zero(value: Value) -> bool:
    numbers = constant_of(value)
    return numbers is not None and not numbers.any()


@cache
def _slope_function(code: int, count: int) -> ca.Function:
    """Return the slopes of a scalar operation by its arguments."""
    args = [ca.SX.sym(name) for name in "xy"[:count]]
    result = ca.SX.unary(code, *args) if count == 1 else ca.SX.binary(code, *args)
    return ca.Function("slopes", args, [ca.densify(ca.jacobian(result, arg)) for arg in args])
