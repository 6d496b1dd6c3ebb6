import numpy as np
import pytest

from symgraph.learned import StochasticNetwork


@pytest.mark.parametrize("level", [0.0, -50.0])
def test_the_paper_s_error_model_does_not_depend_on_the_level_of_the_outputs(level):
    """Its loss aims at 1.42 standard deviations of a Gaussian error."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (300, 1))
    y = level + 2 * x + 0.1 * rng.standard_normal((300, 1))
    network = StochasticNetwork({"x": 1}, {"y": 1}, hidden=(20,), error="paper")
    network.fit(x, y, progress=False)
    _, covariance = network.predict(x)
    assert 0.1 < np.sqrt(covariance.mean()) < 0.2
