"""Symbolic tensors: numbers in torch's order as a CasADi column, and the operations that only move them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
import torch

Shape = tuple[int, ...]
Call = Callable[..., Any]  # an operator and its arguments → what it makes

A = torch.ops.aten

UNITS = 256  # unit vectors that a linear operator is applied to at once

# Operators that move, repeat or drop numbers, or fill up with zeros.
MOVES = {
    A.view.default,
    A._unsafe_view.default,
    A.reshape.default,
    A.permute.default,
    A.transpose.int,
    A.t.default,
    A.unsqueeze.default,
    A.squeeze.default,
    A.squeeze.dim,
    A.squeeze.dims,
    A.expand.default,
    A.clone.default,
    A.alias.default,
    A.detach.default,
    A.lift_fresh_copy.default,
    A.select.int,
    A.slice.Tensor,
    A.narrow.default,
    A.cat.default,
    A.stack.default,
    A.split.Tensor,
    A.split_with_sizes.default,
    A.unbind.int,
    A.chunk.default,
    A.index.Tensor,
    A.index_select.default,
    A.gather.default,
    A.take_along_dim.default,
    A.flip.default,
    A.roll.default,
    A.repeat.default,
    A.repeat_interleave.self_int,
    A.as_strided.default,
    A.unfold.default,
    A.diagonal.default,
    A.diag_embed.default,
    A.tril.default,
    A.triu.default,
    A.rot90.default,
    A.pixel_shuffle.default,
    A.pixel_unshuffle.default,
    A.channel_shuffle.default,
    A.select_scatter.default,
    A.slice_scatter.default,
    A.diagonal_scatter.default,
    A.scatter.src,
    A.index_put.default,
    A.copy.default,
    A.im2col.default,
    A.reflection_pad1d.default,
    A.reflection_pad2d.default,
    A.reflection_pad3d.default,
    A.replication_pad1d.default,
    A.replication_pad2d.default,
    A.replication_pad3d.default,
    A.upsample_nearest1d.default,
    A.upsample_nearest2d.default,
    A.upsample_nearest3d.default,
    A.upsample_nearest1d.vec,
    A.upsample_nearest2d.vec,
    A.upsample_nearest3d.vec,
}

# Operators that are linear in their tensors, with constant coefficients.
LINEAR = {
    A.avg_pool1d.default,
    A.avg_pool2d.default,
    A.avg_pool3d.default,
    A.adaptive_avg_pool1d.default,
    A._adaptive_avg_pool2d.default,
    A._adaptive_avg_pool3d.default,
    A.upsample_linear1d.default,
    A.upsample_linear1d.vec,
    A.upsample_bilinear2d.default,
    A.upsample_bilinear2d.vec,
    A._upsample_bilinear2d_aa.default,
    A.upsample_bicubic2d.default,
    A.upsample_bicubic2d.vec,
    A.upsample_trilinear3d.vec,
    A.cumsum.default,
    A.col2im.default,
    A.scatter_add.default,
    A.index_add.default,
}


@dataclass(frozen=True)
class Symbol:
    """A tensor whose numbers follow from the inputs, or from weights that may change.

    Attributes:
        column: (n, 1), the numbers with the last index running fastest. Reshaped by CasADi, in whose matrices the first
            index does, a tensor (r, c) is the matrix (c, r): its transpose, without a number being moved.
        shape: of the tensor.
        fixed: whether it follows from weights alone.
        boolean: whether its numbers are 0 and 1, and stand for false and true.
    """

    column: ca.MX
    shape: Shape
    fixed: bool = False
    boolean: bool = False

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def matrix(self, rows: int) -> ca.MX:
        """Return the numbers as a matrix (rows, n / rows)."""
        return ca.reshape(self.column, rows, self.size // rows if rows else 0)

    def reshaped(self, shape: Sequence[int]) -> Symbol:
        return Symbol(self.column, tuple(shape), self.fixed)

    def gathered(self, where: npt.NDArray[np.int64]) -> Symbol:
        """Return numbers of this tensor; -1 stands for zero."""
        return gather([self], where)

    def expanded(self, shape: Shape) -> Symbol:
        """Return it repeated along dimensions of size 1, as far as arithmetic does not do that by itself."""
        if self.shape == shape:
            return self
        return self.gathered(np.broadcast_to(indices(self.shape), shape))

    def ordered(self, dims: Sequence[int]) -> tuple[ca.MX, Shape]:
        """Return a matrix with the given dimensions along its columns, and the shape of the others."""
        rest = [d for d in range(len(self.shape)) if d not in dims]
        moved = self.gathered(indices(self.shape).transpose([*rest, *dims]))
        return moved.matrix(math.prod(self.shape[d] for d in dims)), tuple(self.shape[d] for d in rest)


class Unavailable:
    """A result that has no CasADi form, and that nothing may use."""

    def __init__(self, what: str) -> None:
        self.what = what


def indices(shape: Shape) -> npt.NDArray[np.int64]:
    """Return an array of that shape that counts its elements."""
    return np.arange(math.prod(shape)).reshape(shape)


def constant(value: Any) -> Symbol:
    """Return a tensor of numbers."""
    tensor = torch.as_tensor(value).detach()
    numbers = ca.DM(tensor.to(torch.float64).flatten().numpy())
    return Symbol(ca.MX(numbers), tuple(tensor.shape), fixed=True, boolean=tensor.dtype == torch.bool)


def is_boolean(value: Any) -> bool:
    """Whether a tensor, of any kind, holds booleans."""
    if isinstance(value, Symbol):
        return value.boolean
    tensor = getattr(value, "value", value)  # of one that follows from weights
    return isinstance(tensor, torch.Tensor) and tensor.dtype == torch.bool


def gather(sources: Sequence[Symbol], where: npt.NDArray[np.int64]) -> Symbol:
    """Return numbers of tensors that are thought of as one column; -1 stands for zero."""
    where = np.asarray(where)
    flat, fixed = where.ravel(), all(source.fixed for source in sources)
    if not flat.size:
        return Symbol(ca.MX(0, 1), where.shape, fixed)
    total = sum(source.size for source in sources)
    if flat.size == total and (flat == np.arange(total)).all():
        return Symbol(ca.vertcat(*[source.column for source in sources]), where.shape, fixed)
    columns = [source.column for source in sources]
    if (flat < 0).any():
        columns.append(ca.MX(ca.DM.zeros(1, 1)))
        flat = np.where(flat < 0, total, flat)
    column = ca.vertcat(*columns)
    # Of a single number CasADi makes a row.
    return Symbol(ca.vec(column[flat.tolist()]), where.shape, fixed)


def moved(operator: Callable[..., Any], args: Any, kwargs: dict[str, Any]) -> Any:
    """Return what an operator makes that only moves, repeats or drops numbers, or fills up with zeros.

    Where the numbers end up torch says itself: it is given their places instead of them.
    """
    sources: list[Symbol] = []

    def placed(value: Any) -> Any:
        if not isinstance(value, Symbol):
            return value
        begin = 1 + sum(source.size for source in sources)
        sources.append(value)
        return torch.arange(begin, begin + value.size, dtype=torch.float64).reshape(value.shape)

    made = operator(*mapped(placed, args), **mapped(placed, kwargs))
    return mapped(lambda place: gather(sources, place.numpy().astype(np.int64) - 1), made)


def linear(operator: Callable[..., Any], args: Any, kwargs: dict[str, Any]) -> Symbol:
    """Return what an operator makes that is linear in all its symbolic tensors together, as a sparse matrix."""
    sources: list[Symbol] = []
    mapped(lambda value: sources.append(value) if isinstance(value, Symbol) else None, (args, kwargs))
    total = sum(source.size for source in sources)

    def result(units: torch.Tensor) -> torch.Tensor:
        """Return what the operator makes of one column of all numbers."""
        left = iter(torch.split(units, [source.size for source in sources]))

        def part(value: Any) -> Any:
            return next(left).reshape(value.shape) if isinstance(value, Symbol) else value

        return operator(*mapped(part, args), **mapped(part, kwargs))  # type: ignore[no-any-return]  # an aten operator

    shape = tuple(result(torch.zeros(total, dtype=torch.float64)).shape)
    blocks = []
    for begin in range(0, total, UNITS):
        units = torch.zeros(min(UNITS, total - begin), total, dtype=torch.float64)
        units[:, begin:].fill_diagonal_(1.0)
        try:
            made = torch.func.vmap(result)(units)
        except (RuntimeError, IndexError):  # of an operator that has no form for many
            made = torch.stack([result(unit) for unit in units])
        blocks.append(made.flatten(1).to_sparse())
    columns, rows = torch.cat(blocks).coalesce().indices().numpy()
    numbers = torch.cat(blocks).coalesce().values().numpy()
    matrix = ca.DM.triplet(rows.tolist(), columns.tolist(), ca.DM(numbers), math.prod(shape), total)
    column = ca.mtimes(ca.MX(matrix), ca.vertcat(*[source.column for source in sources]))
    return Symbol(ca.densify(column), shape, all(source.fixed for source in sources))


def mapped(function: Callable[[Any], Any], tree: Any) -> Any:
    """Return nested lists, tuples and dicts with every leaf replaced."""
    if isinstance(tree, (list, tuple)):
        return [mapped(function, branch) for branch in tree]
    if isinstance(tree, dict):
        return {key: mapped(function, branch) for key, branch in tree.items()}
    return function(tree)


def leaves(tree: Any) -> list[Any]:
    """Return all leaves of nested lists, tuples and dicts."""
    found: list[Any] = []
    mapped(found.append, tree)
    return found
