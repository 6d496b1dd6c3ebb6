"""Initialisation: the weights from which a fit from scratch begins."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from symgraph.learned.training import Copies
from symgraph.slots import Array

RIDGES = (0.3, 1.0, 3.0, 10.0, 30.0, 100.0, math.inf)  # strengths of ridge regression that are tried


def initial_copies(sizes: Sequence[int], x: Array, count: int, rng: np.random.Generator) -> Copies:
    """Return equal copies of a random network that gives 0 everywhere.

    The kinks of the first layer pass through samples, so that they lie where the data are (with biases of 0 they
    would all meet in the middle); He's scale keeps the size of what passes; the last layer is 0, so that training
    begins with the mean of the targets.
    """
    weights, biases = [], []
    for layer, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
        w = rng.standard_normal((inputs, outputs)) * math.sqrt((1 if layer == 0 else 2) / inputs)
        b = np.zeros((1, outputs))
        if layer == len(sizes) - 2:
            w[:] = 0.0
        elif layer == 0:
            b[0] = -np.sum(w.T * x[rng.integers(len(x), size=outputs)], axis=1)
        weights.append(np.repeat(w[None].astype(np.float32), count, axis=0))
        biases.append(np.repeat(b[None].astype(np.float32), count, axis=0))
    return Copies(weights, biases)


def carries_linear(sizes: Sequence[int]) -> bool:
    """Return whether a network has units for a linear function of each output, and as many again to bend it."""
    return min(sizes[1:-1], default=0) >= 2 * sizes[-1]


def begin_linear(copies: Copies, x: Array, targets: Array, folds: npt.NDArray[np.int64]) -> None:
    """Let copies from `initial_copies` begin as what ridge regression makes of the samples that they learn from.

    Few samples show little but slopes, and a network that has to find these first stops when it has learned noise. One
    unit for each output, in every hidden layer, is above zero at all samples and hands a linear function on. How much
    the slopes of an output are held back is what predicts best the samples that were left out.

    Args:
        copies: copy 1 + k leaves out fold k; of a network that `carries_linear`.
        x: (N, n) whitened inputs.
        targets: (N, m), of mean 0.
        folds: (N,) fold of each sample.

    Source: Hoerl & Kennard, Ridge regression, Technometrics 1970.
    """
    m = targets.shape[1]
    left_out = [folds == k for k in range(copies.count - 1)]
    learned = [(x[~rows], targets[~rows]) for rows in (np.zeros(len(x), dtype=bool), *left_out)]
    squares, products = [a.T @ a for a, _ in learned], [a.T @ b for a, b in learned]

    def slopes(strength: float) -> list[Array]:
        if math.isinf(strength):
            return [np.zeros_like(b) for b in products]
        damping = strength * np.eye(x.shape[1])
        return [np.linalg.solve(a + damping, b) for a, b in zip(squares, products, strict=True)]

    tried = [slopes(strength) for strength in RIDGES]
    held_out = [
        sum(((targets[rows] - x[rows] @ b) ** 2).sum(axis=0) for rows, b in zip(left_out, each[1:], strict=True))
        for each in tried
    ]
    best = np.argmin(held_out, axis=0)  # for each output
    for copy in range(copies.count):
        b = np.column_stack([tried[best[i]][copy][:, i] for i in range(m)])
        lift = 1.0 - (x @ b).min(axis=0)
        last = len(copies.weights) - 1
        for layer, (weights, biases) in enumerate(zip(copies.weights, copies.biases, strict=True)):
            if layer == 0:
                weights[copy, :, :m], biases[copy, 0, :m] = b, lift
            elif layer < last:
                weights[copy, :, :m], biases[copy, 0, :m] = 0.0, 0.0
                weights[copy, :m, :m] = np.eye(m)
            else:
                weights[copy, :m], biases[copy, 0] = np.eye(m), -lift


def unit_carriers(copies: Copies) -> None:
    """Let what hands linear functions on be 1 again after outputs were scaled anew; copies do the same as before.

    max(0, c h) = c max(0, h) for c > 0, so that the factors move to where the linear functions are formed. Training
    leaves what hands them on as it is: with other factors, slopes would cost more or less than decay says.

    Args:
        copies: from `begin_linear`, trained and scaled anew.
    """
    m = copies.weights[-1].shape[2]
    factors = np.diagonal(copies.weights[-1][:, :m, :m], axis1=1, axis2=2).copy()  # (M, m)
    last = len(copies.weights) - 1
    for layer, (weights, biases) in enumerate(zip(copies.weights, copies.biases, strict=True)):
        if layer < last:
            weights[:, :, :m] *= factors[:, None]
            biases[:, :, :m] *= factors[:, None]
        if layer > 0:
            weights[:, :m] /= factors[:, :, None]
            weights[:, :m, :m] = np.eye(m)
