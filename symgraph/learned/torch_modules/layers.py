"""Operators of layers: products of matrices, convolutions, pooling, normalisation, attention.

Each is written in terms of simpler ones, through `call`: parts that follow from weights alone then stay with torch.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
import torch

from symgraph.learned.torch_modules.reductions import along, largest, mean, reduced, repeated, softmax, total
from symgraph.learned.torch_modules.symbols import Shape, Symbol, gather, indices

A = torch.ops.aten

Call = Callable[..., Any]  # an operator and its arguments → what it makes
Lifted = Callable[[Any], Symbol]  # anything → a symbolic tensor


def matmul(x: Symbol, y: Symbol) -> Symbol:
    """Return the product of matrices (n, k) and (k, m).

    As CasADi has them they are transposes already, so that xy is read off yᵀxᵀ. What follows from weights stands left,
    where products are quickest.
    """
    (n, k), (_, m) = x.shape, y.shape
    fixed = x.fixed and y.fixed
    if x.fixed and not y.fixed and m > 1:
        turned = y.gathered(indices(y.shape).T)
        made = Symbol(ca.vec(ca.mtimes(x.matrix(k).T, turned.matrix(k))), (m, n), fixed)
        return made.gathered(indices(made.shape).T)
    if x.fixed and not y.fixed:
        return Symbol(ca.mtimes(x.matrix(k).T, y.column), (n, m), fixed)
    return Symbol(ca.vec(ca.mtimes(y.matrix(m), x.matrix(k))), (n, m), fixed)


def batch_matmul(x: Symbol, y: Symbol) -> Symbol:
    """Return the products of matrices (b, n, k) and (b, k, m)."""
    (b, n, _), (_, _, m) = x.shape, y.shape
    made = [matmul(_matrix_of(x, i), _matrix_of(y, i)) for i in range(b)]
    return gather(made, indices((b, n, m)))


def _matrix_of(x: Symbol, i: int) -> Symbol:
    return x.gathered(indices(x.shape)[i])


def add_product(call: Call, added: Any, x: Any, y: Any, *, beta: float = 1, alpha: float = 1) -> Any:
    """Return β · added + α · xy, of matrices or of several each."""
    product = call(A.mm.default if len(x.shape) == 2 else A.bmm.default, x, y)
    if alpha != 1:
        product = call(A.mul.Scalar, product, alpha)
    if beta == 0:
        return product
    return call(A.add.Tensor, product, added if beta == 1 else call(A.mul.Scalar, added, beta))


def linear_layer(call: Call, x: Any, weight: Any, bias: Any = None) -> Any:
    """y = x Wᵀ + b over the last dimension."""
    rows = call(A.reshape.default, x, [math.prod(x.shape[:-1]), x.shape[-1]])
    product = call(A.mm.default, rows, call(A.permute.default, weight, [1, 0]))
    made = call(A.reshape.default, product, [*x.shape[:-1], weight.shape[0]])
    return made if bias is None else call(A.add.Tensor, made, bias)


def vector_product(call: Call, x: Any, y: Any) -> Any:
    """Return the product of a matrix or a row with a column."""
    rows = x if len(x.shape) == 2 else call(A.reshape.default, x, [1, x.shape[0]])
    product = call(A.mm.default, rows, call(A.reshape.default, y, [y.shape[0], 1]))
    return call(A.reshape.default, product, list(x.shape[:-1]))


def add_vector_product(call: Call, added: Any, x: Any, y: Any, *, beta: float = 1, alpha: float = 1) -> Any:
    """Return β · added + α · xy, of a matrix and a column."""
    column = call(A.reshape.default, y, [y.shape[0], 1])
    made = add_product(call, call(A.unsqueeze.default, added, -1), x, column, beta=beta, alpha=alpha)
    return call(A.reshape.default, made, [x.shape[0]])


def trilinear(
    call: Call,
    x: Any,
    y: Any,
    z: Any,
    expand_x: Sequence[int],
    expand_y: Sequence[int],
    expand_z: Sequence[int],
    sum_over: Sequence[int],
    unroll: int = 1,
) -> Any:
    """Return the sum over some dimensions of the product of three tensors, each with dimensions of size 1 put in."""
    factors = []
    for tensor, dims in ((x, expand_x), (y, expand_y), (z, expand_z)):
        for d in dims:
            tensor = call(A.unsqueeze.default, tensor, d)
        factors.append(tensor)
    return call(A.sum.dim_IntList, call(A.mul.Tensor, call(A.mul.Tensor, *factors[:2]), factors[2]), list(sum_over))


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


class Unavailable:
    """A result that has no CasADi form, and that nothing may use."""

    def __init__(self, what: str) -> None:
        self.what = what


def extreme_of(form: Callable[[ca.MX], ca.MX]) -> Callable[..., list[Any]]:
    """Return the operator that makes the extremes along a dimension, and whose places nobody may use."""

    def operator(x: Symbol, dim: int, keepdim: bool = False) -> list[Any]:
        return [reduced(x, dim, keepdim, form), Unavailable("the places of the extremes")]

    return operator


def layer_norm(call: Call, x: Any, shape: Sequence[int], weight: Any, bias: Any, eps: float) -> list[Any]:
    """Return x with mean and variance over its last dimensions taken out."""
    dims = list(range(len(x.shape) - len(shape), len(x.shape)))
    return [_scaled(call, _standardised(x, dims, eps), weight, bias), *_statistics()]


def rms_norm(call: Call, x: Any, shape: Sequence[int], weight: Any = None, eps: float | None = None) -> list[Any]:
    """Return x over the root of the mean of its squares over its last dimensions."""
    dims = list(range(len(x.shape) - len(shape), len(x.shape)))
    least = torch.finfo(torch.float64).eps if eps is None else eps
    made = along(x, dims, lambda m: m / repeated(ca.sqrt(mean(m * m) + least), m))
    return [_scaled(call, made, weight, None), *_statistics()]


def group_norm(
    call: Call, x: Any, weight: Any, bias: Any, n: int, channels: int, space: int, groups: int, eps: float
) -> list[Any]:
    """Return x with mean and variance of each group of channels taken out."""
    rows = x.reshaped((n * groups, channels // groups * space))
    made = _standardised(rows, [1], eps).reshaped(x.shape)
    return [_scaled(call, made, *_per_channel(call, x, weight, bias)), *_statistics()]


def batch_norm(
    call: Call, x: Any, weight: Any, bias: Any, mean_: Any, variance_: Any, momentum: float, eps: float
) -> list[Any]:
    """y = (x - mean) / √(variance + eps) · weight + bias with statistics that are known."""
    scale = call(A.rsqrt.default, call(A.add.Scalar, variance_, eps))
    if weight is not None:
        scale = call(A.mul.Tensor, scale, weight)
    shift = call(A.neg.default, call(A.mul.Tensor, mean_, scale))
    if bias is not None:
        shift = call(A.add.Tensor, shift, bias)
    return [_scaled(call, x, *_per_channel(call, x, scale, shift)), *_statistics()]


def instance_norm(call: Call, x: Any, weight: Any, bias: Any, training: bool, momentum: float, eps: float) -> list[Any]:
    """Return x with the statistics of this very batch taken out, channel by channel."""
    dims = [0, *range(2, len(x.shape))]
    return [_scaled(call, _standardised(x, dims, eps), *_per_channel(call, x, weight, bias)), *_statistics()]


def _statistics() -> list[Unavailable]:
    return [Unavailable("the statistics of a layer"), Unavailable("the statistics of a layer")]


def _standardised(x: Symbol, dims: Sequence[int], eps: float) -> Symbol:
    def form(matrix: ca.MX) -> ca.MX:
        centred = matrix - repeated(mean(matrix), matrix)
        return centred / repeated(ca.sqrt(mean(centred * centred) + eps), matrix)

    return along(x, dims, form)


def _per_channel(call: Call, x: Any, *parts: Any) -> list[Any]:
    shape = [1, x.shape[1], *[1] * (len(x.shape) - 2)]
    return [None if part is None else call(A.reshape.default, part, shape) for part in parts]


def _scaled(call: Call, x: Any, weight: Any, bias: Any) -> Any:
    if weight is not None:
        x = call(A.mul.Tensor, x, weight)
    return x if bias is None else call(A.add.Tensor, x, bias)


def attention(
    call: Call,
    query: Any,
    key: Any,
    value: Any,
    mask: Any = None,
    dropout: float = 0.0,
    is_causal: bool = False,
    *,
    scale: float | None = None,
    enable_gqa: bool = False,
) -> Any:
    """softmax(QKᵀ · scale + mask) V over the last two dimensions; a row whose mask leaves nothing is 0."""
    n, d, m = query.shape[-2], query.shape[-1], key.shape[-2]
    if enable_gqa:
        times = query.shape[-3] // key.shape[-3]
        key, value = (_repeated_heads(call, part, times) for part in (key, value))
    batch = list(np.broadcast_shapes(query.shape[:-2], key.shape[:-2], value.shape[:-2]))
    heads = math.prod(batch)

    def flat(part: Any) -> Any:
        return call(
            A.reshape.default, call(A.expand.default, part, [*batch, *part.shape[-2:]]), [heads, *part.shape[-2:]]
        )

    query = call(A.mul.Scalar, flat(query), 1 / math.sqrt(d) if scale is None else scale)
    keys = call(A.permute.default, flat(key), [0, 2, 1])
    scores = call(A.reshape.default, call(A.bmm.default, query, keys), [*batch, n, m])
    if is_causal:
        mask = torch.ones(n, m, dtype=torch.bool).tril()
    shares = _masked_softmax(call, scores, mask)
    made = call(A.bmm.default, call(A.reshape.default, shares, [heads, n, m]), flat(value))
    return call(A.reshape.default, made, [*batch, n, value.shape[-1]])


def _repeated_heads(call: Call, x: Any, times: int) -> Any:
    *batch, heads, n, d = x.shape
    spread = call(A.expand.default, call(A.unsqueeze.default, x, -3), [*batch, heads, times, n, d])
    return call(A.reshape.default, spread, [*batch, heads * times, n, d])


def _masked_softmax(call: Call, scores: Any, mask: Any) -> Any:
    if not isinstance(mask, torch.Tensor):
        return call(A._softmax.default, scores if mask is None else call(A.add.Tensor, scores, mask), -1, False)
    seen = mask if mask.dtype == torch.bool else mask > -math.inf
    if mask.dtype != torch.bool:
        scores = call(A.add.Tensor, scores, torch.where(seen, mask, 0.0))
    if bool(seen.all()):
        return call(A._softmax.default, scores, -1, False)
    # Where the mask is a constant, each row is a softmax of its own over what it sees.
    open_ = np.broadcast_to(seen.numpy(), scores.shape).reshape(-1, scores.shape[-1])
    rows, places = [], np.full(open_.shape, -1)
    begin = 0
    for i, columns in enumerate(open_):
        (where,) = np.nonzero(columns)
        if len(where):
            rows.append(Symbol(softmax(scores.gathered(i * open_.shape[1] + where).column), (len(where),)))
            places[i, where] = begin + np.arange(len(where))
            begin += len(where)
    return gather(rows, places.reshape(scores.shape))


# Of symbolic tensors alone.
PLAIN: dict[Any, Callable[..., Any]] = {
    A.mm.default: matmul,
    A.bmm.default: batch_matmul,
    A.dot.default: lambda x, y: Symbol(total(x.column * y.column), (), x.fixed and y.fixed),
    A.max.dim: extreme_of(largest),
    A.min.dim: extreme_of(lambda matrix: -largest(-matrix)),
    A.max_pool1d_with_indices.default: max_pool,
    A.max_pool2d_with_indices.default: max_pool,
    A.max_pool3d_with_indices.default: max_pool,
    A.adaptive_max_pool2d.default: adaptive_max_pool,
    A.adaptive_max_pool3d.default: adaptive_max_pool,
}

# In terms of others.
COMPOSED: dict[Any, Callable[..., Any]] = {
    A.addmm.default: add_product,
    A.baddbmm.default: add_product,
    A.addmv.default: add_vector_product,
    A.linear.default: linear_layer,
    A.mv.default: vector_product,
    A._trilinear.default: trilinear,
    A.convolution.default: convolution,
    A.native_layer_norm.default: layer_norm,
    A._fused_rms_norm.default: rms_norm,
    A.native_group_norm.default: group_norm,
    A._native_batch_norm_legit_no_training.default: batch_norm,
    A._native_batch_norm_legit.no_stats: instance_norm,
    A.scaled_dot_product_attention.default: attention,
}
