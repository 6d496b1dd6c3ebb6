"""Operators that act on each number by itself, as CasADi expressions of columns.

Each formula stays finite, and so do its first and second derivatives, wherever those of the function are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import casadi as ca
import torch

A = torch.ops.aten


def where(condition: ca.MX, x: ca.MX) -> ca.MX:
    """Return x where a condition holds, else 0, whatever x is there."""
    return ca.MX.binary(ca.OP_IF_ELSE_ZERO, condition, x)


def root(squares: ca.MX) -> ca.MX:
    """Return the square root, whose slope at 0 counts as 0."""
    positive = squares > 0
    return where(positive, ca.sqrt(ca.if_else(positive, squares, 1)))


def angle(y: ca.MX, x: ca.MX) -> ca.MX:
    """Return atan2(y, x), whose slopes at 0, 0 count as 0."""
    somewhere = ca.logic_or(ca.ne(x, 0), ca.ne(y, 0))
    return where(somewhere, ca.atan2(y, ca.if_else(somewhere, x, 1)))


LARGEST_EXPONENT = 80.0  # exp() of more overflows in single precision, and 1 / exp(80) is nothing beside 1


def sigmoid(x: ca.MX) -> ca.MX:
    """1 / (1 + e⁻ˣ)."""
    return 1 / (1 + ca.exp(ca.fmin(-x, LARGEST_EXPONENT)))


def softplus(x: ca.MX, beta: float = 1.0, threshold: float = 20.0) -> ca.MX:
    """log(1 + eᵝˣ) / β, and x where βx is above the threshold, as torch has it."""
    scaled = beta * x
    low = ca.log1p(ca.exp(ca.fmin(scaled, threshold))) / beta
    return ca.if_else(scaled > threshold, x, low)


def elu(x: ca.MX, alpha: float = 1.0, scale: float = 1.0, input_scale: float = 1.0) -> ca.MX:
    """scale · (x where it is positive, else α(e^(x · input scale) - 1))."""
    return scale * (ca.fmax(x, 0) + alpha * ca.expm1(ca.fmin(x, 0) * input_scale))


def gelu(x: ca.MX, approximate: str = "none") -> ca.MX:
    """x Φ(x), or what approximates it by tanh."""
    if approximate == "tanh":
        return 0.5 * x * (1 + ca.tanh(math.sqrt(2 / math.pi) * (x + 0.044715 * x * x * x)))
    return 0.5 * x * (1 + ca.erf(x * math.sqrt(0.5)))


def leaky_relu(x: ca.MX, slope: float = 0.01) -> ca.MX:
    """x where it is positive, else slope · x."""
    return ca.fmax(x, 0) + slope * ca.fmin(x, 0)


def clamp(x: ca.MX, low: Any = None, high: Any = None) -> ca.MX:
    """The nearest number to x between two others."""
    if low is not None:
        x = ca.fmax(x, low)
    return x if high is None else ca.fmin(x, high)


def softshrink(x: ca.MX, size: float = 0.5) -> ca.MX:
    """x moved towards 0 by at most `size`."""
    return ca.fmax(x - size, 0) + ca.fmin(x + size, 0)


def hardshrink(x: ca.MX, size: float = 0.5) -> ca.MX:
    """x where |x| is above `size`, else 0."""
    return where(ca.fabs(x) > size, x)


def hardsigmoid(x: ca.MX) -> ca.MX:
    """(x + 3) / 6 between 0 and 1."""
    return ca.fmin(ca.fmax(x + 3, 0), 6) / 6


def threshold(x: ca.MX, at: float, value: float) -> ca.MX:
    """x where it is above a number, else a value."""
    return ca.if_else(x > at, x, value)


def log_sigmoid(x: ca.MX) -> list[ca.MX]:
    """-log(1 + e⁻ˣ)."""
    return [-softplus(-x, threshold=LARGEST_EXPONENT), ca.MX.zeros(x.sparsity())]  # the second is for torch's own use


def logit(x: ca.MX, eps: float | None = None) -> ca.MX:
    """log(x / (1 - x)), x between eps and 1 - eps."""
    x = x if eps is None else clamp(x, eps, 1 - eps)
    return ca.log(x / (1 - x))


def power(x: ca.MX, exponent: float) -> ca.MX:
    """x to a constant power; whole ones by multiplication, which has derivatives at 0 and below."""
    if exponent == int(exponent) and 0 < abs(exponent) <= 8:
        whole, product = abs(int(exponent)), x
        for _ in range(whole - 1):
            product = product * x
        return product if exponent > 0 else 1 / product
    if exponent == 0:
        return ca.MX.ones(x.sparsity())
    if abs(exponent) == 0.5:
        return ca.sqrt(x) if exponent > 0 else 1 / ca.sqrt(x)
    return x**exponent


def division(x: ca.MX, y: Any, rounding_mode: str | None = None) -> Any:
    """x / y, exactly, rounded down or towards 0."""
    quotient = x / y
    if rounding_mode == "floor":
        return ca.floor(quotient)
    return quotient if rounding_mode is None else truncated(quotient)


def truncated(x: ca.MX) -> Any:
    """Round towards 0."""
    return ca.sign(x) * ca.floor(ca.fabs(x))


def rounded(x: ca.MX) -> Any:
    """Round; halves go to the even neighbour."""
    half_up = ca.floor(x + 0.5)
    odd = half_up - 2 * ca.floor(half_up / 2)
    return half_up - where(ca.eq(half_up - x, 0.5), odd)


def remainder(x: ca.MX, y: Any) -> Any:
    """What is left of x beyond a multiple of y, with the sign of y."""
    rest = ca.fmod(x, y)
    return rest + where(ca.logic_and(ca.ne(rest, 0), ca.ne(rest < 0, ca.MX(y) < 0)), y)


def logaddexp(x: ca.MX, y: ca.MX) -> ca.MX:
    """log(eˣ + eʸ)."""
    larger = ca.fmax(x, y)  # its slopes cancel
    return larger + ca.log(ca.exp(x - larger) + ca.exp(y - larger))


def xlogy(x: ca.MX, y: ca.MX) -> ca.MX:
    """x log y, 0 where x is."""
    return where(ca.ne(x, 0), x * ca.log(ca.if_else(ca.ne(x, 0), y, 1)))


def _sum(x: Any, y: Any, alpha: float = 1) -> Any:
    return x + y if alpha == 1 else x + alpha * y


def _difference(x: Any, y: Any, alpha: float = 1) -> Any:
    return x - y if alpha == 1 else x - alpha * y


def _both(form: Callable[..., Any], *operators: Any) -> dict[Any, Callable[..., Any]]:
    return dict.fromkeys(operators, form)


# Operator → expression. The first arguments are tensors or numbers, of which those of other shapes are repeated; the
# others are numbers or words.
ELEMENTWISE: dict[Any, Callable[..., Any]] = {
    A.neg.default: lambda x: -x,
    A.exp.default: ca.exp,
    A.exp2.default: lambda x: ca.exp(x * math.log(2)),
    A.expm1.default: ca.expm1,
    A.log.default: ca.log,
    A.log1p.default: ca.log1p,
    A.log2.default: lambda x: ca.log(x) / math.log(2),
    A.log10.default: lambda x: ca.log(x) / math.log(10),
    A.sqrt.default: ca.sqrt,
    A.rsqrt.default: lambda x: 1 / ca.sqrt(x),
    A.reciprocal.default: lambda x: 1 / x,
    A.square.default: lambda x: x * x,
    A.abs.default: ca.fabs,
    A.sin.default: ca.sin,
    A.cos.default: ca.cos,
    A.tan.default: ca.tan,
    A.asin.default: ca.asin,
    A.acos.default: ca.acos,
    A.atan.default: ca.atan,
    A.sinh.default: ca.sinh,
    A.cosh.default: ca.cosh,
    A.tanh.default: ca.tanh,
    A.asinh.default: ca.asinh,
    A.acosh.default: ca.acosh,
    A.atanh.default: ca.atanh,
    A.erf.default: ca.erf,
    A.erfc.default: lambda x: 1 - ca.erf(x),
    A.sigmoid.default: sigmoid,
    A.log_sigmoid_forward.default: log_sigmoid,
    A.logit.default: logit,
    A.relu.default: lambda x: ca.fmax(x, 0),
    A.leaky_relu.default: leaky_relu,
    A.elu.default: elu,
    A.gelu.default: gelu,
    A.silu.default: lambda x: x * sigmoid(x),
    A.softplus.default: softplus,
    A.mish.default: lambda x: x * ca.tanh(softplus(x)),
    A.hardtanh.default: lambda x, low=-1.0, high=1.0: clamp(x, low, high),
    A.hardsigmoid.default: hardsigmoid,
    A.hardswish.default: lambda x: x * hardsigmoid(x),
    A.softshrink.default: softshrink,
    A.hardshrink.default: hardshrink,
    A.threshold.default: threshold,
    A.rrelu_with_noise_functional.default: lambda x, noise, lower=1 / 8, upper=1 / 3: [
        leaky_relu(x, (lower + upper) / 2),
        noise,
    ],
    A.sign.default: ca.sign,
    A.sgn.default: ca.sign,
    A.floor.default: ca.floor,
    A.ceil.default: ca.ceil,
    A.trunc.default: truncated,
    A.round.default: rounded,
    A.clamp.default: clamp,
    A.clamp.Tensor: clamp,
    A.clamp_min.default: clamp,
    A.clamp_min.Tensor: clamp,
    A.clamp_max.default: lambda x, high: clamp(x, None, high),
    A.clamp_max.Tensor: lambda x, high: clamp(x, None, high),
    A.logical_not.default: ca.logic_not,
    A.bitwise_not.default: ca.logic_not,
    A.isnan.default: lambda x: ca.ne(x, x),
    A.isinf.default: lambda x: ca.eq(ca.fabs(x), math.inf),
    A.rsub.Scalar: lambda x, y, alpha=1: _difference(y, x, alpha),
    A.rsub.Tensor: lambda x, y, alpha=1: _difference(y, x, alpha),
    A.pow.Tensor_Scalar: power,
    A.pow.Scalar: lambda x, y: ca.exp(y * math.log(x)) if x > 0 else x**y,
    A.pow.Tensor_Tensor: lambda x, y: x**y,
    A.maximum.default: ca.fmax,
    A.minimum.default: ca.fmin,
    A.fmax.default: ca.fmax,
    A.fmin.default: ca.fmin,
    A.atan2.default: angle,
    A.hypot.default: lambda x, y: root(x * x + y * y),
    A.copysign.Tensor: ca.copysign,
    A.fmod.Tensor: ca.fmod,
    A.fmod.Scalar: ca.fmod,
    A.remainder.Tensor: remainder,
    A.remainder.Scalar: remainder,
    A.logaddexp.default: logaddexp,
    A.xlogy.Tensor: xlogy,
    A.where.self: ca.if_else,
    A.lerp.Scalar: lambda x, y, share: x + share * (y - x),
    A.lerp.Tensor: lambda x, y, share: x + share * (y - x),
    A.addcmul.default: lambda x, y, z, value=1: x + value * (y * z),
    A.addcdiv.default: lambda x, y, z, value=1: x + value * (y / z),
    A._prelu_kernel.default: leaky_relu,
    **_both(_sum, A.add.Tensor, A.add.Scalar),
    **_both(_difference, A.sub.Tensor, A.sub.Scalar),
    **_both(lambda x, y: x * y, A.mul.Tensor, A.mul.Scalar),
    **_both(division, A.div.Tensor, A.div.Scalar, A.div.Tensor_mode, A.div.Scalar_mode),
    **_both(lambda x, y: ca.floor(x / y), A.floor_divide.default),
    **_both(lambda x, y: ca.eq(x, y), A.eq.Tensor, A.eq.Scalar),
    **_both(lambda x, y: ca.ne(x, y), A.ne.Tensor, A.ne.Scalar),
    **_both(lambda x, y: x < y, A.lt.Tensor, A.lt.Scalar),
    **_both(lambda x, y: x <= y, A.le.Tensor, A.le.Scalar),
    **_both(lambda x, y: x > y, A.gt.Tensor, A.gt.Scalar),
    **_both(lambda x, y: x >= y, A.ge.Tensor, A.ge.Scalar),
    **_both(lambda x, y: ca.logic_and(x, y), A.logical_and.default, A.bitwise_and.Tensor),
    **_both(lambda x, y: ca.logic_or(x, y), A.logical_or.default, A.bitwise_or.Tensor),
    **_both(lambda x, y: ca.ne(x, y), A.logical_xor.default, A.bitwise_xor.Tensor),
}
