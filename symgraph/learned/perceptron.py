"""Perceptron: a network of rectified linear units in the user's units, as numbers and as symbols."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
import numpy.typing as npt

from symgraph.learned.training import Copies
from symgraph.model import Parameter
from symgraph.slots import Array


@dataclass(frozen=True)
class Scaling:
    """What turns samples into numbers of mean 0 and standard deviation 1: (x - mean) / sd, each (n,).

    What does not vary has sd 0 and is only shifted.
    """

    mean: Array
    sd: Array

    @classmethod
    def of(cls, samples: Array, resolution: Array | float = 0.0) -> Scaling:
        """Return the scaling of samples (N, n), in which deviations up to the resolution (n,) are none."""
        mean, sd = samples.mean(axis=0), samples.std(axis=0)
        constant = sd <= np.maximum(resolution, 1e-9 * np.abs(samples).max(axis=0, initial=0.0))
        return cls(mean, np.where(constant, 0.0, sd))

    @property
    def varies(self) -> npt.NDArray[np.bool_]:
        """(n,)."""
        return self.sd > 0.0

    @property
    def divisor(self) -> Array:
        """(n,): the deviation, or 1 where there is none."""
        return np.where(self.varies, self.sd, 1.0)

    def __call__(self, samples: Array) -> Array:
        return (samples - self.mean) / self.divisor


class Perceptron:
    """Layers y = W max(0, … W₁x + b₁ …) + b whose weights are parameters of the graph.

    Whitening is part of the first and last layers, so that what stands in a graph is a plain network.

    Args:
        sizes: number of inputs, of units in each hidden layer, of outputs.
        name: of the parameters.
    """

    def __init__(self, sizes: Sequence[int], name: str) -> None:
        self.sizes = tuple(sizes)
        self._weights = [
            Parameter(np.zeros((outputs, inputs)), f"{name}_weights_{i}")
            for i, (inputs, outputs) in enumerate(itertools.pairwise(sizes))
        ]
        self._biases = [Parameter(np.zeros(outputs), f"{name}_biases_{i}") for i, outputs in enumerate(sizes[1:])]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Weights (out, in) and biases (out, 1), layer by layer."""
        return tuple(p for pair in zip(self._weights, self._biases, strict=True) for p in pair)

    @property
    def layers(self) -> list[tuple[ca.MX, ca.MX]]:
        """The layers' symbols."""
        return [(w.symbol, b.symbol) for w, b in zip(self._weights, self._biases, strict=True)]

    def set(self, copies: Copies, x: Scaling, y: Scaling | None) -> None:
        """Take over the first of trained copies.

        Args:
            copies: trained on whitened inputs, and on whitened targets if `y` is given.
            x: the scaling of the inputs.
            y: the scaling of the targets; None leaves the outputs as they are.
        """
        weights = [w[0].T.astype(float) for w in copies.weights]
        biases = [b[0, 0].astype(float) for b in copies.biases]
        if y is not None:  # before the first layer is changed, which may be the last one too
            weights[-1], biases[-1] = weights[-1] * y.divisor[:, None], biases[-1] * y.divisor + y.mean
        # Of what did not vary nothing was learned, so it must not matter; its weights are still the random ones.
        weights[0] = np.where(x.varies, weights[0] / x.divisor, 0.0)
        biases[0] = biases[0] - weights[0] @ x.mean
        for parameter, value in zip(self._weights + self._biases, weights + biases, strict=True):
            # CasADi reads columns: laid out like that, no evaluation has to turn them round.
            parameter.value = np.asfortranarray(value if value.ndim == 2 else value[:, None])

    def __call__(self, x: Array) -> Array:
        """Return the outputs (N, m) for inputs (N, n)."""
        hidden = x
        for i, (w, b) in enumerate(zip(self._weights, self._biases, strict=True)):
            hidden = hidden @ w.value.T + b.value.T
            if i < len(self._weights) - 1:
                hidden = np.maximum(hidden, 0.0)
        return hidden


def rescaled(copies: Copies, before: tuple[Scaling, Scaling | None], after: tuple[Scaling, Scaling | None]) -> Copies:
    """Return copies that do with data scaled anew what these do with data scaled as before: (inputs, targets)."""
    weights, biases = [w.astype(float) for w in copies.weights], [b.astype(float) for b in copies.biases]
    (x0, y0), (x1, y1) = before, after
    if y0 is not None and y1 is not None:
        weights[-1] = weights[-1] * (y0.divisor / y1.divisor)
        biases[-1] = (biases[-1] * y0.divisor + y0.mean - y1.mean) / y1.divisor
    # x as before = (x1.mean - x0.mean + x1.sd · x anew) / x0.sd, where it varied
    biases[0] = biases[0] + ((x0.varies * (x1.mean - x0.mean) / x0.divisor) @ weights[0])[:, None]
    weights[0] = weights[0] * (x0.varies * x1.sd / x0.divisor)[:, None]
    return Copies([w.astype(np.float32) for w in weights], [b.astype(np.float32) for b in biases])
