"""Toy worlds, their graphs and a model that tells what it was taught, for the tests of the on-line loop."""

import json
from pathlib import Path

import casadi as ca
import numpy as np

import symgraph as sg
from symgraph.learned import Exploration, OnlineLoop, Stage, StochasticNetwork

QUICK = sg.Lbfgs(starts=4, iterations=50)
NOTHING = Exploration(episodes=0)
ALWAYS = 1e9  # episodes after which nothing is explored: the same share in each of a few hundred


def kick(skill, u, s):
    """What the world does: "near" cannot overshoot, "far" is worse the larger s is."""
    return 0.6 * u + 0.3 * s if skill == "near" else 1.5 * u - s


def best(s):
    """The largest return of a kick: the ball should come to 1."""
    return max(-((min(1.0, kick(skill, 1.0, s)) - 1.0) ** 2) for skill in ("near", "far"))


class Spy:
    """A linear model of one output that can be fitted as the loop wants it, and tells what it was fitted to."""

    def __init__(self, reads, writes, name, weights=None):
        self.reads, self.writes, self.name = reads, writes, name
        size = sum(reads.values())
        self._weights = sg.Parameter(np.ones(size) if weights is None else weights, name)
        self.parameters = (self._weights,)
        self.samples = 0
        self.lacking = None
        self.settings = {"reads": reads, "writes": writes}
        self.fits = []  # (x, y, seed)

    def propagate(self, inputs):
        total = sum(
            self._weights.symbol[start : start + size].T @ inputs[label].mean
            for (label, size), start in zip(self.reads.items(), np.cumsum([0, *self.reads.values()]), strict=False)
        )
        return {label: sg.Gaussian(ca.repmat(total, size, 1)) for label, size in self.writes.items()}

    def fit(self, x, y, *, seed, progress):
        self.fits.append((x, y, seed))
        self.samples = len(x)

    def save(self, path):
        Path(path).write_text(json.dumps(self.samples))

    def restore(self, path):
        self.samples = json.loads(Path(path).read_text())


class Scripted:
    """A world whose nodes are functions (actions, selections, world) → {target: observed}; keeps what was asked of it.

    Args:
        start: observed at the start: a mapping, or a function of the seed.
        nodes: {node: function}, or {node: what it returns}.
    """

    def __init__(self, start, nodes):
        self.start, self.nodes = start, nodes
        self.calls = []  # (node, actions, selections) of all episodes
        self.seeds = []

    def reset(self, seed):
        self.seeds.append(seed)
        return self.start(seed) if callable(self.start) else self.start

    def execute(self, node, actions, selections):
        self.calls.append((node, dict(actions), dict(selections)))
        given = self.nodes[node]
        return given(actions, selections, self) if callable(given) else given

    def close(self):
        pass


def uniform_start(seed):
    return {"s": float(np.random.default_rng(seed).uniform())}


def kicking(start=uniform_start):
    """The world of `kick_graph`."""
    return Scripted(start, {"aim": lambda a, s, world: kicked(a, s, world)})


def kicked(actions, selections, world):
    """Kick in a world that knows its latest seed."""
    s = uniform_start(world.seeds[-1])["s"]
    return {f"{selections['skill']}_end": {"y": kick(selections["skill"], actions["u"], s)}}


def kick_slots(**more):
    slots = {"u": sg.Action(low=-1.0, high=1.0), "skill": sg.Selection(["near", "far"])}
    return slots | {"s": sg.State(), "y": sg.State(), **more}


def kick_graph(near=None, far=None, reward=lambda y: -((y - 1.0) ** 2), **more):
    """Aim, choose a skill, and be paid for where the ball stops; the skills' models are learned."""
    graph = sg.Graph(kick_slots(**more), start="aim")
    near = near or Spy({"u": 1, "s": 1}, {"y": 1}, "near", [0.6, 0.3])
    far = far or Spy({"u": 1, "s": 1}, {"y": 1}, "far", [1.5, -1.0])
    graph.choose("aim", "skill", {"near": ("near_end", near), "far": ("far_end", far)})
    for node in ("near_end", "far_end"):
        graph.reward(node, reward)
    return graph


def carry_graph(reward=lambda y: -((y - 0.5) ** 2)):
    """Take a thing with a hand, move it, throw it; what lies behind a node has no part in what follows it."""
    slots = {"grip": sg.Action(low=0.0, high=1.0), "throw": sg.Action(2, low=-1.0, high=1.0)}
    slots |= {"hand": sg.Selection(["left", "right"]), "way": sg.Selection(["high", "low"])}
    slots |= {"weight": sg.State(), "held": sg.State(), "y": sg.State()}
    graph = sg.Graph(slots, start="seen")

    def hold(grip):
        return {"held": grip}

    graph.choose("seen", "hand", {"left": ("taken", hold), "right": ("taken", hold)})
    graph.edge("taken", "lifted")
    fly = Spy({"throw": 2, "weight": 1}, {"y": 1}, "fly", [1.0, 1.0, -1.0])
    graph.choose("lifted", "way", {"high": ("thrown", fly), "low": ("rolled", None)})
    graph.reward("taken", lambda held, hand: -((held - 0.7) ** 2) - 0.5 * hand[0])
    graph.reward("thrown", reward)
    graph.reward("rolled", lambda weight: -1.0 - weight**2)
    return graph


def carrying(weight=0.5):
    """The world of `carry_graph`, in which a thing turns out to be lighter once it is lifted."""
    return Scripted(
        {"weight": weight},
        {
            "seen": lambda actions, selections, world: {"taken": {"held": actions["grip"]}},
            "taken": {"lifted": {"weight": -0.5}},
            "lifted": lambda actions, selections, world: (
                {"thrown": {"y": float(actions["throw"].sum()) + 0.5}}
                if selections["way"] == "high"
                else {"rolled": {}}
            ),
            "thrown": {"taken": {"weight": 0.25}},
            "rolled": {"taken": {"weight": 0.25}},
        },
    )


def networks(hidden=(16,), **options):
    return [StochasticNetwork({"u": 1, "s": 1}, {"y": 1}, hidden, name=name, **options) for name in ("near", "far")]


def loop(folder, graph, world, episodes=3, explore=NOTHING, given=None, **options):
    """A loop of one stage."""
    options = {"optimizer": QUICK} | options
    return OnlineLoop(graph, [Stage("toy", world, episodes, explore, given or {})], folder, **options)


def told(store):
    """All that a store holds, but for times."""
    episodes = [
        (e.number, e.setup, e.seed, e.status, e.reason, e.total, e.info, list(e.seconds)) for e in store.episodes()
    ]
    return episodes, store.visits(), [store.plans(number) for number, *_ in episodes]
