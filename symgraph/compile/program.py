"""Programs: what a kernel computes, as operations on arrays of numbers, each in order and written once.

A value is an array per start point, or one array for all of them, depending on what it follows from. Equal operations
on equal values are one operation, so that what forward and reverse sweep share is computed once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Sequence
from enum import IntEnum
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

Indices = npt.NDArray[np.int64]


class Kind(IntEnum):
    """What a value follows from."""

    WEIGHT = 0  # constants and parameters alone: the same until a model is fitted anew
    BOUND = 1  # the start state too: the same in all gradients of a search
    BLOCK = 2  # selections too: the same at all points that are evaluated side by side
    LANE = 3  # actions: another one at each point


class Value:
    """An array of `size` numbers; `maker` is the operation that makes it, None for an input."""

    __slots__ = ("kind", "maker", "size", "spot")

    def __init__(self, size: int, kind: Kind, maker: Operation | None = None, spot: int = 0) -> None:
        self.size = size
        self.kind = kind
        self.maker = maker
        self.spot = spot  # which of the maker's outputs


class Operation:
    """One step: CasADi's code of an elementwise operation, or one of the names below.

    constant    detail: the numbers
    held        the argument, through which no derivative passes
    ruled       one of the first arguments; detail: (number of outputs, CasADi's function from inputs, outputs and the
                adjoints of outputs to those of inputs); the arguments are outputs, then inputs
    gather      numbers of the arguments, one after the other; detail: which, -1 for zero
    transpose   a matrix in column-major order; detail: (rows, columns)
    product     matrices (m, k) and (k, n) in column-major order; detail: (m, k, n)
    accumulate  y[t] += a[i] b[j], or y[t] += a[i] with one argument; detail: (t, i, j)
    call        another program; detail: it
    switch      one of several programs, by the first argument; detail: they, the last one for all other numbers.
                Arguments and outputs may be longer than those of a program, which uses their beginnings. Behind
                arguments for all programs may stand some that each has of its own: see `handed`
    weighted product  matrices that stand as they are, perhaps to be transposed or squared first, with others; detail:
                (m, k, n, transposed, squared)
    repeat      a program for consecutive parts of the arguments; detail: (program, times)
    external    a CasADi function that has no program; detail: it
    """

    __slots__ = ("args", "code", "detail", "outputs", "reverse")

    def __init__(self, code: int | str, args: tuple[Value, ...], detail: Any, sizes: Iterable[int], kind: Kind) -> None:
        self.code = code
        self.args = args
        self.detail = detail
        self.reverse = False  # whether it belongs to a reverse sweep
        self.outputs = tuple(Value(size, kind, self, spot) for spot, size in enumerate(sizes))

    @property
    def is_elementwise(self) -> bool:
        return not isinstance(self.code, str)


CALLS = ("call", "switch", "repeat")

STEP = -1  # step(x, y): the slope of fmax(x, y) by x; 1, ½ or 0 for x above, at or below y


class Program:
    """Operations in order, from inputs to outputs."""

    def __init__(self, name: str, inputs: Sequence[Value]) -> None:
        self.name = name
        self.inputs = tuple(inputs)
        self.outputs: tuple[Value, ...] = ()
        self.operations: list[Operation] = []
        self.reversing = False  # whether what is added belongs to a reverse sweep
        self._known: dict[Hashable, Operation] = {}

    def add(
        self, code: int | str, args: tuple[Value, ...], detail: Any, sizes: Iterable[int], key: Hashable = None
    ) -> tuple[Value, ...]:
        """Return the outputs of an operation, of an equal one if there is one already."""
        known = (code, key, args)
        operation = self._known.get(known)
        if operation is None:
            kind = max((arg.kind for arg in args), default=Kind.WEIGHT)
            operation = Operation(code, args, detail, sizes, kind)
            operation.reverse = self.reversing
            self.operations.append(operation)
            self._known[known] = operation
        return operation.outputs

    def constant(self, numbers: Any) -> Value:
        """Return an array of constants."""
        column = np.atleast_1d(np.asarray(numbers, dtype=float)).ravel()
        return self.add("constant", (), column, [column.size], column.tobytes())[0]

    def elementwise(self, code: int, *args: Value) -> Value:
        """Return the result of a scalar operation on each number; arguments of size 1 serve all numbers of others."""
        size = max(arg.size for arg in args) if all(arg.size for arg in args) else 0
        args = tuple(self._single(arg) for arg in args)
        if size > 1 and all(arg.size == 1 for arg in args):  # they were all constants, and all alike
            return self.gather([self.elementwise(code, *args)], np.zeros(size))
        simple = self._simplified(code, args, size)
        return self.add(code, args, None, [size])[0] if simple is None else simple

    def gather(self, sources: Sequence[Value], where: Any) -> Value:
        """Return numbers of sources that are thought of as one column; -1 stands for zero."""
        indices = np.asarray(where, dtype=np.int64)
        edges = np.cumsum([0, *(source.size for source in sources)])
        if len(sources) == 1 and indices.size == sources[0].size and (indices == np.arange(indices.size)).all():
            return sources[0]
        if len(sources) > 1:  # of what is not read nothing is kept
            owner = np.searchsorted(edges, indices, side="right") - 1
            used = np.unique(owner[indices >= 0])
            if len(used) == 1:
                at = int(used[0])
                return self.gather([sources[at]], np.where(indices >= 0, indices - edges[at], -1))
        if indices.size and (indices < 0).all():
            return self.constant(np.zeros(indices.size))
        maker = sources[0].maker if len(sources) == 1 else None
        if maker is not None and maker.code == "gather":
            inner = maker.detail
            return self.gather(maker.args, np.where(indices >= 0, inner[indices], -1))
        if maker is not None and maker.code == "constant":
            return self.constant(np.where(indices >= 0, maker.detail[indices], 0.0))
        return self.add("gather", tuple(sources), indices, [indices.size], indices.tobytes())[0]

    def concatenate(self, parts: Sequence[Value]) -> Value:
        """Return values one after the other."""
        return self.gather(parts, np.arange(sum(part.size for part in parts)))

    def element(self, source: Value, index: int) -> Value:
        """Return one number of an array."""
        return self.gather([source], [index])

    def product(self, left: Value, right: Value, shape: tuple[int, int, int]) -> Value:
        """Return the product (m, n) of matrices (m, k) and (k, n)."""
        m, k, n = shape
        if not m * k * n:
            return self.constant(np.zeros(m * n))
        if m == k == n == 1:
            return self.elementwise(ca.OP_MUL, left, right)
        return self.add("product", (left, right), shape, [m * n], shape)[0]

    def transpose(self, matrix: Value, rows: int, columns: int) -> Value:
        """Return the transpose of a matrix (rows, columns)."""
        if rows == 1 or columns == 1:
            return matrix
        maker = matrix.maker
        if maker is not None and maker.code == ca.OP_SQ:  # so that it is still known to be a square
            return self.elementwise(ca.OP_SQ, self.transpose(maker.args[0], rows, columns))
        return self.add("transpose", (matrix,), (rows, columns), [matrix.size], (rows, columns))[0]

    def accumulate(self, size: int, targets: Any, args: Sequence[Value], indices: Sequence[Any]) -> Value:
        """Return y (size) with y[targets] += the product of the arguments' numbers at indices."""
        table = tuple(np.asarray(column, dtype=np.int64) for column in (targets, *indices))
        key = (size, *(column.tobytes() for column in table))
        return self.add("accumulate", tuple(args), table, [size], key)[0]

    def total(self, source: Value) -> Value:
        """Return the sum of all numbers."""
        if source.size == 1:
            return source
        return self.accumulate(1, np.zeros(source.size), [source], [np.arange(source.size)])

    def held(self, source: Value) -> Value:
        """Return the same numbers, through which no derivative passes."""
        return source if source.kind < Kind.LANE else self.add("held", (source,), None, [source.size])[0]

    def _single(self, value: Value) -> Value:
        numbers = constant_of(value)
        if numbers is not None and numbers.size > 1 and (numbers == numbers[0]).all():
            return self.constant(numbers[0])
        return value

    def _simplified(self, code: int, args: tuple[Value, ...], size: int) -> Value | None:
        """Return what an operation comes to without being carried out."""
        numbers = [constant_of(arg) for arg in args]
        if size == 0:
            return self.constant(np.zeros(0))
        if all(number is not None for number in numbers) and code in _FOLDED:
            with np.errstate(all="ignore"):
                return self.constant(np.broadcast_to(_FOLDED[code](*numbers), size))
        if code == ca.OP_ASSIGN:
            return args[0]
        if len(args) == 1:
            maker = args[0].maker
            return maker.args[0] if code == ca.OP_NEG and maker is not None and maker.code == ca.OP_NEG else None
        (x, y), (p, q) = args, (_only(number) for number in numbers)
        full_x, full_y = x.size == size, y.size == size
        if code == ca.OP_ADD and ((p == 0.0 and full_y) or (q == 0.0 and full_x)):
            return y if p == 0.0 and full_y else x
        if code == ca.OP_SUB and (q == 0.0 and full_x):
            return x
        if code == ca.OP_SUB and p == 0.0:
            return self.elementwise(ca.OP_NEG, y) if full_y else None
        if code == ca.OP_MUL and (p == 0.0 or q == 0.0):  # as CasADi has it
            return self.constant(np.zeros(size))
        if code in (ca.OP_MUL, ca.OP_DIV) and q == 1.0 and full_x:
            return x
        if code == ca.OP_MUL and p == 1.0 and full_y:
            return y
        if code == ca.OP_MUL and q == -1.0 and full_x:
            return self.elementwise(ca.OP_NEG, x)
        if code == ca.OP_MUL and p == -1.0 and full_y:
            return self.elementwise(ca.OP_NEG, y)
        return None


def constant_of(value: Value) -> npt.NDArray[np.float64] | None:
    """Return the numbers of a constant."""
    maker = value.maker
    return maker.detail if maker is not None and maker.code == "constant" else None


def _only(numbers: npt.NDArray[np.float64] | None) -> float:
    return float(numbers[0]) if numbers is not None and numbers.size == 1 else math.nan


_FOLDED: dict[int, Callable[..., Any]] = {
    ca.OP_ADD: np.add,
    ca.OP_SUB: np.subtract,
    ca.OP_MUL: np.multiply,
    ca.OP_DIV: np.divide,
    ca.OP_NEG: np.negative,
    ca.OP_SQ: np.square,
    ca.OP_SQRT: np.sqrt,
    ca.OP_INV: np.reciprocal,
    ca.OP_TWICE: lambda x: 2 * x,
}
