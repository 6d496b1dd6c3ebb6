"""Small networks and samples for them, for several test files."""

import numpy as np

from symgraph.learned import StochasticNetwork

ERRORS = ["likelihood", "paper", "none"]


def samples(count=60, seed=0):
    """Noisy samples of two functions of three inputs, of very different sizes."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.0, 1.0, (count, 3)) * [1.0, 100.0, 0.01] + [0.0, 500.0, 0.0]
    z = (x - [0.0, 500.0, 0.0]) / [1.0, 100.0, 0.01]
    y = np.column_stack([1000.0 * np.sin(2.0 * z[:, 0]) * z[:, 1], 0.01 * z[:, 2] + 5.0])
    return x, y + rng.standard_normal(y.shape) * [20.0, 0.0002]


def network(error="likelihood", **options):
    return StochasticNetwork({"p": 2, "q": 1}, {"u": 1, "v": 1}, hidden=(16, 16), error=error, **options)
