"""Operators of layers: products of matrices, normalisation, attention; convolutions and pooling are in `windows.py`.

Each is written in terms of simpler ones, through `call`: parts that follow from weights alone then stay with torch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np
import torch

from symgraph.learned.torch_modules.reductions import along, mean, repeated, softmax, softmax_where, total
from symgraph.learned.torch_modules.symbols import Call, Symbol, Unavailable, gather, indices, is_boolean
from symgraph.learned.torch_modules.windows import adaptive_max_pool, convolution, max_pool

A = torch.ops.aten


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
    if mask is None:
        return call(A._softmax.default, scores, -1, False)
    if isinstance(mask, Symbol):
        return _softmax_where_seen(call, scores, mask)
    if not isinstance(mask, torch.Tensor):  # numbers that follow from weights, which are finite
        return call(A._softmax.default, call(A.add.Tensor, scores, mask), -1, False)
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


def _softmax_where_seen(call: Call, scores: Any, mask: Any) -> Any:
    """Return the softmax under a mask that follows from inputs or weights."""
    shape = scores.shape
    zero = torch.zeros(shape, dtype=torch.float64)
    boolean = call(A.logical_not.default, call(A.eq.Scalar, mask, 0 if is_boolean(mask) else -math.inf))
    seen = call(A.logical_and.default, boolean, torch.ones(shape, dtype=torch.bool))  # of the shape of the scores
    if not is_boolean(mask):
        scores = call(A.add.Tensor, scores, call(A.where.self, seen, mask, zero))
    scores = call(A.add.Tensor, scores, zero)
    last = [len(shape) - 1]
    numbers, _ = seen.ordered(last)
    return along(scores, last, lambda matrix: softmax_where(numbers, matrix))


# Of symbolic tensors alone.
PLAIN: dict[Any, Callable[..., Any]] = {
    A.mm.default: matmul,
    A.bmm.default: batch_matmul,
    A.dot.default: lambda x, y: Symbol(total(x.column * y.column), (), x.fixed and y.fixed),
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
