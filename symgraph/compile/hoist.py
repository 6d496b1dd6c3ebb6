"""What the gradients of a search have in common is computed once, when a kernel is bound: programs are cut in two."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

import casadi as ca
import numpy as np

from symgraph.compile.differentiate import called, copied, handed, recalled
from symgraph.compile.pairing import Group, in_pairs, weights_of
from symgraph.compile.program import CALLS, Indices, Kind, Operation, Program, Value, constant_of

PANEL = 8  # rows of a packed matrix that stand together, see products.c


class Hoister:
    """Cuts programs, and those that they call, in two; what stands for them is kept and used again.

    Args:
        lanes: whether points are evaluated side by side.
        kind: of what is computed once.
        packs: whether matrices that stand left in a product are packed; else they stay where they are.
    """

    def __init__(self, lanes: bool, kind: Kind = Kind.BOUND, packs: bool = True) -> None:
        self._lanes = lanes
        self._kind = kind
        self._packs = packs
        self._halves: dict[Program, tuple[Program, Program]] = {}

    def halves(self, program: Program) -> tuple[Program, Program]:
        """Cut a program in two.

        Returns:
            the inputs that are bound → a block of numbers; all inputs and that block → the outputs. Where there are
            lanes, outputs of the second one are of lanes.
        """
        if program not in self._halves:
            self._halves[program] = self._cut(program)
        return self._halves[program]

    def _cut(self, program: Program) -> tuple[Program, Program]:
        early = Program(f"{program.name}_early", [Value(x.size, x.kind) for x in program.inputs if self._is_early(x)])
        whole = Program(program.name, [Value(x.size, x.kind) for x in program.inputs])
        bound = [x for x in whole.inputs if self._is_early(x)]
        new = dict(zip(program.inputs, whole.inputs, strict=True))
        operations = used(program.operations, program.outputs)
        # In the reverse sweep one division serves all with the same divisor; values stay what CasADi makes of them.
        divisions = [o for o in operations if o.code == ca.OP_DIV and o.reverse and not self._is_early(o.outputs[0])]
        divisors = Counter(o.args[1] for o in divisions)
        paired = self._packs and not self._lanes
        for group in in_pairs(operations) if paired else [(operation,) for operation in operations]:
            operation = group[0]
            whole.reversing = operation.reverse
            if len(group) > 1:
                self._rewrite_pair(whole, group, new)
            elif operation.reverse and operation.code == ca.OP_DIV and divisors[operation.args[1]] > 1:
                x, y = (new[arg] for arg in operation.args)
                inverse = whole.elementwise(ca.OP_INV, y)
                new[operation.outputs[0]] = whole.elementwise(ca.OP_MUL, x, inverse)
            else:
                self._rewrite(whole, operation, new)
        outputs = [self._of_lanes(whole, new[value]) for value in program.outputs]

        wanted = dict.fromkeys(
            value
            for values in (outputs, *(o.args for o in whole.operations if not self._is_early(o.outputs[0])))
            for value in values
            if self._is_early(value) and not is_free(value)
        )
        block = Value(sum(value.size for value in wanted), self._kind)
        late = Program(program.name, [*(Value(x.size, x.kind) for x in whole.inputs), block])
        before = dict(zip(bound, early.inputs, strict=True))
        after = dict(zip(whole.inputs, late.inputs, strict=False))
        begin = 0
        for value in wanted:
            after[value] = late.gather([block], begin + np.arange(value.size))
            begin += value.size
        for operation in whole.operations:
            if self._is_early(operation.outputs[0]):
                copied(early, operation, before)
                if is_free(operation.outputs[0]) and all(arg in after for arg in operation.args):
                    copied(late, operation, after)
            else:
                copied(late, operation, after)
        early.outputs = (early.concatenate([before[value] for value in wanted]),)
        late.outputs = tuple(after[value] for value in outputs)
        return _pruned(early), _pruned(late)

    def _is_early(self, value: Value) -> bool:
        return value.kind <= self._kind

    def _of_lanes(self, program: Program, value: Value) -> Value:
        """Return the same numbers, for each point."""
        if not self._lanes or not self._is_early(value):
            return value
        (spread,) = program.add("spread", (value,), None, [value.size])
        spread.kind = Kind.BLOCK
        return spread

    def _rewrite(self, whole: Program, operation: Operation, new: dict[Value, Value]) -> None:
        if operation.code == "ruled":  # it has served
            new.update(zip(operation.outputs, (new[arg] for arg in operation.args), strict=False))
        elif self._is_early(operation.outputs[0]):
            copied(whole, operation, new)
        elif operation.code in CALLS:
            self._rewrite_call(whole, operation, new)
        elif operation.code == "product" and self._is_early(new[operation.args[0]]):
            left, right = (new[arg] for arg in operation.args)
            m, k, n = operation.detail
            if not self._packs:
                matrix, transposed, squares = weights_of(left)
                shape = m, k, n, transposed, squares
                new[operation.outputs[0]] = whole.add("weighted product", (matrix, right), shape, [m * n], shape)[0]
                return
            # A point alone is bound by how fast weights can be read: squares are better made anew.
            packed, squared = self._packed(whole, left, m, k, keep_squares=self._lanes)
            detail = m, k, n, squared
            new[operation.outputs[0]] = whole.add("packed product", (packed, right), detail, [m * n], detail)[0]
        else:
            copied(whole, operation, new)

    def _rewrite_pair(self, whole: Program, pair: Group, new: dict[Value, Value]) -> None:
        """Two products with the same weights, in the second one with their squares, become one operation."""
        plain, squared = pair
        m, k, _ = plain.detail
        packed, _ = self._packed(whole, new[plain.args[0]], m, k, keep_squares=False)
        given = packed, new[plain.args[1]], new[squared.args[1]]
        made = whole.add("packed pair", given, (m, k), [m, m], (m, k))
        new.update(zip((plain.outputs[0], squared.outputs[0]), made, strict=True))

    @staticmethod
    def _packed(whole: Program, left: Value, m: int, k: int, keep_squares: bool) -> tuple[Value, bool]:
        """Return a packed matrix (m, k), and whether it is still to be squared."""
        matrix, transposed, squared = weights_of(left)
        if squared and keep_squares:
            matrix = whole.elementwise(ca.OP_SQ, matrix)
        shape = m, k, transposed
        (packed,) = whole.add("pack", (matrix,), shape, [-(-m // PANEL) * PANEL * k], shape)
        return packed, squared and not keep_squares

    def _rewrite_call(self, whole: Program, operation: Operation, new: dict[Value, Value]) -> None:
        """A call of a program becomes one of its first half, which is bound, and one of its second half."""
        args = [new[arg] for arg in operation.args]
        first = int(operation.code == "switch")
        times = operation.detail[1] if operation.code == "repeat" else 1
        programs = called(operation)
        halves = [self.halves(program) for program in programs]
        blocks = []
        for program, own, (early, _) in zip(programs, handed(operation), halves, strict=True):
            given = tuple(new[arg] for arg, x in zip(own, program.inputs, strict=True) if self._is_early(x))
            size = early.outputs[0].size * times
            code, detail = ("repeat", (early, times)) if operation.code == "repeat" else ("call", early)
            blocks.append(whole.add(code, given, detail, [size], detail)[0] if size else whole.constant(np.zeros(0)))
        if self._lanes:
            kinds = [program_input.kind for program_input in programs[0].inputs]
            args[first:] = [
                arg if kind <= self._kind else self._of_lanes(whole, arg)
                for arg, kind in zip(args[first:], kinds, strict=True)
            ]
            args[:first] = [self._of_lanes(whole, arg) for arg in args[:first]]
        detail = recalled(operation, [late for _, late in halves])
        sizes = [output.size for output in operation.outputs]
        made = whole.add(operation.code, (*args, *blocks), detail, sizes, detail)
        new.update(zip(operation.outputs, made, strict=True))


def is_free(value: Value) -> bool:
    """Whether a bound value costs nothing: an input, a constant, or consecutive numbers of such a one."""
    maker = value.maker
    if maker is None or constant_of(value) is not None:
        return True
    return maker.code == "gather" and len(maker.args) == 1 and is_run(maker.detail) and is_free(maker.args[0])


def is_run(indices: Indices) -> bool:
    """Whether indices follow each other."""
    return bool(indices.size and indices[0] >= 0 and (indices == indices[0] + np.arange(indices.size)).all())


def used(operations: Iterable[Operation], outputs: Iterable[Value]) -> list[Operation]:
    """Return the operations that outputs follow from, in order."""
    found: set[Operation] = set()
    waiting = [value.maker for value in outputs]
    while waiting:
        operation = waiting.pop()
        if operation is not None and operation not in found:
            found.add(operation)
            waiting += [arg.maker for arg in operation.args]
    return [operation for operation in operations if operation in found]


def _pruned(program: Program) -> Program:
    program.operations = used(program.operations, program.outputs)
    return program
