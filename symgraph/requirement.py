"""Requirements: what must hold at a node, as margins that must not be positive."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any, Literal

import casadi as ca
import numpy as np

from symgraph.binding import REQUIREMENT, BoundModel
from symgraph.errors import GraphError, SlotError
from symgraph.slots import Array, Gaussian, as_numbers

Side = Literal["low", "high", "equal"]

SMALLEST_VARIANCE = 1e-200  # below it a deviation has no finite slope


@dataclass(frozen=True)
class Requirement:
    """Bounds on what a model returns, wherever the chosen branches lead to its node.

    Attributes:
        model: reads the node's slots.
        low, high: (k,) bounds of its k elements [its unit]; where they are equal, so must it be.
        confidence: probability with which each finite side must hold; None: the mean must lie between the bounds.
    """

    model: BoundModel
    low: Array
    high: Array
    confidence: float | None

    @property
    def sides(self) -> list[tuple[int, Side]]:
        """What is checked, in the order of `margins`: an element and its bound."""
        found: list[tuple[int, Side]] = []
        for i, (low, high) in enumerate(zip(self.low, self.high, strict=True)):
            if low == high:
                found.append((i, "equal"))
                continue
            found += [(i, "low")] if math.isfinite(low) else []
            found += [(i, "high")] if math.isfinite(high) else []
        return found

    def margins(self, outcome: Gaussian) -> list[ca.MX]:
        """Return by how much each side is missed [unit of the model]: must be ≤ 0, or 0 where `sides` says "equal".

        With μ and σ of an element: low - μ + qσ, μ + qσ - high, μ - low, with q the confidence's quantile of the normal
        distribution, 0 without one.

        Args:
            outcome: what the model returns.
        """
        spread = None
        if self.confidence is not None and outcome.covariance.nnz():
            variance = ca.diag(outcome.covariance)
            spread = NormalDist().inv_cdf(self.confidence) * deviation(variance)
        margins = []
        for i, side in self.sides:
            mean = outcome.mean[i]
            miss = self.low[i] - mean if side == "low" else mean - (self.high if side == "high" else self.low)[i]
            margins.append(miss if spread is None else miss + spread[i])
        return margins

    @property
    def lines(self) -> list[str]:
        """What is demanded, for pictures."""
        return [self.told(element, side) for element, side in self.sides]

    def told(self, element: int, side: Side) -> str:
        """Return what a side demands, for messages."""
        own = self.model.name if self.model.name != "<lambda>" else f"requirement({', '.join(self.model.reads)})"
        name = own if self.low.size == 1 else f"{own}[{element}]"
        sign = {"low": "≥", "high": "≤", "equal": "="}[side]
        bound = (self.high if side == "high" else self.low)[element]
        sure = "" if self.confidence is None else f" with probability {self.confidence:g}"
        return f"{name} {sign} {bound:g}{sure}"


def deviation(variance: ca.MX) -> ca.MX:
    """Return √variance with finite slopes at 0; NaN stays NaN."""
    return ca.sqrt(ca.if_else(variance <= SMALLEST_VARIANCE, SMALLEST_VARIANCE, variance))


def requirement(model: BoundModel, low: Any, high: Any, confidence: Any, place: str) -> Requirement:
    """Check the bounds of a requirement.

    Raises:
        GraphError: bounds that are no numbers, of another size, crossed, or of which none is finite; a confidence that
            is no probability, or that is asked of an equality.
    """
    size = model.writes[REQUIREMENT]
    bounds = []
    for name, given in (("low", low), ("high", high)):
        try:
            numbers = as_numbers(given, f"{place}: {name}")
        except SlotError as error:
            raise GraphError(str(error)) from None
        if numbers.shape not in ((), (1,), (size,)) or np.isnan(numbers).any():
            raise GraphError(f"{place}: {name} = {given!r}; give a number, or one for each of its {size} elements")
        bounds.append(np.broadcast_to(numbers, size).astype(float))
    lower, upper = bounds
    wrong = np.flatnonzero((lower > upper) | (lower == math.inf) | (upper == -math.inf))
    if wrong.size:
        i = int(wrong[0])
        raise GraphError(f"{place}: nothing lies between low = {lower[i]:g} and high = {upper[i]:g}; change them")
    if not np.isfinite([lower, upper]).any():
        raise GraphError(f"{place}: neither low nor high is given; give the bound that must hold")
    if confidence is not None:
        number = isinstance(confidence, (int, float, np.number)) and not isinstance(confidence, bool)
        if not number or not 0.0 < confidence < 1.0:
            raise GraphError(f"{place}: confidence = {confidence!r}; give a probability between 0 and 1, e.g. 0.95")
        if (lower == upper).any():
            raise GraphError(
                f"{place}: low = high = {lower[lower == upper][0]:g} with a confidence, but what is uncertain equals a "
                f"number with probability 0; give low < high, or leave confidence out to let the mean be equal"
            )
        confidence = float(confidence)
    return Requirement(model, lower, upper, confidence)
