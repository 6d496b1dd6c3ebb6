"""The objective against answers known in closed form."""

import casadi as ca
import numpy as np
import pytest

import symgraph as sg

EXACT = 1e-12  # relative to 1 + the largest number: sums of a few dozen products


def objective_of(graph, **options):
    return sg.Objective(sg.unroll(graph, **options), compiled=False)


def assert_exact(got, expected):
    np.testing.assert_allclose(got, expected, rtol=0, atol=EXACT * (1 + np.max(np.abs(expected))))


# A linear-Gaussian chain with a quadratic reward


class LinearGaussian:
    """x' = Ax + Bu + c + N(0, W), and -(x - r)'Q(x - r) at each visit."""

    def __init__(self, seed, size=3, controls=2):
        rng = np.random.default_rng(seed)
        self.A = 0.6 * rng.normal(size=(size, size))
        self.B = rng.normal(size=(size, controls))
        self.c, self.r, self.m = rng.normal(size=(3, size))
        roots = rng.normal(size=(3, size, size))
        self.Q, self.W, self.S = roots @ roots.transpose(0, 2, 1)

    def step(self, x, u):
        return {"x": ca.DM(self.A) @ x + ca.DM(self.B) @ u + ca.DM(self.c)}

    def score(self, x):
        error = x - ca.DM(self.r)
        return -(error.T @ ca.DM(self.Q) @ error)

    def value(self, controls):
        """Sum over t = 0..T of -(m - r)'Q(m - r) - tr(QS), with m <- Am + Bu + c and S <- ASA' + W."""
        m, s, total = self.m, self.S, 0.0
        for t in range(len(controls) + 1):
            total -= (m - self.r) @ self.Q @ (m - self.r) + np.trace(self.Q @ s)
            if t < len(controls):
                m, s = self.A @ m + self.B @ controls[t] + self.c, self.A @ s @ self.A.T + self.W
        return total

    def derivatives(self, controls):
        """Gradient and Hessian over all controls: dm_t / du_s = A^(t-1-s) B, and S depends on no control."""
        n, k = self.B.shape
        m, sensitivity = self.m, np.zeros((n, k * len(controls)))
        gradient, hessian = 0.0, 0.0
        for t in range(len(controls) + 1):
            gradient = gradient - 2 * sensitivity.T @ self.Q @ (m - self.r)
            hessian = hessian - 2 * sensitivity.T @ self.Q @ sensitivity
            if t < len(controls):
                m, sensitivity = self.A @ m + self.B @ controls[t] + self.c, self.A @ sensitivity
                sensitivity[:, k * t : k * (t + 1)] += self.B
        return gradient, hessian


@pytest.mark.parametrize("seed", range(5))
def test_linear_gaussian_chain(seed):
    system, horizon = LinearGaussian(seed), 5
    slots = {f"u{t}": sg.Action(2, low=-3, high=3) for t in range(horizon)}
    graph = sg.Graph({"x": sg.State(3), **slots}, start="n0")
    for t in range(horizon + 1):
        graph.reward(f"n{t}", system.score)
    for t in range(horizon):
        model = sg.Model(system.step, rename={"u": f"u{t}"}, noise={"x": system.W})
        graph.edge(f"n{t}", f"n{t + 1}", model)
    controls = np.random.default_rng([seed, 1]).normal(size=(horizon, 2))
    arguments = {"x": sg.Gaussian(system.m, system.S)}, {f"u{t}": controls[t] for t in range(horizon)}, {}

    objective = objective_of(graph)
    gradient, hessian = system.derivatives(controls)
    assert_exact(objective.value(*arguments), system.value(controls))
    got = objective.gradient(*arguments)
    assert_exact(np.concatenate([got[f"u{t}"] for t in range(horizon)]), gradient)
    assert_exact(objective.hessian(*arguments), hessian)


@pytest.mark.parametrize("max_visits", [1, 2, 4])
def test_linear_gaussian_loop_shares_one_control(max_visits):
    system, control = LinearGaussian(9), np.array([0.3, -0.8])
    graph = sg.Graph({"x": sg.State(3), "u": sg.Action(2, low=-3, high=3)}, start="here")
    graph.reward("here", system.score)
    graph.edge("here", "here", sg.Model(system.step, noise={"x": system.W}))
    arguments = {"x": sg.Gaussian(system.m, system.S)}, {"u": control}, {}

    objective = objective_of(graph, max_visits=max_visits)
    controls = [control] * (max_visits - 1)
    gradient, hessian = system.derivatives(controls)
    shared = np.tile(np.eye(2), (max_visits - 1, 1))  # du_t / du
    assert_exact(objective.value(*arguments), system.value(controls))
    assert_exact(objective.gradient(*arguments)["u"], shared.T @ gradient)
    assert_exact(objective.hessian(*arguments), shared.T @ hessian @ shared)


# A discounted Markov decision process


# A machine works or is down. After each step chance lets it go on with probability DISCOUNT, else everything
# ends. While the machine works, one is gentle or hard on it, which pays differently and lets it break more or
# less often; a machine that is down is repaired in one step.
# Source: M. L. Puterman, Markov Decision Processes, 1994: a discount is the probability of going on (section
# 5.3), and a stationary policy d is worth the solution of v = r_d + discount P_d v (theorem 6.1.1).
DISCOUNT = 0.8
PAY = {"gentle": 1.0, "hard": 1.6}
STAYS = {"gentle": 0.9, "hard": 0.35}
REPAIR = -2.0


def discounted_value(policy):
    """Of a working machine."""
    transitions = np.array([[STAYS[policy], 1 - STAYS[policy]], [1.0, 0.0]])
    return np.linalg.solve(np.eye(2) - DISCOUNT * transitions, [PAY[policy], REPAIR])[0]


def return_factor(policy):
    """E[DISCOUNT^time between two visits of `working`]."""
    return DISCOUNT * STAYS[policy] + DISCOUNT**2 * (1 - STAYS[policy])


def unrolled_value(policy, max_visits, cut_value=0.0):
    slots = {label: sg.State() for label in [*PAY, "repair"]}
    graph = sg.Graph({**slots, "policy": sg.Selection(list(PAY))}, start="working")

    def pay(node, label):
        graph.reward(node, sg.Model(lambda amount: amount, rename={"amount": label}))

    graph.choose("working", "policy", {policy: (f"{policy} use", None) for policy in PAY})
    for use, stays in STAYS.items():
        pay(f"{use} use", use)
        graph.chance(
            f"{use} use",
            {"works": ("working", None), "breaks": ("down", None), "ends": ("over", None)},
            {"works": DISCOUNT * stays, "breaks": DISCOUNT * (1 - stays), "ends": 1 - DISCOUNT},
        )
    pay("down", "repair")
    graph.chance(
        "down",
        {"repaired": ("working", None), "ends": ("over", None)},
        {"repaired": DISCOUNT, "ends": 1 - DISCOUNT},
    )
    objective = objective_of(graph, max_visits=max_visits, cut_value=cut_value)
    return objective.value({**PAY, "repair": REPAIR}, {}, {"policy": policy})


@pytest.mark.parametrize("policy", PAY)
def test_discounted_value_is_approached_geometrically(policy):
    """Only `working` can be cut first: the error after N visits is return_factor^N times its value."""
    value = discounted_value(policy)
    errors = [value - unrolled_value(policy, max_visits) for max_visits in (1, 2, 3, 4)]
    ratios = np.divide(errors[1:], errors[:-1])
    np.testing.assert_allclose(ratios, return_factor(policy), rtol=1e-10)
    assert errors[0] == pytest.approx(return_factor(policy) * value, rel=1e-12)


@pytest.mark.parametrize("policy", PAY)
@pytest.mark.parametrize("max_visits", [1, 3])
def test_a_cut_worth_the_discounted_value_leaves_no_error(policy, max_visits):
    value = discounted_value(policy)
    assert_exact(unrolled_value(policy, max_visits, cut_value=value), value)


# Martingales


def test_a_fair_game_is_worth_its_start_whatever_the_stake():
    """Of x +- stake after T rounds the mean is E[x], and the second moment grows by stake^2 a round."""
    rounds, stake, mean, variance = 5, 0.7, 1.3, 0.4
    slots = {"x": sg.State(), "stake": sg.Action(low=0, high=1)}

    def play(reward):
        graph = sg.Graph(slots, start="round 0")
        for t in range(rounds):
            ways = {
                "won": (f"round {t + 1}", lambda x, stake: {"x": x + stake}),
                "lost": (f"round {t + 1}", lambda x, stake: {"x": x - stake}),
            }
            graph.chance(f"round {t}", ways, {"won": 0.5, "lost": 0.5})
        graph.reward(f"round {rounds}", reward)
        objective = objective_of(graph)
        arguments = {"x": sg.Gaussian(mean, variance)}, {"stake": stake}, {}
        return [
            objective.value(*arguments),
            objective.gradient(*arguments)["stake"],
            *objective.hessian(*arguments),
        ]

    assert_exact(np.hstack(play(lambda x: x)), [mean, 0.0, 0.0])
    squares = [mean**2 + variance + rounds * stake**2, 2 * rounds * stake, 2 * rounds]
    assert_exact(np.hstack(play(lambda x: x**2)), squares)


@pytest.mark.parametrize("max_visits", [1, 3, 6])
def test_de_moivres_martingale_under_modelled_probabilities(max_visits):
    """Where x goes up with probability p and else down, the mean of ((1 - p) / p)^x never changes.

    Every visit stops the walk with probability 0.2, whatever x is, and pays the martingale; a cut is worth 0.
    Source: R. Durrett, Probability: Theory and Examples, 2010, asymmetric simple random walk.
    """
    win, x0 = 0.6, 2.0
    slots = {"x": sg.State(), "win": sg.Action(low=0.1, high=0.9)}
    graph = sg.Graph(slots, start="play")

    def step(win):
        return {"up": 0.8 * win, "down": 0.8 * (1 - win), "stop": 0.2}

    def martingale(x, win):
        return ((1 - win) / win) ** x

    up, down = (lambda x: {"x": x + 1}), (lambda x: {"x": x - 1})
    graph.chance("play", {"up": ("play", up), "down": ("play", down), "stop": ("stopped", None)}, step)
    graph.reward("stopped", martingale)
    objective = objective_of(graph, max_visits=max_visits)
    stopped = 1 - 0.8**max_visits
    base = (1 - win) / win
    arguments = {"x": x0}, {"win": win}, {}
    assert_exact(objective.value(*arguments), stopped * base**x0)
    assert_exact(objective.gradient(*arguments)["win"], -stopped * x0 * base ** (x0 - 1) / win**2)


# Single rules


def pair_objective(first, second):
    """E[(a - b)^2] where a and b are read from these two slots, both copies of x."""
    graph = sg.Graph({"x": sg.State(), "y": sg.State(), "z": sg.State()}, start="copy")
    graph.edge("copy", "compare", lambda x: {"y": x, "z": x})
    graph.reward("compare", sg.Model(lambda a, b: (a - b) ** 2, rename={"a": first, "b": second}))
    return objective_of(graph).value({"x": sg.Gaussian(1.0, 0.3)}, {}, {})


def test_slots_are_independent_even_where_one_is_a_copy():
    assert_exact(pair_objective("y", "z"), 0.6)
    assert_exact(pair_objective("x", "y"), 0.6)


def test_one_slot_under_two_names_is_one_slot():
    assert_exact(pair_objective("x", "x"), 0.0)


def test_groups_add_and_branches_are_weighted():
    slots = {"x": sg.State(), "p": sg.Action(low=0, high=1)}
    graph = sg.Graph(slots, start="here")
    graph.reward("here", lambda x: x)
    graph.reward("here", lambda x: 10 * x)
    branches = {"hit": ("paid", None), "miss": ("over", None)}
    graph.chance("here", branches, lambda p: {"hit": p**2, "miss": 1 - p**2})
    graph.reward("paid", lambda x: 100 * x)
    objective = objective_of(graph)
    arguments = {"x": 2.0}, {"p": 0.3}, {}
    assert_exact(objective.value(*arguments), 22 + 0.09 * 200)
    assert_exact(objective.gradient(*arguments)["p"], 0.6 * 200)


def test_gradient_follows_the_action_through_the_variance():
    """x ~ N(0, 1), y = a x: E[-(y - 1)^2] = -1 - a^2, although the mean of y never moves."""
    graph = sg.Graph({"x": sg.State(), "y": sg.State(), "a": sg.Action(low=-1, high=1)}, start="scale")
    graph.edge("scale", "scored", lambda a, x: {"y": a * x})
    graph.reward("scored", lambda y: -((y - 1) ** 2))
    objective = objective_of(graph)
    arguments = {"x": sg.Gaussian(0.0, 1.0)}, {"a": 0.7}, {}
    assert_exact(objective.value(*arguments), -1.49)
    assert_exact(objective.gradient(*arguments)["a"], -1.4)
    assert_exact(objective.hessian(*arguments), [[-2.0]])


def test_default_propagation_of_edge_probability_and_reward():
    """x ~ N(m, s): an edge and a probability see x^2 at the mean, a reward its expectation."""
    m, s = 0.5, 0.04
    graph = sg.Graph({"x": sg.State(), "y": sg.State()}, start="here")
    graph.edge("here", "squared", lambda x: {"y": x**2})
    graph.reward("squared", lambda y: y)
    graph.chance("here", {"hit": ("paid", None), "miss": ("over", None)}, lambda x: {"hit": x**2, "miss": 1 - x**2})
    graph.reward("paid", lambda x: 10 * x)
    graph.reward("here", lambda x: 100 * x**2)
    expected = m**2 + m**2 * 10 * m + 100 * (m**2 + s)
    assert_exact(objective_of(graph).value({"x": sg.Gaussian(m, s)}, {}, {}), expected)
