"""Operators that make one number of several: sums, extremes, norms, and what is built on them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np
import torch

from symgraph.learned.torch_modules.scalars import logaddexp, root, where
from symgraph.learned.torch_modules.symbols import Shape, Symbol, Unavailable, indices

A = torch.ops.aten

Dims = int | Sequence[int] | None

LEAST = -1e30  # less than any score


def reduced(x: Symbol, dims: Dims, keep: bool, form: Callable[[ca.MX], ca.MX]) -> Symbol:
    """Return what a form makes of the columns of a matrix (numbers to be joined, results), a row."""
    chosen = dimensions(x, dims)
    matrix, rest = x.ordered(chosen)
    shape = tuple(1 if d in chosen else n for d, n in enumerate(x.shape)) if keep else rest
    return Symbol(ca.vec(ca.densify(form(matrix))), shape, x.fixed)


def dimensions(x: Symbol, dims: Dims) -> list[int]:
    """Return dimensions from 0 on, all of them where none are named."""
    count = len(x.shape)
    if dims is None or (not isinstance(dims, int) and not len(dims)):
        return list(range(count))
    return [d % count for d in ([dims] if isinstance(dims, int) else dims)] if count else []


def along(x: Symbol, dims: Sequence[int], form: Callable[[ca.MX], ca.MX]) -> Symbol:
    """Return a tensor of the same shape: what a form makes of a matrix with the given dimensions along its columns."""
    rest = [d for d in range(len(x.shape)) if d not in dims]
    order = [*rest, *dims]
    matrix, _ = x.ordered(dims)
    made = Symbol(ca.vec(ca.densify(form(matrix))), tuple(x.shape[d] for d in order), x.fixed)
    return made.gathered(indices(made.shape).transpose(np.argsort(order)))


def total(matrix: ca.MX) -> ca.MX:
    """Return the sums of the columns."""
    return matrix if matrix.shape[0] == 1 else ca.sum1(matrix)


def mean(matrix: ca.MX) -> ca.MX:
    """Return the means of the columns."""
    return total(matrix) / matrix.shape[0]


def extreme(choose: Callable[[Any, Any], Any]) -> Callable[[ca.MX], ca.MX]:
    """Return the form that finds the extreme of each column, by halves."""

    def form(matrix: ca.MX) -> ca.MX:
        while matrix.shape[0] > 1:
            half = matrix.shape[0] // 2
            joined = choose(matrix[:half, :], matrix[half : 2 * half, :])
            matrix = ca.vertcat(joined, matrix[2 * half :, :])
        return matrix

    return form


largest, smallest = extreme(ca.fmax), extreme(ca.fmin)


def product(matrix: ca.MX) -> ca.MX:
    """Return the products of the columns."""
    return extreme(lambda x, y: x * y)(matrix)


def variance(matrix: ca.MX, correction: float) -> ca.MX:
    """Return the variances of the columns."""
    centred = matrix - repeated(mean(matrix), matrix)
    return total(centred * centred) / (matrix.shape[0] - correction)


def repeated(row: ca.MX, matrix: ca.MX) -> ca.MX:
    """Return a row for each row of a matrix."""
    return ca.repmat(row, matrix.shape[0], 1)


def norm(matrix: ca.MX, order: float) -> ca.MX:
    """Return the norms of the columns."""
    if order == 2:
        return root(total(matrix * matrix))
    sizes = ca.fabs(matrix)
    if order == 1:
        return total(sizes)
    if math.isinf(order):
        return (largest if order > 0 else smallest)(sizes)
    if order == 0:
        return total(ca.ne(matrix, 0))
    if order < 0:
        return total(sizes**order) ** (1 / order)
    positive = sizes > 0
    powers = total(where(positive, ca.if_else(positive, sizes, 1) ** order))
    return where(powers > 0, ca.if_else(powers > 0, powers, 1) ** (1 / order))


def exponentials(matrix: ca.MX) -> tuple[ca.MX, ca.MX]:
    """Return exp(x - the largest of its column), and a row of these largest ones. Their slopes cancel in the end."""
    above = largest(matrix)
    return ca.exp(matrix - repeated(above, matrix)), above


def softmax(matrix: ca.MX) -> ca.MX:
    """eˣ / Σ eˣ over each column."""
    powers, _ = exponentials(matrix)
    return powers / repeated(total(powers), matrix)


def softmax_where(seen: ca.MX, matrix: ca.MX) -> ca.MX:
    """Return the softmax over what is seen of each column, and 0 elsewhere."""
    above = largest(ca.if_else(seen, matrix, LEAST))
    # What is not seen may be far above: its exponential must not be infinite even where it does not count.
    powers = where(seen, ca.exp(ca.if_else(seen, matrix - repeated(above, matrix), 0)))
    sums = total(powers)
    return powers / repeated(ca.if_else(sums > 0, sums, 1), matrix)


def log_softmax(matrix: ca.MX) -> ca.MX:
    """x - log Σ eˣ over each column."""
    return matrix - repeated(log_sum(matrix), matrix)


def log_sum(matrix: ca.MX) -> ca.MX:
    """Return log Σ exp of the columns."""
    powers, above = exponentials(matrix)
    return above + ca.log(total(powers))


def _correction(correction: float | None, unbiased: bool = True) -> float:
    return float(unbiased) if correction is None else float(correction)


def _variance(x: Symbol, dims: Dims = None, correction: float | None = None, keepdim: bool = False) -> Symbol:
    return reduced(x, dims, keepdim, lambda matrix: variance(matrix, _correction(correction)))


def _deviation(x: Symbol, dims: Dims = None, correction: float | None = None, keepdim: bool = False) -> Symbol:
    return reduced(x, dims, keepdim, lambda matrix: root(variance(matrix, _correction(correction))))


def _norm(x: Symbol, order: float = 2, dims: Dims = None, keepdim: bool = False) -> Symbol:
    return reduced(x, dims, keepdim, lambda matrix: norm(matrix, order))


def _cumulative(join: Callable[[ca.MX, ca.MX], ca.MX]) -> Callable[..., Symbol]:
    def form(matrix: ca.MX) -> ca.MX:
        rows = [matrix[0, :]]
        for i in range(1, matrix.shape[0]):
            rows.append(join(rows[-1], matrix[i, :]))
        return ca.vertcat(*rows)

    return lambda x, dim: along(x, dimensions(x, dim), form)


def _of_all(form: Callable[[ca.MX], ca.MX]) -> Callable[..., Symbol]:
    return lambda x: reduced(x, None, False, form)


def _of_some(form: Callable[[ca.MX], ca.MX]) -> Callable[..., Symbol]:
    return lambda x, dims=None, keepdim=False: reduced(x, dims, keepdim, form)


def _extreme_and_place(form: Callable[[ca.MX], ca.MX]) -> Callable[..., list[Any]]:
    """Return the operator that makes the extremes along a dimension, and whose places nobody may use."""

    def operator(x: Symbol, dim: int, keepdim: bool = False) -> list[Any]:
        return [reduced(x, dim, keepdim, form), Unavailable("the places of the extremes")]

    return operator


def _along_one(form: Callable[[ca.MX], ca.MX]) -> Callable[..., Symbol]:
    return lambda x, dim, half_to_float=False: along(x, dimensions(x, dim), form) if x.shape else along_scalar(x, form)


def along_scalar(x: Symbol, form: Callable[[ca.MX], ca.MX]) -> Symbol:
    """Return the same for a tensor without dimensions."""
    return Symbol(form(x.column), (), x.fixed)


def distances(x: Symbol, y: Symbol, order: float, compute_mode: int | None = None) -> Symbol:
    """Return the distances (…, n, m) between points (…, n, d) and (…, m, d)."""
    *_, n, d = x.shape
    m = y.shape[-2]
    batch = np.broadcast_shapes(x.shape[:-2], y.shape[:-2])
    shape: Shape = (*batch, n, m, d)
    left, right = x.reshaped((*x.shape[:-1], 1, d)), y.reshaped((*y.shape[:-2], 1, m, d))
    apart = left.expanded(shape).column - right.expanded(shape).column
    return _norm(Symbol(apart, shape, x.fixed and y.fixed), order, -1)


REDUCTIONS: dict[Any, Callable[..., Any]] = {
    A.sum.default: _of_all(total),
    A.sum.dim_IntList: _of_some(total),
    A.mean.default: _of_all(mean),
    A.mean.dim: _of_some(mean),
    A.prod.default: _of_all(product),
    A.prod.dim_int: _of_some(product),
    A.amax.default: _of_some(largest),
    A.amin.default: _of_some(smallest),
    A.max.dim: _extreme_and_place(largest),
    A.min.dim: _extreme_and_place(smallest),
    A.max.default: _of_all(largest),
    A.min.default: _of_all(smallest),
    A.any.default: _of_all(lambda matrix: largest(ca.ne(matrix, 0))),
    A.any.dim: _of_some(lambda matrix: largest(ca.ne(matrix, 0))),
    A.any.dims: _of_some(lambda matrix: largest(ca.ne(matrix, 0))),
    A.all.default: _of_all(lambda matrix: smallest(ca.ne(matrix, 0))),
    A.all.dim: _of_some(lambda matrix: smallest(ca.ne(matrix, 0))),
    A.var.correction: _variance,
    A.std.correction: _deviation,
    A.var_mean.correction: lambda x, dims=None, correction=None, keepdim=False: [
        _variance(x, dims, correction, keepdim),
        reduced(x, dims, keepdim, mean),
    ],
    A.logsumexp.default: _of_some(log_sum),
    A.linalg_vector_norm.default: _norm,
    A.norm.ScalarOpt_dim: lambda x, order, dims, keepdim=False: _norm(x, 2 if order is None else order, dims, keepdim),
    A.norm.Scalar: lambda x, order=2: _norm(x, order),
    A._softmax.default: _along_one(softmax),
    A._safe_softmax.default: _along_one(softmax),
    A._log_softmax.default: _along_one(log_softmax),
    A.cumprod.default: _cumulative(lambda x, y: x * y),
    A.logcumsumexp.default: _cumulative(logaddexp),
    A._cdist_forward.default: distances,
    A._euclidean_dist.default: lambda x, y: distances(x, y, 2),
}
