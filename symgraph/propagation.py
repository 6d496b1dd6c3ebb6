"""Rules that send Gaussians through a plain function: how a mean and a covariance leave y = f(x₁, x₂, …).

A rule takes the function's symbols and expressions and returns expressions for the moments of its outputs. Slots are
independent, so Σ is block-diagonal with one block per input; exact inputs have no block.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca

Moments = tuple[Any, Any]  # mean (n, 1), covariance (n, n); one without non-zeros is exact

Rule = Callable[[Any, Mapping[str, Any], Mapping[str, Any]], Moments]


def mean(y: Any, x: Mapping[str, Any], covariance: Mapping[str, Any]) -> Moments:
    """Ignore the input's covariance: E[y] = f(μ), cov[y] = 0 (the paper's zero-SD case)."""
    return y, type(y)(y.numel(), y.numel())


def linear(y: Any, x: Mapping[str, Any], covariance: Mapping[str, Any]) -> Moments:
    """Propagate to first order: E[y] = f(μ), cov[y] = Σᵢ JᵢΣᵢJᵢᵀ with Jᵢ = ∂f/∂xᵢ at μ."""
    spread = type(y)(y.numel(), y.numel())
    for label, sigma in covariance.items():
        jacobian = ca.jacobian(y, x[label])
        spread = spread + ca.mtimes([jacobian, sigma, jacobian.T])
    return y, spread


def second_order(y: Any, x: Mapping[str, Any], covariance: Mapping[str, Any]) -> Moments:
    """Add the curvature to the mean: E[y_k] = f_k(μ) + ½ Σᵢ tr(H_ki Σᵢ); the covariance is that of `linear`."""
    curvature = []
    for k in range(y.numel()):
        terms = [ca.trace(ca.mtimes(ca.hessian(y[k], x[label])[0], sigma)) for label, sigma in covariance.items()]
        curvature.append(sum(terms, type(y)(1, 1)) / 2)
    return y + ca.vertcat(*curvature), linear(y, x, covariance)[1]


RULES: dict[str, Rule] = {"mean": mean, "linear": linear, "second-order": second_order}
