"""Initialisation: where copies begin."""

import itertools

import numpy as np
import pytest

from symgraph.learned import StochasticNetwork, losses
from symgraph.learned.initialisation import begin_linear, carries_linear, initial_copies, unit_carriers
from symgraph.learned.learner import Learner
from symgraph.learned.perceptron import Scaling
from symgraph.progress import Progress


def output(copies, k, x):
    hidden = x
    for i, (weights, biases) in enumerate(zip(copies.weights, copies.biases, strict=True)):
        hidden = hidden @ weights[k].astype(float) + biases[k].astype(float)
        if i < len(copies.weights) - 1:
            hidden = np.maximum(hidden, 0.0)
    return hidden


def slopes(x, y, strength):
    """Ridge regression as least squares with rows that ask for slopes of 0."""
    rows = np.vstack([x, np.sqrt(strength) * np.eye(x.shape[1])])
    return np.linalg.lstsq(rows, np.vstack([y, np.zeros((x.shape[1], y.shape[1]))]), rcond=None)[0]


def test_copies_begin_equal_and_with_zero():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(30, 3))
    copies = initial_copies((3, 20, 10, 2), x, 4, rng)
    assert copies.count == 4
    for array in copies.weights + copies.biases:
        np.testing.assert_array_equal(array, np.repeat(array[:1], 4, axis=0))
        assert array.dtype == np.float32
    for k in range(4):
        np.testing.assert_array_equal(output(copies, k, rng.normal(size=(9, 3))), np.zeros((9, 2)))
    shapes = [(w.shape, b.shape) for w, b in zip(copies.weights, copies.biases, strict=True)]
    sizes = itertools.pairwise((3, 20, 10, 2))
    assert shapes == [((4, n, m), (4, 1, m)) for n, m in sizes]


def test_kinks_pass_through_samples():
    """Each first unit is zero at one sample, to the rounding of single precision."""
    rng = np.random.default_rng(1)
    x = rng.normal(size=(30, 3))
    copies = initial_copies((3, 50, 1), x, 1, rng)
    before = x @ copies.weights[0][0] + copies.biases[0][0]
    nearest = np.abs(before).argmin(axis=0)
    assert np.abs(before).min(axis=0).max() < 1e-6
    assert len(set(nearest)) > 15


def samples(n, noise, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.standard_normal((n, 5))
    y = x @ rng.standard_normal((5, 2)) + noise * rng.standard_normal((n, 2))
    y = (y - y.mean(axis=0)) / y.std(axis=0)
    return x, y, rng.integers(4, size=n)


@pytest.mark.parametrize("hidden", [(4,), (20,), (12, 4), (9, 8, 7)])
@pytest.mark.parametrize("noise", [0.01, 1.0, 5.0])
def test_copies_begin_as_the_ridge_regression_that_predicts_best_what_was_left_out(hidden, noise):
    x, y, folds = samples(40, noise)
    copies = initial_copies((5, *hidden, 2), x, 4, np.random.default_rng(1))  # of four folds three are left out
    begin_linear(copies, x, y, folds)
    learned = [np.ones(40, dtype=bool), *(folds != k for k in range(3))]
    tried = [[slopes(x[rows], y[rows], s) for rows in learned] for s in (0.3, 1.0, 3.0, 10.0, 30.0, 100.0)]
    tried.append([np.zeros((5, 2))] * 4)
    left = [sum(((y - x @ b)[~rows] ** 2).sum(axis=0) for b, rows in zip(o, learned, strict=True)) for o in tried]
    for k in range(4):
        for i, best in enumerate(np.argmin(left, axis=0)):
            np.testing.assert_allclose(output(copies, k, x)[:, i], x @ tried[best][k][:, i], atol=1e-5)


def test_a_copy_begins_with_nothing_of_the_fold_it_leaves_out(monkeypatch):
    monkeypatch.setattr("symgraph.learned.initialisation.RIDGES", (1.0,))  # all folds decide about the strength
    x, y, folds = samples(40, 0.5)
    other = np.where((folds == 1)[:, None], y[::-1], y)
    starts = []
    for targets in (y, other):
        copies = initial_copies((5, 20, 2), x, 5, np.random.default_rng(1))
        begin_linear(copies, x, targets, folds)
        starts.append([output(copies, k, x) for k in range(5)])
    same = [np.array_equal(first, second) for first, second in zip(*starts, strict=True)]
    assert same == [False, False, True, False, False]


def test_where_no_slope_predicts_anything_they_begin_with_0():
    rng = np.random.default_rng(0)
    x = rng.standard_normal((30, 20))
    copies = initial_copies((20, 16, 1), x, 6, rng)
    begin_linear(copies, x, np.abs(x[:, :1]) - np.abs(x[:, :1]).mean(), np.arange(30) % 5)
    np.testing.assert_allclose(output(copies, 0, x), 0.0, atol=1e-6)


def test_networks_with_fewer_units_than_twice_the_outputs_begin_at_random():
    x, y, _ = samples(40, 0.1)
    for hidden, carried in (((), False), ((3,), False), ((20, 3), False), ((4,), True)):
        assert carries_linear((5, *hidden, 2)) == carried
        weights = []
        for start in ("random", "linear"):
            network = StochasticNetwork({"x": 5}, {"y": 2}, hidden, error="none", start=start, decay=1.0, name="net")
            network.fit(x, y, progress=False)
            weights.append([parameter.value for parameter in network.parameters])
        same = all((one == other).all() for one, other in zip(*weights, strict=True))
        assert same != carried


def test_a_linear_function_is_learned_from_few_samples():
    rng = np.random.default_rng(0)
    x, slope = rng.uniform(-3, 8, (200, 10)), rng.standard_normal((10, 2))
    network = StochasticNetwork({"x": 10}, {"y": 2}, hidden=(32,), error="none", start="linear")
    network.fit(x[:30], x[:30] @ slope, progress=False)
    wrong = network.predict(x[30:])[0] - x[30:] @ slope
    assert np.sqrt(np.mean(wrong**2)) < 0.05 * (x @ slope).std()


@pytest.mark.parametrize("sizes", [(3, 8, 2), (3, 8, 6, 2), (3, 8, 6, 5, 2)], ids=str)
def test_unit_carriers_change_nothing_but_the_carriers(sizes):
    rng = np.random.default_rng(3)
    x = rng.normal(size=(40, 3))
    copies = initial_copies(sizes, x, 3, rng)
    begin_linear(copies, x, rng.normal(size=(40, 2)), np.arange(40) % 5)
    for layer, weights in enumerate(copies.weights):  # as if trained
        noise = rng.normal(size=weights.shape).astype(np.float32)
        if layer:
            noise[:, :2, :2] = 0.0
        weights += noise
    factors = np.array([0.02, 30.0])
    copies.weights[-1] *= factors.astype(np.float32)
    before = [output(copies, k, x) / factors for k in range(3)]
    unit_carriers(copies)
    for k in range(3):
        np.testing.assert_allclose(output(copies, k, x) / factors, before[k], atol=2e-5)
    for weights in copies.weights[1:]:
        np.testing.assert_array_equal(weights[:, :2, :2], np.broadcast_to(np.eye(2), (3, 2, 2)))


def test_slopes_cost_the_same_in_a_fit_that_goes_on_as_in_one_from_scratch():
    """An output that has hardly varied at first is scaled anew by a factor of thirty."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(60, 3))
    y = np.where(np.arange(60) < 55, 0.1, 10.0)[:, None] * x[:, :1]
    learner, memory = Learner(), None
    for n in (55, 60):
        scaling = Scaling.of(x[:n]), Scaling.of(y[:n])
        schedule = learner.plan(x[:n], y[:n], warm=memory is not None)
        options = {"linear": True, "decay": 3.0}
        memory, _ = learner.fit(
            memory,
            (3, 8, 1),
            x[:n],
            y[:n],
            scaling,
            losses.squares,
            schedule,
            rng,
            Progress("training", shown=False),
            **options,
        )
    np.testing.assert_array_equal(memory.copies.weights[-1][:, :1, :1], np.ones((6, 1, 1)))
