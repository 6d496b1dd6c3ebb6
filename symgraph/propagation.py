"""Rules that send Gaussians through a plain function: how a mean and a covariance leave y = f(x₁, x₂, …).

A rule takes the function's symbols and expressions and returns expressions for the moments of its outputs. Slots are
independent, so Σ is block-diagonal with one block per input; exact inputs have no block.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca

from symgraph import cubature
from symgraph.errors import GraphError

Moments = tuple[Any, Any]  # mean (n, 1), covariance (n, n); one without non-zeros is exact

Rule = Callable[[Any, Mapping[str, Any], Mapping[str, Any]], Moments]

# Gauss–Hermite points for each direction, by the number of directions: a tensor over more grows out of hand.
QUADRATURE_ORDERS = {1: 9, 2: 5, 3: 5}


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
    # CasADi adds zeros to zeros without an element being left.
    return ca.densify(y + ca.vertcat(*curvature)), linear(y, x, covariance)[1]


def unscented(y: Any, x: Mapping[str, Any], covariance: Mapping[str, Any]) -> Moments:
    """Average over points on the axes of Σ, two each, and the middle up to d = 2: means are exact to degree 3.

    Source: Julier & Uhlmann, Unscented Filtering and Nonlinear Estimation, Proceedings of the IEEE 92, 2004.
    """
    return _over_points(y, x, covariance, cubature.unscented(_directions(covariance)) if covariance else None)


def quadrature(y: Any, x: Mapping[str, Any], covariance: Mapping[str, Any]) -> Moments:
    """Average over a Gauss–Hermite grid on the axes of Σ: good for kinks; jumps it merely smooths.

    9 points in one uncertain direction, 5 in each of two or three.

    Raises:
        GraphError: more than three uncertain directions.
    """
    directions = _directions(covariance)
    if directions > max(QUADRATURE_ORDERS):
        sizes = ", ".join(f"{label!r} {sigma.shape[0]}" for label, sigma in covariance.items())
        raise GraphError(
            f"propagation 'quadrature' over {directions} uncertain directions ({sizes}); it serves up to "
            f"{max(QUADRATURE_ORDERS)}: use 'unscented', or split the model so that each part reads fewer of them"
        )
    rule = cubature.gauss_hermite(directions, QUADRATURE_ORDERS[directions]) if directions else None
    return _over_points(y, x, covariance, rule)


def _directions(covariance: Mapping[str, Any]) -> int:
    return sum(sigma.shape[0] for sigma in covariance.values())


def _over_points(y: Any, x: Mapping[str, Any], covariance: Mapping[str, Any], rule: cubature.Rule | None) -> Moments:
    """Return E[y] = Σ w f(μ + Lz) and cov[y] = Σ w (f - E[y])(f - E[y])ᵀ over the rule's points z."""
    if rule is None:
        return mean(y, x, covariance)
    function = ca.Function("f", list(x.values()), [y], {"allow_free": True})
    roots = {label: cubature.square_root(sigma) for label, sigma in covariance.items()}
    values = []
    for z in rule.points.T:
        moved, at = [], 0
        for label, column in x.items():
            n = column.numel() if label in roots else 0
            moved.append(column + ca.mtimes(roots[label], ca.DM(z[at : at + n])) if n else column)
            at += n
        values.append(function.call(moved, True, False)[0])
    columns = ca.horzcat(*values)
    weights = ca.DM(rule.weights)
    average = ca.mtimes(columns, weights)
    deviations = columns - ca.repmat(average, 1, columns.shape[1])
    return average, ca.mtimes(deviations * ca.repmat(weights.T, y.numel(), 1), deviations.T)


RULES: dict[str, Rule] = {
    "mean": mean,
    "linear": linear,
    "second-order": second_order,
    "unscented": unscented,
    "quadrature": quadrature,
}
