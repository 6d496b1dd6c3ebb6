"""StochasticNetwork as its users meet it: what it predicts, how it is fitted, what a graph computes with it."""

import pickle
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_networks import ERRORS, network, samples

import symgraph as sg
from symgraph.learned import StochasticNetwork
from symgraph.learned.gaussians import RULES


@pytest.fixture(scope="module")
def fitted():
    """A network of each error model, fitted."""
    networks = {error: network(error) for error in ERRORS}
    for one in networks.values():
        one.fit(*samples())
    return networks


def graph_of(model, p=None, q=None):
    """A graph in which the network reads p and q and writes u and v."""
    slots = {"p": sg.State(2), "q": sg.State(), "u": sg.State(), "v": sg.State()}
    graph = sg.Graph(slots, start="before")
    graph.edge("before", "after", model)
    graph.reward("after", lambda u, v: u + v)
    return sg.Objective(sg.unroll(graph))


def in_graph(model, mean, covariance=None):
    """Mean (2,) and covariances (2,) of u and v as the graph has them."""
    blocks = (None, None) if covariance is None else (covariance[:2, :2], covariance[2, 2])
    state = {"p": sg.Gaussian(mean[:2], blocks[0]), "q": sg.Gaussian(mean[2], blocks[1])}
    after = graph_of(model).outcomes(state)[-1].states
    return np.array([after["u"].mean, after["v"].mean]), np.array([after["u"].covariance, after["v"].covariance])


# Predictions


@pytest.mark.parametrize("error", ERRORS)
def test_prediction_equals_the_graph(fitted, error):
    for mean in samples(5, seed=1)[0]:
        y, covariance = fitted[error].predict(mean)
        graph_mean, graph_variance = in_graph(fitted[error], mean)
        np.testing.assert_allclose(y, graph_mean, rtol=1e-10)
        np.testing.assert_allclose(np.diag(covariance), graph_variance, rtol=1e-10)


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("error", ERRORS)
def test_prediction_of_a_gaussian_equals_the_graph(fitted, error, rule):
    view = fitted[error].with_propagation(rule)
    mean = np.array([0.3, 480.0, 0.002])
    covariance = np.zeros((3, 3))
    covariance[:2, :2], covariance[2, 2] = [[0.01, 0.5], [0.5, 100.0]], 1e-6
    y, spread = view.predict(mean, covariance)
    graph_mean, graph_variance = in_graph(view, mean, covariance)
    np.testing.assert_allclose(y, graph_mean, rtol=1e-10)
    np.testing.assert_allclose(np.diag(spread), graph_variance, rtol=1e-8)  # 1e-10 of the largest
    assert np.linalg.eigvalsh(spread).min() >= -1e-9 * np.abs(spread).max()


def test_prediction_with_one_uncertain_label_equals_the_graph(fitted):
    """What is exact is no uncertain direction, so "auto" takes the same rule in both."""
    mean, covariance = np.array([0.3, 480.0, 0.002]), np.zeros((3, 3))
    covariance[2, 2] = 1e-5
    y, spread = fitted["likelihood"].predict(mean, covariance)
    slots = {"p": sg.State(2), "q": sg.State(), "u": sg.State(), "v": sg.State()}
    graph = sg.Graph(slots, start="before")
    graph.edge("before", "after", fitted["likelihood"])
    graph.reward("after", lambda u, v: u + v)
    state = {"p": mean[:2], "q": sg.Gaussian(mean[2], 1e-5)}
    after = sg.Objective(sg.unroll(graph)).outcomes(state)[-1].states
    np.testing.assert_allclose(y, [after["u"].mean, after["v"].mean], rtol=1e-10)
    np.testing.assert_allclose(np.diag(spread), [after["u"].covariance, after["v"].covariance], rtol=1e-9)


@pytest.mark.parametrize("rule", ["auto", "low-rank", "full"])
def test_expected_error_is_the_average_over_draws(rule):
    """E[σ²(x)] over 20,000 draws in four directions: within 20%, what the layers' approximation leaves."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-1.0, 1.0, (300, 4))
    y = 0.02 + np.exp(1.5 * x[:, :1] * x[:, 1:2]) * 0.1 * rng.standard_normal((300, 1))
    one = StochasticNetwork({"x": 4}, {"y": 1}, hidden=(30, 30), propagation=rule)
    one.fit(x, y)
    covariance = 0.3**2 * np.eye(4)
    for mean in rng.uniform(-0.5, 0.5, (4, 4)):
        draws = mean + 0.3 * rng.standard_normal((20_000, 4))
        f, variance = one.predict(draws)
        expected = variance[:, 0, 0].mean() + f.var()
        assert one.predict(mean, covariance)[1][0, 0] == pytest.approx(expected, rel=0.2)


def test_one_row_or_many(fitted):
    x = samples(4, seed=2)[0]
    covariance = np.diag([0.01, 25.0, 1e-6])
    for given_covariance in (None, covariance, np.array([covariance * k for k in range(1, 5)])):
        y, spread = fitted["likelihood"].predict(x, given_covariance)
        assert y.shape == (4, 2)
        assert spread.shape == (4, 2, 2)
        for i, row in enumerate(x):
            one = given_covariance[i] if np.ndim(given_covariance) == 3 else given_covariance
            y_one, spread_one = fitted["likelihood"].predict(row, one)
            np.testing.assert_allclose(y_one, y[i], rtol=1e-12)
            np.testing.assert_allclose(spread_one, spread[i], rtol=1e-12)


def test_predicted_spread_of_a_gaussian_is_that_of_draws(fitted):
    """Law of total variance: cov[y] = cov[f(x)] + E[σ²(x)], over 200,000 draws, whose own error is under 1%."""
    mean, covariance = np.array([0.1, 500.0, 0.0]), np.diag([0.04, 400.0, 1e-5])
    draws = np.random.default_rng(0).multivariate_normal(mean, covariance, 200_000)
    y, spread = fitted["likelihood"].predict(draws)
    expected = np.cov(y.T) + spread.mean(axis=0)
    found_mean, found = fitted["likelihood"].predict(mean, covariance)
    np.testing.assert_allclose(found_mean, y.mean(axis=0), atol=0.03 * np.sqrt(np.diag(expected)).max())
    np.testing.assert_allclose(np.diag(found), np.diag(expected), rtol=0.1)


def test_without_its_spreads_a_network_is_certain(fitted):
    x, sigma = np.array([0.3, -0.2, 0.5]), np.diag([0.04, 0.04, 0.0])
    for error, model in fitted.items():
        assert len(model.spreads) == (error != "none")
        mean, kept = model.predict(x)[0], [parameter.value for parameter in model.spreads]
        for parameter in model.spreads:
            assert any(parameter is other for other in model.parameters)
            parameter.value = np.zeros_like(parameter.value)
        try:
            np.testing.assert_array_equal(model.predict(x)[0], mean)
            assert not model.predict(x)[1].any()
            assert model.predict(x, sigma)[1].trace() > 0
        finally:
            for parameter, value in zip(model.spreads, kept, strict=True):
                parameter.value = value


def test_an_unfitted_network_predicts_finite_numbers_and_says_what_it_lacks():
    one = network()
    y, spread = one.predict(np.zeros(3))
    assert np.isfinite(y).all()
    assert np.isfinite(spread).all()
    assert one.lacking == "0 of 3 samples"
    one.fit(*samples(2))
    assert one.lacking == "2 of 3 samples"
    one.fit(*samples(3))
    assert one.lacking is None


# In a graph


def miss(y):
    return -((y - 1.0) ** 2)


@pytest.fixture
def task():
    """A network that is steered by an action, between an analytic edge and a reward; uncertain start."""
    one = StochasticNetwork({"a": 1, "s": 1}, {"y": 1}, hidden=(16, 16), name="F_y")
    slots = {"a": sg.Action(low=-1.0, high=1.0), "s": sg.State(), "y": sg.State()}
    graph = sg.Graph(slots, start="before")
    graph.edge("before", "after", one)
    graph.reward("after", miss)
    return one, sg.Objective(sg.unroll(graph))


def steered(slope, seed=0):
    x = np.random.default_rng(seed).uniform(-1.0, 1.0, (80, 2))
    return x, slope * x[:, :1] + 0.2 * x[:, 1:]


STATE = {"s": sg.Gaussian(0.0, sd=0.1)}


def test_plans_use_new_weights_and_nothing_is_rebuilt_or_compiled(task, monkeypatch):
    one, objective = task
    one.fit(*steered(1.5))
    first = sg.solve(objective, STATE)
    assert first.actions["a"] == pytest.approx(1 / 1.5, abs=0.1)

    built = []

    def counted(name, function):
        def wrapper(*arguments, **options):
            built.append(name)
            return function(*arguments, **options)

        return wrapper

    from symgraph import situation as situation_module
    from symgraph.compile import toolchain

    monkeypatch.setattr(subprocess, "run", counted("compiler", subprocess.run))
    monkeypatch.setattr(toolchain, "load", counted("load", toolchain.load))
    for name in ("expected_value", "make_kernel", "FlatFunction"):
        monkeypatch.setattr(situation_module, name, counted(name, getattr(situation_module, name)))
    monkeypatch.setattr(ca.Function, "__init__", counted("Function", ca.Function.__init__))
    one.fit(*steered(-2.0))
    second = sg.solve(objective, STATE)
    assert second.actions["a"] == pytest.approx(-0.5, abs=0.1)
    assert not built


def test_gradient_is_that_of_finite_differences(task):
    one, objective = task
    one.fit(*steered(1.5))
    for a in (-0.7, 0.2, 0.9):
        step = 1e-5
        ahead, behind = (objective.value(STATE, {"a": a + h}) for h in (step, -step))
        assert objective.gradient(STATE, {"a": a})["a"] == pytest.approx(
            (ahead - behind) / (2 * step), rel=1e-5, abs=1e-6
        )


def test_hessian_is_that_of_finite_differences(task):
    one, objective = task
    one.fit(*steered(1.5))
    step = 1e-6  # the error network has kinks, and none lies that near
    ahead, behind = (objective.gradient(STATE, {"a": 0.2 + h})["a"] for h in (step, -step))
    assert objective.hessian(STATE, {"a": 0.2})[0, 0] == pytest.approx(
        (ahead - behind) / (2 * step), rel=1e-3, abs=1e-3
    )


def test_compiled_and_interpreted_agree(task):
    one, objective = task
    one.fit(*steered(1.5))
    points = np.linspace(-1.0, 1.0, 7)[None]
    compiled = objective.evaluate(STATE, points)
    interpreted = sg.Objective(objective.tree, compiled=False).evaluate(STATE, points)
    for a, b in zip(compiled, interpreted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)


def test_model_takes_the_rule_of_a_network(fitted):
    assert sg.Model(fitted["none"], propagation="full").function.propagation == "full"
    assert fitted["none"].propagation == "auto"
    with pytest.raises(sg.GraphError, match=r"'network'.*'ful' is none of its options; did you mean 'full'\?"):
        sg.Model(fitted["none"], propagation="ful")


def test_rename_reads_and_writes(fitted):
    slots = {"hand": sg.State(2), "q": sg.State(), "u": sg.State(), "depth": sg.State()}
    graph = sg.Graph(slots, start="before")
    graph.edge("before", "after", sg.Model(fitted["none"], rename={"p": "hand", "v": "depth"}))
    graph.reward("after", lambda u, depth: u + depth)
    x = samples(1)[0][0]
    value = sg.Objective(sg.unroll(graph)).value({"hand": x[:2], "q": x[2]})
    assert value == pytest.approx(fitted["none"].predict(x)[0].sum(), rel=1e-10)


def test_views_share_the_weights_and_the_samples():
    one = network()
    view = one.with_propagation("diagonal")
    one.fit(*samples(10))
    assert view.samples == 10
    np.testing.assert_array_equal(view.predict(np.zeros(3))[0], one.predict(np.zeros(3))[0])


def test_pickled_network_predicts_and_plans_the_same(task):
    one, objective = task
    one.fit(*steered(1.5))
    copied_network, copied_objective = pickle.loads(pickle.dumps((one, objective)))
    x = steered(1.0)[0][:5]
    np.testing.assert_array_equal(copied_network.predict(x)[0], one.predict(x)[0])
    assert copied_objective.value(STATE, {"a": 0.3}) == pytest.approx(objective.value(STATE, {"a": 0.3}), rel=1e-12)


def test_predicting_needs_no_torch():
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "import numpy as np, symgraph as sg\n"
        "n = sg.learned.StochasticNetwork({'x': 1}, {'y': 1}, hidden=(4,))\n"
        "n.predict(np.zeros(1), np.eye(1))\n"
        "try:\n    n.fit(np.zeros((3, 1)), np.zeros((3, 1)))\n"
        "except sg.MissingExtraError as error:\n    print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pip install 'symgraph[learned]'" in done.stdout


# Refusals

X, Y = samples(4)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: StochasticNetwork({}, {"y": 1}), ["network: reads", "{label: number of elements}"]),
        (lambda: StochasticNetwork({"x": 0}, {"y": 1}), ["size of 'x' is 0", "positive whole number"]),
        (lambda: StochasticNetwork({"x": 1}, {"y": 1.5}), ["size of 'y' is 1.5"]),
        (lambda: StochasticNetwork({"x": 1}, {3: 1}), ["label 3 is not a name"]),
        (lambda: StochasticNetwork({"x": 1}, {"y": 1}, hidden=200), ["hidden = 200", "(200, 200)"]),
        (lambda: StochasticNetwork({"x": 1}, {"y": 1}, hidden=(5, -1)), ["hidden[1] is -1"]),
        (
            lambda: StochasticNetwork({"x": 1}, {"y": 1}, propagation="diagnal"),
            ["'diagnal'", "did you mean 'diagonal'?"],
        ),
        (
            lambda: StochasticNetwork({"x": 1}, {"y": 1}, error="mle"),
            ["error = 'mle'", "'likelihood', 'paper', 'none'"],
        ),
        (lambda: StochasticNetwork({"x": 1}, {"y": 1}, samples_needed=0), ["samples_needed is 0"]),
        (lambda: network(start="flat"), ["network: start = 'flat'", "'random', 'linear'"]),
        *(
            (lambda decay=decay: network(decay=decay), ["network: decay is", "give a number from 0 to 1e+12"])
            for decay in (-1.0, np.nan, np.inf, 1e39, "1", True, 1j, 10**400)
        ),
        (lambda: network(name="F").fit(X[:, :2], Y), ["F: x has shape (4, 2); give (N, 3)"]),
        (lambda: network(name="F").fit(X, Y[:3]), ["F: x has 4 rows, y 3"]),
        (lambda: network().fit(X * np.nan, Y), ["x[0] = [nan, nan, nan] is not finite; leave such rows out"]),
        (lambda: network().fit(X[:0], Y[:0]), ["x has no rows; give one per sample"]),
        (lambda: network().fit("abc", Y), ["network: x = 'abc' is not a number"]),
        (lambda: network().predict(np.zeros(2)), ["mean has shape (1, 2); give (N, 3)"]),
        (lambda: network().predict(np.zeros(3), np.eye(2)), ["covariance has shape (2, 2); give (3, 3)"]),
        (lambda: network().predict(np.zeros(3), "abc"), ["network: covariance = 'abc' is not a number"]),
        (lambda: network().predict(np.zeros(3), -np.eye(3)), ["has the negative eigenvalue -1"]),
        (lambda: network().predict(np.zeros(3), np.nan * np.eye(3)), ["not finite"]),
        (lambda: network().fit(X, Y, seed=-1), ["network: seed = -1; give a whole number"]),
        (lambda: network().fit(X, Y, seed=1.5), ["seed = 1.5"]),
        (lambda: network().fit(X, 1e200 * Y), ["beyond ±1e+100; leave such rows out"]),
        (
            lambda: graph_of(sg.Model(StochasticNetwork({"p": 1, "q": 2}, {"u": 1, "v": 1}))),
            ["reads 'p' with size 1, the slot has size 2"],
        ),
        (lambda: network().predict(np.zeros((5, 3)), np.zeros((4, 3, 3))), ["(3, 3) or (5, 3, 3)"]),
    ],
)
def test_refusals_name_place_value_and_remedy(make, words):
    with pytest.raises(sg.SymgraphError) as caught:
        make()
    for word in words:
        assert word in str(caught.value)


@settings(max_examples=25)
@given(
    n=st.integers(1, 3),
    m=st.integers(1, 2),
    count=st.integers(1, 12),
    scale=st.sampled_from([1e-9, 1.0, 1e9]),
    seed=st.integers(0, 99),
)
def test_any_finite_samples_give_finite_predictions(n, m, count, scale, seed):
    rng = np.random.default_rng(seed)
    x, y = scale * rng.standard_normal((count, n)).round(1), scale * rng.standard_normal((count, m)).round(1)
    one = StochasticNetwork({"x": n}, {"y": m}, hidden=(5,))
    one.fit(x, y)
    for array in (*one.predict(x), *one.predict(x, scale**2 * 0.1 * np.eye(n))):
        assert np.isfinite(array).all()
