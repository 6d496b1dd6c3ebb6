"""Operators that look through windows: convolutions and pooling of the largest."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
import torch

from symgraph.learned.torch_modules.reductions import largest
from symgraph.learned.torch_modules.symbols import Call, Shape, Symbol, Unavailable, indices

A = torch.ops.aten


def convolution(
    call: Call,
    x: Any,
    weight: Any,
    bias: Any,
    stride: Sequence[int],
    padding: Sequence[int],
    dilation: Sequence[int],
    transposed: bool,
    output_padding: Sequence[int],
    groups: int,
) -> Any:
    """Return a convolution of any number of dimensions as one product of matrices for each group.

    The windows stand as columns beside each other. A transposed convolution is a plain one over inputs with zeros
    between them, by weights in reverse order.
    """
    dims = len(stride)
    kernel = weight.shape[2:]
    if transposed:
        inputs, outputs = weight.shape[0], weight.shape[1] * groups
        weight = call(A.reshape.default, weight, [groups, inputs // groups, outputs // groups, *kernel])
        weight = call(A.permute.default, weight, [0, 2, 1, *range(3, 3 + dims)])
        weight = call(A.flip.default, weight, list(range(3, 3 + dims)))
        edges = [dilation[d] * (kernel[d] - 1) - padding[d] for d in range(dims)]
        steps, spaced = [1] * dims, stride
        extra: Sequence[int] = output_padding
    else:
        edges, steps, spaced, extra = padding, stride, [1] * dims, [0] * dims  # type: ignore[assignment]  # lists alike
    channels = x.shape[1] // groups
    outputs = weight.shape[1] * groups if transposed else weight.shape[0]
    size = channels * math.prod(kernel)
    weight = call(A.reshape.default, weight, [groups, outputs // groups, size])
    places = _windows(x.shape, kernel, steps, edges, dilation, spaced, extra)  # (N, channels, kernel…, outputs…)
    n, space = places.shape[0], places.shape[2 + dims :]
    images = []
    for image, group in itertools.product(range(n), range(groups)):
        own = places[image, group * channels : (group + 1) * channels].reshape(size, -1)
        windows = x.gathered(own)
        matrix = call(A.select.int, weight, 0, group)
        images.append(call(A.mm.default, matrix, windows))
    shape = [n, outputs, *space]
    made = call(A.reshape.default, call(A.cat.default, images, 0), shape)
    return made if bias is None else call(A.add.Tensor, made, call(A.reshape.default, bias, [1, outputs, *[1] * dims]))


def _windows(
    shape: Shape,
    kernel: Sequence[int],
    stride: Sequence[int],
    padding: Sequence[int],
    dilation: Sequence[int],
    spaced: Sequence[int] | None = None,
    extra: Sequence[int] | None = None,
    more: Sequence[int] | None = None,
) -> npt.NDArray[np.int64]:
    """Return where windows read a tensor (N, C, …): (N, C, kernel…, outputs…); -1 beyond its edges.

    Args:
        shape: of the tensor.
        kernel: size of the windows.
        stride: between windows.
        padding: of each edge.
        dilation: distance of a window's elements.
        spaced: distance of the tensor's elements, with nothing between them.
        extra: more padding at the ends.
        more: padding at the ends that is no padding to torch: windows of `ceil_mode` may reach beyond.
    """
    place = indices(shape)
    for d, size in enumerate(shape[2:]):
        distance = 1 if spaced is None else spaced[d]
        length = (size - 1) * distance + 1
        behind = padding[d] + (0 if extra is None else extra[d]) + (0 if more is None else more[d])
        outputs = (length + padding[d] + behind - dilation[d] * (kernel[d] - 1) - 1) // stride[d] + 1
        at = np.arange(kernel[d])[:, None] * dilation[d] + np.arange(outputs) * stride[d] - padding[d]
        inside = (at >= 0) & (at < length) & (at % distance == 0)
        axis = 2 + 2 * d  # earlier dimensions have become two each
        place = np.take(place, np.where(inside, at // distance, 0), axis=axis)
        mask = inside.reshape(*[1] * axis, *inside.shape, *[1] * (place.ndim - axis - 2))
        place = np.where(mask, place, -1)
    dims = len(shape) - 2
    return place.transpose(0, 1, *range(2, 2 + 2 * dims, 2), *range(3, 3 + 2 * dims, 2))


def max_pool(
    x: Symbol,
    kernel: Sequence[int],
    stride: Sequence[int] = (),
    padding: Sequence[int] | int = 0,
    dilation: Sequence[int] | int = 1,
    ceil_mode: bool = False,
) -> list[Any]:
    """Return the largest number of each window; elements beyond the edges do not count."""
    dims = len(kernel)
    batched = x if len(x.shape) == dims + 2 else x.reshaped((1, *x.shape))
    stride = list(stride) or list(kernel)
    pad, apart = ([value] * dims if isinstance(value, int) else list(value) for value in (padding, dilation))
    pad, apart = (value * dims if len(value) == 1 else value for value in (pad, apart))
    more = None
    if ceil_mode:
        more = [
            _beyond(n, k, s, p, a) for n, k, s, p, a in zip(batched.shape[2:], kernel, stride, pad, apart, strict=True)
        ]
    places = _windows(batched.shape, kernel, stride, pad, apart, more=more)
    n, c, *rest = places.shape
    space = rest[dims:]
    table = places.reshape(n * c, -1, math.prod(space)).transpose(1, 0, 2).reshape(math.prod(kernel), -1)
    # An element beyond the edge is replaced by another one of its window.
    best = table.max(axis=0)
    table = np.where(table < 0, best, table)
    made = largest(ca.horzcat(*[batched.gathered(row).column for row in table]).T)
    shape = (n, c, *space) if batched is x else (c, *space)
    return [Symbol(ca.vec(made), shape, x.fixed), Unavailable("the places of the largest")]


def adaptive_max_pool(x: Symbol, sizes: Sequence[int]) -> list[Any]:
    """Return the largest number of each of so many windows, which may overlap by one element."""
    dims = len(sizes)
    *_, rest = x.shape[:-dims], x.shape[-dims:]
    edges = [
        [(i * n // size, -((i + 1) * n // -size)) for i in range(size)] for n, size in zip(rest, sizes, strict=True)
    ]
    places = indices(x.shape)
    parts = []
    for window in itertools.product(*edges):
        cut: Any = (..., *(slice(a, b) for a, b in window))
        own = places[cut]
        matrix, _ = Symbol(x.column, x.shape, x.fixed).gathered(own).ordered(range(own.ndim - dims, own.ndim))
        parts.append(largest(matrix).T)
    shape = (*x.shape[:-dims], *sizes)
    made = Symbol(ca.vec(ca.horzcat(*parts).T), shape, x.fixed)
    return [made, Unavailable("the places of the largest")]


def _beyond(size: int, kernel: int, stride: int, padding: int, dilation: int) -> int:
    """Return how far the last window of `ceil_mode` reaches: it is left out if it begins beyond the input's end."""
    reach = dilation * (kernel - 1) + 1
    count = -((size + 2 * padding - reach) // -stride) + 1
    if (count - 1) * stride >= size + padding:
        count -= 1
    return max(0, (count - 1) * stride + reach - size - 2 * padding)
