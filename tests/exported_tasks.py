"""Tasks whose planners are written in C, with random situations: the paper's, pouring with networks of two sizes."""

from functools import cache

import numpy as np

import symgraph as sg
from models import cannon, pouring, push

SAMPLES = 40  # that a network is fitted to
SIZES = {"pouring 2x32": (32, 32), "pouring 3x200": (200, 200, 200)}


def _cannon():
    return sg.Objective(sg.unroll(cannon.graph())), ()


def _push():
    return sg.Objective(sg.unroll(push.graph())), ("first", "second")


def _toss():
    """A choice of how to toss, a network that says how far it flies, and a requirement."""
    rng = np.random.default_rng(0)
    network = sg.learned.StochasticNetwork(
        {"speed": 1, "angle": 1, "weight": 1}, {"distance": 1}, hidden=(8, 8), name="F_toss", propagation="diagonal"
    )
    x = rng.uniform((1.0, 0.2, 0.5), (4.0, 1.3, 2.0), (60, 3))
    y = x[:, :1] ** 2 / 9.81 * np.sin(2 * x[:, 1:2]) / x[:, 2:] + 0.02 * rng.normal(size=(60, 1))
    network.fit(x, y, progress=False)
    slots = {
        "speed": sg.Action(low=1.0, high=4.0, unit="m/s"),
        "angle": sg.State(unit="rad"),
        "arm": sg.Selection(["flat", "steep"]),
        "weight": sg.State(unit="kg"),
        "goal": sg.State(unit="m"),
        "distance": sg.State(unit="m"),
    }
    graph = sg.Graph(slots, start="held")
    angles = {"flat": lambda: {"angle": 0.4}, "steep": lambda: {"angle": 1.1}}
    graph.choose("held", "arm", {arm: ("aimed", angle) for arm, angle in angles.items()})
    graph.edge("aimed", "landed", network)
    graph.reward("landed", lambda distance, goal: -((distance - goal) ** 2))
    graph.require("landed", lambda distance: distance, low=0.1, confidence=0.9)
    return sg.Objective(sg.unroll(graph)), ("weight",)


def _pouring(hidden):
    """With networks that are fitted to what arbitrary smooth functions say: not the world's, but nothing is flat."""
    rng = np.random.default_rng(0)
    flow, release, amount = pouring.networks(hidden=hidden, decay=0.0, start="random", propagation="low-rank")
    for network in (*flow.values(), *release.values(), amount):
        n, m = sum(network.reads.values()), sum(network.writes.values())
        x = rng.uniform(0.0, 1.0, (SAMPLES, n))
        y = np.tanh(x @ rng.normal(size=(n, m)) / np.sqrt(n)) * 0.3 + 0.15 + 0.02 * rng.normal(size=(SAMPLES, m))
        network.fit(x, y, progress=False)
    return sg.Objective(sg.unroll(pouring.graph(flow, release, amount))), ("receiver_corners",)


MAKERS = {"cannon": _cannon, "push": _push, "toss": _toss} | {
    name: lambda h=hidden: _pouring(h) for name, hidden in SIZES.items()
}


@cache
def task(name):
    """The objective, and the start states that are uncertain."""
    return MAKERS[name]()


def situations(name, count, seed=0):
    """Random start states."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        if name == "cannon":
            yield cannon.state(rng.uniform(0.3, 2.9), rng.uniform(0.0, 0.6))
        elif name == "push":
            yield push.state(rng.uniform(0.2, 0.8, 2), rng.uniform(0.01, 0.1), rng.uniform(0.2, 0.8, 2), 0.05)
        elif name == "toss":
            yield {"weight": sg.Gaussian(rng.uniform(0.7, 1.8), sd=0.1), "goal": rng.uniform(0.2, 1.2)}
        else:
            x, y, rim = rng.uniform(0.6, 1.0), 0.2, rng.uniform(0.1, 0.3)
            corners = [(x + a, b, rim) for a in (0.15, -0.15) for b in (y, -y)]
            yield {
                "receiver_corners": sg.Gaussian(np.ravel(corners), sd=np.full(12, rng.uniform(0.002, 0.02))),
                "receiver_size": (0.3, 0.4, rim),
                "waypoint": (x - 0.3, rim + 0.35),
                "mouth": rng.uniform(0.1, 0.25),
                "material": rng.uniform(0.0, 1.0, 4),
                "target_change": rng.uniform(0.1, 0.5),
                "released": 0.0,
            }


def random_point(objective, rng):
    """Actions within the bounds and choices, at random."""
    actions = objective.unstack(rng.uniform(*objective.bounds))
    return actions, {label: str(rng.choice(slot.choices)) for label, slot in objective.graph.selections().items()}


def stacked(values):
    """{label: number or array} as one column."""
    return np.concatenate([np.zeros(0), *(np.ravel(value) for value in values.values())])
