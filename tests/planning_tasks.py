"""Tasks with start states, to evaluate in compiled kernels: the models, with small networks, and random ones."""

from functools import cache

import numpy as np
from random_tasks import random_problem, to_symgraph

import symgraph as sg
from models import cannon, pouring, push

RECEIVER = (0.8, 0.2)  # its x, the height of its rim


def _cannon():
    return sg.Objective(sg.unroll(cannon.graph())), cannon.state(2.0)


def _push():
    graph = push.graph(sg.Model(push.push, propagation="quadrature"))
    return sg.Objective(sg.unroll(graph)), push.state((0.3, 0.1), 0.1, (-0.2, 0.3), 0.2)


def _pouring():
    """With networks that are small, and have arbitrary weights."""
    rng = np.random.default_rng(0)
    flow, release, amount = pouring.networks(hidden=(6,))
    for network in (*flow.values(), *release.values(), amount):
        for parameter in network.parameters:
            parameter.value = parameter.value + 0.3 * rng.normal(size=parameter.value.shape)
    corners = [(RECEIVER[0] + x, y, RECEIVER[1]) for x in (0.15, -0.15) for y in (0.2, -0.2)]
    state = {
        "receiver_corners": sg.Gaussian(np.ravel(corners), sd=np.full(12, 0.01)),
        "receiver_size": (0.3, 0.4, RECEIVER[1]),
        "waypoint": (RECEIVER[0] - 0.3, RECEIVER[1] + 0.35),
        "mouth": 0.2,
        "material": np.zeros(4),
        "target_change": 0.28,
        "released": 0.0,
    }
    return sg.Objective(sg.unroll(pouring.graph(flow, release, amount))), state


def _random(seed):
    problem = random_problem(seed)
    graph, options, (state, _, _) = to_symgraph(problem)
    return sg.Objective(sg.unroll(graph, **options)), state


MAKERS = {
    "cannon": _cannon,
    "push": _push,
    "pouring": _pouring,
    "random 3": lambda: _random(3),
    "random 120": lambda: _random(120),
}


@cache
def task(name):
    """The objective and a start state."""
    return MAKERS[name]()


def points_of(objective, count, seed=0):
    """Actions (count, n) within the bounds, and selections (count, m) at random."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(*objective.bounds, (count, objective.n_actions))
    slots = objective.graph.selections().values()
    chosen = [np.eye(slot.size)[rng.integers(0, slot.size, count)] for slot in slots]
    return points, np.hstack([np.zeros((count, 0)), *chosen])
