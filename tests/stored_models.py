"""Small learned models, fitted once, and what must be equal in two of them."""

from functools import cache

import numpy as np

from symgraph.learned import BranchNetwork, StochasticNetwork

READS, WRITES = {"x": 2, "u": 1}, {"y": 1, "z": 2}
HIDDEN = (8, 5)
RNG = np.random.default_rng(0)
X = RNG.uniform(-1, 1, (40, 3))
Y = np.column_stack([X[:, 0], 1e6 * X[:, 1], X[:, 2] ** 2]) + 0.1 * RNG.standard_normal((40, 3))
HAPPENED = np.where(X[:, 0] > 0, "in", "out").tolist()


def fitted(error="likelihood", **options):
    network = StochasticNetwork(READS, WRITES, HIDDEN, error=error, **options)
    network.fit(X, Y, progress=False)
    return network


def fitted_branches():
    network = BranchNetwork({"x": 3}, ["in", "out"], (6,), name="falls")
    network.fit(X, HAPPENED, progress=False)
    return network


def same(a, b):
    """A model that was loaded equals another in all that decides predictions and further fits."""
    assert a.settings == b.settings
    assert a.samples == b.samples
    for p, q in zip(a.parameters, b.parameters, strict=True):
        np.testing.assert_array_equal(p.value, q.value)
        assert p.value.flags.f_contiguous  # as a fit leaves them
    assert list(a._networks) == list(b._networks)
    for (learner, memory), (other_learner, other) in zip(a._networks.values(), b._networks.values(), strict=True):
        assert learner.begun_with == other_learner.begun_with
        assert learner.folds.known == other_learner.folds.known
        assert (memory is None) == (other is None)
        if memory is None:
            continue
        for name in ("weights", "biases"):
            for array, other_array in zip(getattr(memory.copies, name), getattr(other.copies, name), strict=True):
                assert array.dtype == other_array.dtype
                np.testing.assert_array_equal(array, other_array)
        assert (memory.y is None) == (other.y is None)
        for scaling, other_scaling in ((memory.x, other.x), (memory.y, other.y)):
            if scaling is not None:
                np.testing.assert_array_equal(scaling.mean, other_scaling.mean)
                np.testing.assert_array_equal(scaling.sd, other_scaling.sd)


@cache
def flow():
    """A network whose options are not the default ones; it is not fitted again."""
    resolution = {"u": 0.01, "x": (0.02, 0.0)}
    return fitted(propagation="diagonal", samples_needed=7, resolution=resolution, name="flow")
