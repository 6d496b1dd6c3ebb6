"""Fitting a StochasticNetwork: from few samples, warm, interrupted, of any scale, and what its error model learns."""

import numpy as np
import pytest
from small_networks import ERRORS, network, samples

from symgraph.learned import StochasticNetwork
from symgraph.learned.training import default_steps


def test_fit_learns_functions_of_any_size():
    x, y = samples(400, seed=3)
    one = StochasticNetwork({"x": 3}, {"y": 2}, hidden=(50, 50))
    report = one.fit(x, y)
    xt, yt = samples(1000, seed=4)
    rmse = np.sqrt(np.mean((one.predict(xt)[0] - yt) ** 2, axis=0))
    assert (rmse < 0.15 * yt.std(axis=0)).all()
    np.testing.assert_allclose(report.rmse, rmse, rtol=0.35)  # held-out errors foretell those on new samples


@pytest.mark.parametrize("count", [1, 2, 3, 5, 8, 20])
@pytest.mark.parametrize("error", ERRORS)
def test_few_samples_give_finite_predictions(count, error):
    one = network(error)
    x, y = samples(count)
    one.fit(x, y)
    for array in (*one.predict(x), *one.predict(x, np.diag([0.1, 10.0, 1e-4]))):
        assert np.isfinite(array).all()


def test_constant_inputs_and_outputs_are_no_obstacle():
    rng = np.random.default_rng(0)
    x = np.column_stack([rng.uniform(0, 1, 30), np.full(30, 7.0)])
    y = np.column_stack([np.full(30, 3.0), x[:, 0]])
    one = StochasticNetwork({"x": 2}, {"y": 2}, hidden=(20,))
    one.fit(x, y)
    mean, spread = one.predict(x)
    np.testing.assert_allclose(mean[:, 0], 3.0, atol=1e-3)
    assert np.isfinite(spread).all()
    one.fit(np.vstack([x, [[0.5, 8.0]]]), np.vstack([y, [[4.0, 0.5]]]))  # now neither is constant
    assert np.isfinite(one.predict(x)[0]).all()


def test_same_seed_same_weights_and_other_seed_other_weights():
    fits = []
    for seed in (1, 1, 2):
        one = network()
        one.fit(*samples(), seed=seed)
        one.fit(*samples(70), seed=seed)
        fits.append([p.value for p in one.parameters])
    assert all(np.array_equal(a, b) for a, b in zip(fits[0], fits[1], strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(fits[0], fits[2], strict=True))


def test_with_decay_a_bend_is_learned_before_noise_is():
    """Sixty samples with ten inputs, of which one bends: without decay noise in the others ends a fit at its start."""
    rng = np.random.default_rng(0)
    x = rng.standard_normal((1060, 10))
    truth = np.abs(x[:, :1])
    y = truth[:60] + 0.3 * rng.standard_normal((60, 1))
    wrong = {}
    for decay in (0.0, 3.0):
        one = StochasticNetwork({"x": 10}, {"y": 1}, (32,), error="none", start="linear", decay=decay)
        one.fit(x[:60], y, progress=False)
        wrong[decay] = np.sqrt(np.mean((one.predict(x[60:])[0] - truth[60:]) ** 2))
    assert wrong[3.0] < 0.7 * truth.std()
    assert wrong[0.0] > 0.9 * truth.std()


def test_fit_is_warm_until_the_samples_have_grown_by_half():
    one = network()
    x, y = samples(60)
    assert not one.fit(x[:40], y[:40]).warm
    warm = one.fit(x[:50], y[:50])
    assert warm.warm
    assert 100 < warm.steps[0] < 0.4 * default_steps(50, 16)
    assert one.fit(x[:51], y[:51]).steps[0] <= 60  # less is new
    assert not one.fit(x, y).warm
    assert not one.fit(*samples(60, seed=9)).warm  # as many, but others


def test_fit_on_a_window_that_slides_begins_anew_in_time():
    """What was there at the last fit from scratch counts, not what came since."""
    one = network()
    x, y = samples(200)
    warm = [one.fit(x[i : i + 60], y[i : i + 60]).warm for i in range(0, 81, 10)]
    assert warm == [False, True, False, True, False, True, False, True, False]


class Interrupted(BaseException):
    pass


@pytest.mark.parametrize("call", [1, 2])
def test_an_interrupted_fit_has_changed_nothing(monkeypatch, call):
    """In the training of the mean (1) or of the error (2): weights, folds and all stay, so the next fit is the same."""
    x, y = samples(60)
    one, other = network(), network()
    for each in (one, other):
        each.fit(x[:30], y[:30])
    before = [p.value.copy() for p in one.parameters]
    from symgraph.learned import learner as learner_module

    train, calls = learner_module.train, []

    def interrupted(*arguments, **options):
        calls.append(1)
        if len(calls) == call:
            raise Interrupted
        return train(*arguments, **options)

    monkeypatch.setattr(learner_module, "train", interrupted)
    with pytest.raises(Interrupted):
        one.fit(x, y)
    monkeypatch.undo()
    assert one.samples == 30
    assert all(np.array_equal(a, p.value) for a, p in zip(before, one.parameters, strict=True))
    assert not one.fit(x, y).warm
    other.fit(x, y)
    assert all(np.array_equal(a.value, b.value) for a, b in zip(one.parameters, other.parameters, strict=True))


def test_what_did_not_vary_does_not_matter_until_it_does():
    rng = np.random.default_rng(0)
    x = np.column_stack([rng.uniform(0.0, 1.0, 60), np.full(60, 500.0)])
    y = np.sin(3.0 * x[:, :1])
    one = StochasticNetwork({"a": 1, "force": 1}, {"y": 1}, hidden=(20, 20))
    one.fit(x, y)
    at, far = one.predict(np.array([0.5, 500.0])), one.predict(np.array([0.5, 600.0]))
    np.testing.assert_array_equal(at[0], far[0])
    np.testing.assert_array_equal(at[1], far[1])
    more = np.column_stack([rng.uniform(0.0, 1.0, 20), rng.uniform(500.0, 600.0, 20)])
    report = one.fit(np.vstack([x, more]), np.vstack([y, np.sin(3.0 * more[:, :1]) + (more[:, 1:] - 500.0) / 100.0]))
    assert report.warm
    assert one.predict(np.array([0.5, 600.0]))[0][0] > at[0][0] + 0.3


def test_fit_inside_no_grad():
    torch = pytest.importorskip("torch")
    with torch.no_grad():
        assert network().fit(*samples(20)).samples == 20
    assert torch.is_grad_enabled()


def test_error_model_follows_noise_that_depends_on_the_input():
    rng = np.random.default_rng(0)
    x = rng.uniform(0.0, 1.0, (400, 1))
    y = np.sin(3.0 * x) + (0.02 + 0.3 * x) * rng.standard_normal(x.shape)
    one = StochasticNetwork({"x": 1}, {"y": 1}, hidden=(50, 50))
    one.fit(x, y)
    low, high = np.sqrt(one.predict(np.array([[0.1], [0.9]]))[1][:, 0, 0])
    assert low == pytest.approx(0.05, rel=0.5)
    assert high == pytest.approx(0.29, rel=0.35)


@pytest.mark.slow
def test_coverage_on_noisy_samples_in_one_dimension():
    """68 ± 6 and 95 ± 3% of new samples lie in the intervals, on average over eight data sets of 200 samples."""
    covered = []
    for seed in range(8):
        rng = np.random.default_rng(seed)

        def draw(count, rng=rng):
            x = rng.uniform(-3.0, 3.0, (count, 1))
            return x, 1.2 + np.sin(3.0 * x) + 0.2 * rng.standard_normal(x.shape)

        one = StochasticNetwork({"x": 1}, {"y": 1})
        one.fit(*draw(200), seed=seed)
        x, y = draw(4000)
        mean, spread = one.predict(x)
        z = np.abs(y - mean)[:, 0] / np.sqrt(spread[:, 0, 0])
        covered.append([np.mean(z < 0.9945), np.mean(z < 1.96)])  # quantiles of the central 68 and 95%
    shares = np.mean(covered, axis=0)
    assert abs(shares[0] - 0.68) < 0.06
    assert abs(shares[1] - 0.95) < 0.03


def test_errors_that_were_held_out_say_more_than_the_papers():
    """Errors on training samples say little about new ones; errors on samples that were left out do."""
    rng = np.random.default_rng(0)
    x, xt = rng.uniform(-1.0, 1.0, (100, 4)), rng.uniform(-1.0, 1.0, (2000, 4))

    def function(x):
        return np.sin(3.0 * x[:, :1] * x[:, 1:2]) + np.abs(x[:, 2:3] - x[:, 3:])

    log_likelihood = {}
    for error in ("likelihood", "paper"):
        one = StochasticNetwork({"x": 4}, {"y": 1}, hidden=(100, 100), error=error)
        one.fit(x, function(x))
        mean, spread = one.predict(xt)
        variance = np.maximum(spread[:, 0, 0], 1e-12)
        errors = (function(xt) - mean)[:, 0]
        log_likelihood[error] = np.mean(-0.5 * np.log(2 * np.pi * variance) - 0.5 * errors**2 / variance)
    assert log_likelihood["likelihood"] > log_likelihood["paper"] + 0.1
