"""Losses: what a network's outputs are worth against targets, for each copy and sample."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from symgraph.slots import Array

if TYPE_CHECKING:
    import torch

# A deviation is softplus of the error network's output plus this [standard deviations of the targets].
LEAST_DEVIATION = 1e-4
SHORTFALL_WEIGHT = 0.1  # of predicting too large an error, in the paper's loss


def squares(outputs: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """Return the mean square error: outputs (M, B, m) and targets (B, m) to (M, B)."""
    return ((outputs - targets) ** 2).mean(-1)


def gaussian(outputs: torch.Tensor, errors: torch.Tensor) -> torch.Tensor:
    """Return -log N(error; 0, σ²) up to a constant, with σ = softplus(output)."""
    sd = outputs.logaddexp(outputs.new_zeros(())) + LEAST_DEVIATION
    return (sd.log() + 0.5 * (errors / sd) ** 2).mean(-1)


def asymmetric(outputs: torch.Tensor, sizes: torch.Tensor) -> torch.Tensor:
    """Return max(0, t - e)² + 0.1 min(0, t - e)² for error sizes t: too small an e costs ten times as much.

    Source: Yamaguchi & Atkeson, ICRA 2016.
    """
    short = sizes - outputs
    return (short.clamp(min=0.0) ** 2 + SHORTFALL_WEIGHT * short.clamp(max=0.0) ** 2).mean(-1)


def cross_entropy(outputs: torch.Tensor, happened: torch.Tensor) -> torch.Tensor:
    """Return -log of the probability of what happened, given logits (M, B, m) and one-hot rows (B, m)."""
    return -(outputs.log_softmax(-1) * happened).sum(-1)


def inverse_softplus(value: Array) -> Array:
    """Return the output whose softplus is the value."""
    return value + np.log(-np.expm1(-value))
