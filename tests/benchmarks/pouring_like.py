"""A task with the shape of pouring in eight actions, to time gradients on: six edges, then a fork into two skills.

Everything is exact up to 18 features, Gaussians that are independent of each other. From there networks propagate
Gaussians by the diagonal rule: flow_tip or flow_shake, each with probability 1/2, so that both count, and then one
amount for both.
There are no units, and no sense in the numbers beyond their sizes: all are near 1, and nothing saturates.
"""

import itertools
import math

import casadi as ca
import numpy as np

import symgraph as sg

SKILLS = ("tip", "shake")
FEATURES, CONTEXT, FLOW, AMOUNTS = 18, 2, 8, 4
READS = {"flow_tip": FEATURES, "flow_shake": FEATURES, "amount": FLOW + CONTEXT}  # elements
WRITES = {"flow_tip": FLOW, "flow_shake": FLOW, "amount": AMOUNTS}
ERROR_SCALE = 0.1  # of σ

state = {"x": np.random.default_rng(1).normal(0.0, 0.5, 16)}


def points(count, seed=0):
    """Return actions (count, 8), a row per point."""
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (count, 8))


def weights(hidden, seed=0):
    """Return {network: {"mean": layers, "error": layers, "scale": (m,)}}, layers a list of W (out, in), b (out,)."""
    rng = np.random.default_rng(seed)

    def layers(sizes, scale):
        return [
            (rng.normal(0.0, scale * math.sqrt(2 / n), (m, n)), rng.normal(0.0, 0.1, m))
            for n, m in itertools.pairwise(sizes)
        ]

    made = {}
    for name, inputs in READS.items():
        sizes = (inputs, *hidden, WRITES[name])
        made[name] = {
            "mean": layers(sizes, 1.0),
            "error": layers(sizes, 0.5),
            "scale": np.full(WRITES[name], ERROR_SCALE),
        }
    return made


def prepared(weights):
    """Return the layers with what variances need, computed once for many points: W (out, in), V = W², b (out,).

    The context, which amount reads last, is exact: there V has no columns for it.
    """
    made = {}
    for name, given in weights.items():
        made[name] = {part: [(w, w * w, b) for w, b in given[part]] for part in ("mean", "error")}
        made[name]["square_scale"] = given["scale"] ** 2
    for part in ("mean", "error"):
        w, v, b = made["amount"][part][0]
        made["amount"][part][0] = (w, np.ascontiguousarray(v[:, :FLOW]), b)
    return made


def labels(name, count):
    return {f"{name}{i}": 1 for i in range(count)}


def networks(hidden):
    """Return {name: StochasticNetwork} that hold these weights."""
    made, rng = {}, np.random.default_rng(2)
    for name, given in weights(hidden).items():
        reads = {**labels("flow", FLOW), "context": CONTEXT} if name == "amount" else labels("feature", FEATURES)
        writes = labels("amount", AMOUNTS) if name == "amount" else labels("flow", FLOW)
        network = sg.learned.StochasticNetwork(reads, writes, hidden, propagation="diagonal", name=name)
        inputs, outputs = rng.normal(size=(3, READS[name])), rng.normal(size=(3, WRITES[name]))
        network.fit(inputs, outputs, progress=False)  # with less than three samples plans would explore
        numbers = [array for part in ("mean", "error") for layer in given[part] for array in layer]
        for parameter, value in zip(network.parameters, [*numbers, given["scale"]], strict=True):
            parameter.value = value
        made[name] = network
    return made


def grasp(a0, a1, x):
    return {"g": ca.vertcat(ca.tanh(a0) * x[0] + x[1], a1 * x[2] - 0.1 * a0**2)}


def move(a2, a3, g, x):
    return {"p": ca.vertcat(x[3] + ca.sin(a2) * g[0], x[4] + ca.cos(a2) * g[1], x[5] + a3 * x[6])}


def measure(p, x):
    return {"d": ca.sqrt((p[0] - x[7]) ** 2 + (p[1] - x[8]) ** 2 + 1e-4)}


def lift(a4, a5, p, d):
    return {"l": ca.vertcat(p[0] + 0.3 * a4 * d, p[2] - 0.2 * a5 * d)}


def aim(p, l):
    return {"q": ca.exp(-0.5 * (l[0] ** 2 + l[1] ** 2)), "th": ca.atan2(p[1], 1 + p[0] ** 2)}


def turn(a6, a7, l, q, th, x):
    u = ca.vertcat(a6 * q + th, a7 * (1 - q))
    f = ca.vertcat(ca.tanh(u[0] + l[0]), ca.tanh(u[1] - l[1]))
    return {"u": u, "f": f, "context": ca.vertcat(f[0], x[13])}


def effort_of_arm(a0, a1, a2, a3):
    return -0.05 * (a0**2 + a1**2 + a2**2 + a3**2)


def effort_of_wrist(a4, a5, d):
    return -0.02 * (a4**2 + a5**2) - 0.05 * d**2


class Observation:
    """What the networks read: the numbers so far with a variance of 0.01 + 0.02 mean²."""

    name = "observation"
    reads = ("g", "p", "d", "l", "q", "th", "u", "f", "x")
    writes = tuple(labels("feature", FEATURES))

    def propagate(self, inputs):
        *columns, x = (inputs[label].mean for label in self.reads)
        mean = ca.vertcat(*columns, x[9:13])
        return {
            label: sg.Gaussian(one, 0.01 + 0.02 * one**2)
            for label, one in zip(self.writes, ca.vertsplit(mean), strict=True)
        }


class AmountReward:
    """E of -10 max(0, x14 - y0)² - max(0, y0 - x14)² - 3 max(0, y1)² - 0.01 y2², y the amounts."""

    name = "amount_reward"
    reads = (*labels("amount", AMOUNTS), "x")
    writes = ("reward",)

    def propagate(self, inputs):
        y, v = zip(*((inputs[label].mean, inputs[label].covariance) for label in self.reads[:-1]), strict=True)
        target = inputs["x"].mean[14]
        loss = 10 * _square_above_zero(target - y[0], v[0]) + _square_above_zero(y[0] - target, v[0])
        loss += 3 * _square_above_zero(y[1], v[1]) + 0.01 * (y[2] ** 2 + v[2])
        return {"reward": sg.Gaussian(-loss, ca.MX(1, 1))}


def _square_above_zero(mean, variance):
    """E[max(0, X)²] = (m² + s²) Φ(m/s) + m s φ(m/s) for X ~ N(m, s²)."""
    sd = ca.sqrt(variance + 1e-16)
    z = mean / sd
    below = (1 + ca.erf(z / math.sqrt(2))) / 2
    return (mean**2 + variance) * below + mean * sd * ca.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)


def graph(hidden):
    actions = {f"a{i}": sg.Action(low=-1.5, high=1.5) for i in range(8)}
    sizes = {"x": 16, "g": 2, "p": 3, "d": 1, "l": 2, "q": 1, "th": 1, "u": 2, "f": 2}
    sizes |= {"context": CONTEXT, **labels("feature", FEATURES), **labels("flow", FLOW), **labels("amount", AMOUNTS)}
    graph = sg.Graph(actions | {label: sg.State(size) for label, size in sizes.items()}, start="start")
    network = networks(hidden)
    graph.edge("start", "grasped", grasp)
    graph.edge("grasped", "moved", move)
    graph.reward("moved", effort_of_arm)
    graph.edge("moved", "measured", measure)
    graph.edge("measured", "lifted", lift)
    graph.reward("lifted", effort_of_wrist)
    graph.edge("lifted", "aimed", aim)
    graph.edge("aimed", "turned", turn)
    graph.edge("turned", "ready", Observation())
    graph.chance("ready", {skill: (skill, network[f"flow_{skill}"]) for skill in SKILLS}, dict.fromkeys(SKILLS, 0.5))
    for skill in SKILLS:
        graph.edge(skill, "poured", network["amount"])
    graph.reward("poured", AmountReward())
    return graph


def objective(hidden, **options):
    """Return the Objective, whose stacked actions are a0 to a7."""
    return sg.Objective(sg.unroll(graph(hidden)), **options)
