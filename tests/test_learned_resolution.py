"""The resolution of inputs: what varies by less is noise, of which a network learns nothing."""

import numpy as np
import pytest
from small_networks import ERRORS
from small_tasks import refuses
from stored_models import same

import symgraph as sg
from symgraph.learned import BranchNetwork, StochasticNetwork
from symgraph.learned.perceptron import Scaling

READS = {"a": 1, "p": 2}


def samples(count=40, noise=1e-6, seed=0):
    """Inputs of which the first matters and the last is noise of this size, and noisy outputs."""
    rng = np.random.default_rng(seed)
    x = np.column_stack([rng.uniform(-1, 1, (count, 2)), noise * rng.standard_normal(count)])
    return x, np.sin(2 * x[:, :1]) + 0.3 * x[:, 1:2] + 0.05 * rng.standard_normal((count, 1))


def network(resolution=None, error="likelihood"):
    return StochasticNetwork(READS, {"y": 1}, (16, 16), error=error, resolution=resolution)


def branches(resolution=None):
    return BranchNetwork(READS, ["low", "high"], (16,), resolution=resolution)


def outcome(y):
    return np.where(y[:, 0] > 0, "high", "low").tolist()


def far(x, value, column=2):
    x = x.copy()
    x[:, column] = value
    return x


# Why it exists


def test_noise_in_an_input_does_not_run_away_with_predictions():
    """Among 40 samples a few in a thousand of any noise look like a cause; 0.1 is 100,000 of its deviations away."""
    x, y = samples()
    there = np.abs(far(samples(200, seed=1)[0], 0.1))
    wild, sensible = network(), network({"p": (0.0, 1e-3)})
    for one in (wild, sensible):
        one.fit(x, y)
    true = np.sin(2 * there[:, :1]) + 0.3 * there[:, 1:2]
    assert np.sqrt(np.mean((sensible.predict(there)[0] - true) ** 2)) < 0.25
    assert np.abs(wild.predict(there)[0] - true).max() > 100


# What is below has no influence


@pytest.mark.parametrize("error", ERRORS)
def test_what_varies_by_less_has_no_influence(error):
    x, y = samples()
    one = network({"p": (0.0, 1e-3)}, error)
    one.fit(x, y)
    expected = one.predict(far(x, 0.0))
    for value in (x[:, 2].mean(), 0.1, -1e6):
        for found, same_as in zip(one.predict(far(x, value)), expected, strict=True):
            np.testing.assert_array_equal(found, same_as)
    if error == "likelihood":  # nor has how uncertain it is
        covariance = np.zeros((3, 3))
        covariance[2, 2] = 1.0
        for found, same_as in zip(one.predict(x[0], covariance), one.predict(x[0]), strict=True):
            np.testing.assert_allclose(found, same_as, rtol=1e-6, atol=1e-12)


def test_branches_are_not_influenced_either():
    x, y = samples()
    one, free = branches({"p": (0.0, 1e-3)}), branches()
    for network_ in (one, free):
        network_.fit(x, outcome(y))
    np.testing.assert_array_equal(one.predict(far(x, 0.1)), one.predict(far(x, 0.0)))
    assert np.abs(free.predict(far(x, 0.1)) - free.predict(far(x, 0.0))).max() > 0.1
    right = np.array(one.writes)[one.predict(x).argmax(axis=1)] == outcome(y)
    assert right.mean() > 0.9


def test_a_graph_has_no_slope_there():
    x, y = samples()
    one = network({"p": (0.0, 1e-3)})
    one.fit(x, y)
    graph = sg.Graph({"a": sg.State(), "p": sg.Action(2, low=-1.0, high=1.0), "y": sg.State()}, start="before")
    graph.edge("before", "after", one)
    graph.reward("after", lambda y: y)
    slope = sg.Objective(sg.unroll(graph), compiled=False).gradient({"a": 0.1}, {"p": (0.2, 0.3)})["p"]
    assert slope[1] == 0.0
    assert slope[0] != 0.0


def test_what_is_not_to_be_learned_from_is_not_learned_from():
    """In coarse units noise is large in numbers: a network that was trained on it would miss it afterwards.

    The outputs follow the noise, so that a network that sees it predicts 20 times better than one that must not.
    Held-out errors and σ are within a factor of 1.5 of the errors on new samples.
    """

    def draw(count, seed):
        rng = np.random.default_rng(seed)
        x = np.column_stack([rng.uniform(-1, 1, (count, 2)), 4.0 * rng.standard_normal(count)])
        return x, x[:, :1] + 0.25 * x[:, 2:]

    one = network({"p": (0.0, 5.0)})
    report = one.fit(*draw(80, 0))
    x, y = draw(2000, 1)
    mean, covariance = one.predict(x)
    found = np.sqrt(np.mean((mean - y) ** 2))
    assert found == pytest.approx(1.0, rel=0.3)  # the deviation of 0.25 times the noise
    assert report.rmse[0] == pytest.approx(found, rel=0.5)
    assert np.sqrt(covariance[:, 0, 0].mean()) == pytest.approx(found, rel=0.5)


# What is above is as it was


@pytest.mark.parametrize("resolution", [{}, {"a": 0.0}, {"a": 0.3, "p": (0.3, 1e-9)}])
def test_what_varies_by_more_is_unchanged(resolution):
    x, y = samples()
    for make, targets in ((network, y), (branches, outcome(y))):
        one, free = make(resolution), make()
        for model in (one, free):
            model.fit(x, targets)
        for p, q in zip(one.parameters, free.parameters, strict=True):
            np.testing.assert_array_equal(p.value, q.value)


def test_every_element_has_its_own():
    x, y = samples(noise=1.0)
    assert network({"p": 0.1}).resolution == {"p": [0.1, 0.1]}
    for resolution, still in (((10.0, 0.0), (1,)), ((0.0, 10.0), (2,)), (10.0, (1, 2)), (np.zeros(2), ())):
        one = network({"p": resolution})
        one.fit(x, y)
        for column in range(3):
            moved = np.abs(one.predict(far(x, 3.0, column))[0] - one.predict(far(x, -3.0, column))[0]).max()
            assert (moved == 0.0) == (column in still)


def test_deviations_count_from_just_above_the_resolution():
    x = np.array([[-1.0, 1.0, 3.0], [1.0, 1.0, 3.0]])  # of deviation 1, 0, 0
    assert Scaling.of(x, np.array([1.0, 0.0, 0.0])).sd.tolist() == [0.0, 0.0, 0.0]
    assert Scaling.of(x, np.array([np.nextafter(1.0, 0.0), 2.0, 0.0])).sd.tolist() == [1.0, 0.0, 0.0]
    for resolution in (0.0, np.zeros(3)):
        assert Scaling.of(x, resolution).sd.tolist() == Scaling.of(x).sd.tolist() == [1.0, 0.0, 0.0]


# First constant, later not


@pytest.mark.parametrize(("more", "warm"), [(15, True), (120, False)])
def test_what_begins_to_vary_is_learned(more, warm):
    x, y = samples()
    rng = np.random.default_rng(3)
    new = rng.uniform(-1, 1, (more, 3))
    one = network({"p": (0.0, 1e-3)})
    one.fit(x, y)
    both = np.vstack([x, new]), np.vstack([y, np.sin(2 * new[:, :1]) + 0.3 * new[:, 1:2] + 2.0 * new[:, 2:]])
    assert one.fit(*both).warm == warm
    slope = (one.predict(far(new, 0.7))[0] - one.predict(far(new, -0.7))[0]) / 1.4
    assert slope.mean() == pytest.approx(2.0, rel=0.4 if warm else 0.1)


def test_what_varies_no_more_is_forgotten():
    x, y = samples(noise=1.0)
    one = network({"p": (0.0, 1e-3)})
    one.fit(x, y + x[:, 2:])
    assert one.fit(far(x, 0.3), y).samples == 40
    np.testing.assert_array_equal(one.predict(far(x, 0.3))[0], one.predict(far(x, -5.0))[0])
    assert np.sqrt(np.mean((one.predict(x)[0] - y) ** 2)) < 0.2


# Stored


@pytest.mark.parametrize("make", [network, branches])
def test_it_is_saved_and_a_fit_after_loading_keeps_to_it(make, tmp_path):
    x, y = samples()
    more_x, more_y = samples(50, seed=0)
    one = make({"p": (0.0, 1e-3), "a": 1e-9})
    targets = (y, more_y) if make is network else (outcome(y), outcome(more_y))
    one.fit(x, targets[0])
    one.save(tmp_path / "file")
    loaded = type(one).load(tmp_path / "file")
    assert loaded.resolution == {"p": [0.0, 1e-3], "a": [1e-9]}
    for model in (one, loaded):
        model.fit(more_x, targets[1], seed=2)
    same(loaded, one)
    np.testing.assert_array_equal(loaded.predict(far(x, 0.1))[0], loaded.predict(far(x, 0.0))[0])


# Refusals


@pytest.mark.parametrize(
    ("resolution", "words"),
    [
        (0.1, ["resolution = 0.1", "{label: smallest deviation that counts}"]),
        ([("a", 0.1)], ["resolution = [('a', 0.1)]", "{label: smallest deviation that counts}"]),
        ({"position": 0.1}, ["resolution: 'position' is not read", "Reads: 'a', 'p'"]),
        ({"y": 0.1}, ["resolution: 'y' is not read", "Reads: 'a', 'p'"]),
        ({3: 0.1}, ["resolution: 3 is not read"]),
        ({"a": -0.1}, ["resolution of 'a' is -0.1", "a number of at least 0", "each of its 1 elements"]),
        ({"p": (0.1, -0.1)}, ["resolution of 'p' is (0.1, -0.1)", "each of its 2 elements"]),
        ({"a": float("nan")}, ["resolution of 'a' is nan", "a number of at least 0"]),
        ({"a": float("inf")}, ["resolution of 'a' is inf"]),
        ({"p": (0.1,)}, ["resolution of 'p' is (0.1,)", "each of its 2 elements"]),
        ({"p": (0.1, 0.1, 0.1)}, ["each of its 2 elements"]),
        ({"p": [[0.1, 0.1]]}, ["each of its 2 elements"]),
        ({"p": ()}, ["resolution of 'p' is ()", "each of its 2 elements"]),
        ({"a": "0.1"}, ["resolution of 'a' = '0.1' is not a number"]),
        ({"a": None}, ["resolution of 'a' = None is not a number"]),
        ({"a": {}}, ["resolution of 'a' = {} is not a number"]),
    ],
)
def test_what_is_no_resolution_is_refused(resolution, words):
    for make, name in ((network, "network"), (branches, "branches")):
        refuses(lambda make=make: make(resolution), sg.InputError, f"{name}: ", *words)


def test_a_misspelt_label_is_recognised():
    refuses(
        lambda: StochasticNetwork({"position": 3}, {"y": 1}, resolution={"positon": 0.1}),
        sg.InputError,
        "'positon' is not read; did you mean 'position'?",
    )
