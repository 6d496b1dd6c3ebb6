"""Graphs as they are built: what is refused, and what they hold."""

import numpy as np
import pytest
from small_tasks import objective_of, refuses

import symgraph as sg

NAN = float("nan")

SLOTS = {
    "x": sg.State(),
    "u": sg.Action(low=-1, high=1),
    "tool": sg.Selection(["tip", "shake"]),
}


def graph():
    """A graph that holds one group of each kind."""
    g = sg.Graph(SLOTS, "start")
    g.edge("start", "middle")
    g.choose("middle", "tool", {"tip": ("end", None), "shake": ("end", None)})
    g.chance("end", {"up": ("top", None), "down": ("bottom", None)}, {"up": 0.25, "down": 0.75})
    g.reward("top", lambda x: x)
    return g


def choose(choices, selection="tool", source="n"):
    return lambda g: g.choose(source, selection, choices)


def chance(probability, branches=None):
    return lambda g: g.chance("n", branches or {"up": ("top", None), "down": ("bottom", None)}, probability)


BOTH = {"tip": ("a", None), "shake": ("b", None)}

REFUSED = {
    "source": (lambda g: g.edge("", "b"), ["source is ''", "non-empty strings"]),
    "source of a reward": (lambda g: g.reward(None, lambda x: x), ["source is None", "nodes are named"]),
    "target": (lambda g: g.edge("a", 3), ["target is 3", "nodes are named"]),
    "edge's model": (lambda g: g.edge("a", "b", 3), ["edge 'a' → 'b'", "3 is not a model"]),
    "edge's slots": (lambda g: g.edge("a", "b", lambda y: {}), ["edge 'a' → 'b'", "'y'", "Slots: 'x', 'u', 'tool'"]),
    "selection misspelt": (
        choose(BOTH, "tol"),
        ["node 'n'", "selection 'tol' is not a slot", "did you mean 'tool'?", "Selections: 'tool'"],
    ),
    "selection is no name": (choose(BOTH, ["tool"]), ["selection ['tool'] is not a slot", "Selections: 'tool'"]),
    "selection is nothing": (choose(BOTH, None), ["selection None is not a slot"]),
    "selection is a state": (choose(BOTH, "x"), ["'x' is State(size=1", "not a Selection"]),
    "choice misspelt": (
        choose({"tip": ("a", None), "shaek": ("b", None)}),
        ["'shaek' is not a choice of 'tool'", "did you mean 'shake'?", "Choices: 'tip', 'shake'"],
    ),
    "choice missing": (choose({"tip": ("a", None)}), ["choice 'shake' of 'tool' is missing", "'tip', 'shake'"]),
    "choices not a mapping": (choose(["tip", "shake"]), ["{choice: (target, model)}", "['tip', 'shake']"]),
    "choice without a model": (choose({**BOTH, "tip": "a"}), ["choice 'tip'", "give (target, model), got 'a'"]),
    "choice's target": (choose({**BOTH, "tip": (None, None)}), ["choice 'tip': target is None"]),
    "choice's model": (choose({**BOTH, "tip": ("a", lambda y: {})}), ["node 'n', choice 'tip': model", "reads 'y'"]),
    "branch's model": (
        chance({"up": 1, "down": 0}, {"up": ("a", lambda y: {}), "down": ("b", None)}),
        ["node 'n', branch 'up': model", "reads 'y'"],
    ),
    "branch without a model": (chance({}, {"up": "a"}), ["branch 'up'", "give (target, model), got 'a'"]),
    "no branches": (lambda g: g.chance("n", {}, {}), ["chance has no branches", "at least one"]),
    "negative": (chance({"up": -0.1, "down": 1.1}), ["probability of 'up' is -0.1", "[0, 1]"]),
    "above one": (chance({"up": 1.5, "down": -0.5}), ["probability of 'up' is 1.5", "[0, 1]"]),
    "sum": (chance({"up": 0.5, "down": 0.4}), ["'up', 'down' sum to 0.9", "must sum to 1"]),
    "nearly one": (chance({"up": 0.5, "down": 0.5 + 1e-6}), ["sum to 1.000001"]),
    "nan": (chance({"up": NAN, "down": 1}), ["probability of 'up' is nan"]),
    "words": (chance({"up": "often", "down": 1}), ["probability of 'up' is 'often'", "give a number"]),
    "nothing": (chance({"up": None, "down": 1}), ["probability of 'up' is None", "give a number"]),
    "one missing": (chance({"up": 1}), ["branch 'down' has no probability", "'up', 'down'"]),
    "one misspelt": (
        chance({"up": 0.5, "dwn": 0.5}),
        ["probability names 'dwn'", "no branch", "did you mean 'down'?", "Branches: 'up', 'down'"],
    ),
    "a number": (chance(0.5), ["probability = 0.5", "{branch: number}", "model"]),
    "a list": (chance([0.5, 0.5]), ["probability = [0.5, 0.5]", "{branch: number}"]),
    "no reward": (lambda g: g.reward("n", 1.0), ["node 'n', reward", "1.0 is not a model"]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_and_left_as_it_was(case):
    call, words = REFUSED[case]
    g = graph()
    groups = {source: list(found) for source, found in g.groups.items()}
    before = g.nodes, groups, g.diagram()
    refuses(lambda: call(g), sg.GraphError, *words)
    assert (g.nodes, {source: list(found) for source, found in g.groups.items()}, g.diagram()) == before


REFUSED_GRAPHS = {
    "list": (lambda: sg.Graph(["x"], "n"), ["slots is ['x']", "{label: State, Action or Selection}"]),
    "no slot": (lambda: sg.Graph({"x": 3}, "n"), ["slot 'x' is 3", "State(…)"]),
    "a class": (lambda: sg.Graph({"x": sg.State}, "n"), ["slot 'x' is <class", "State(…)"]),
    "number": (lambda: sg.Graph({3: sg.State()}, "n"), ["slot label 3 is not a name"]),
    "empty": (lambda: sg.Graph({"": sg.State()}, "n"), ["slot label '' is not a name"]),
    "start": (lambda: sg.Graph({}, ""), ["start is ''"]),
    "no start": (lambda: sg.Graph({}, None), ["start is None"]),
}


@pytest.mark.parametrize("case", REFUSED_GRAPHS)
def test_no_graph(case):
    call, words = REFUSED_GRAPHS[case]
    refuses(call, sg.GraphError, *words)


def test_unreachable_node():
    g = graph()
    g.edge("mddle", "end")
    refuses(
        g.check_reachable,
        sg.GraphError,
        "node 'mddle' cannot be reached from the start 'start'",
        "did you mean 'middle'?",
        "Reached: 'start', 'middle', 'end'",
    )


def test_loops_and_self_loops_are_reachable():
    g = graph()
    g.edge("top", "start")
    g.edge("top", "top")
    g.check_reachable()


def test_nodes_stand_in_the_order_in_which_they_are_named():
    assert graph().nodes == ["start", "middle", "end", "top", "bottom"]
    g = sg.Graph({}, "last")
    g.edge("first", "second")
    g.edge("second", "last")
    assert g.nodes == ["last", "first", "second"]


def test_slots_by_kind():
    g = graph()
    assert list(g.states()) == ["x"]
    assert list(g.actions()) == ["u"]
    assert list(g.selections()) == ["tool"]
    assert "3 slots, 5 nodes, start 'start'" in repr(g)


def test_slots_are_copied():
    slots = dict(SLOTS)
    g = sg.Graph(slots, "n")
    slots.clear()
    assert list(g.slots) == list(SLOTS)


def test_each_call_adds_a_group():
    g = graph()
    g.edge("start", "middle")
    g.reward("start", lambda x: x)
    assert [group.kind for group in g.groups["start"]] == ["edge", "edge", "reward"]
    choose_group, chance_group = g.groups["middle"][0], g.groups["end"][0]
    assert [branch.label for branch in choose_group.branches] == ["tip", "shake"]
    assert chance_group.probability == (0.25, 0.75)


def test_probabilities_follow_the_branches_whatever_their_order():
    g = sg.Graph(SLOTS, "n")
    g.chance("n", {"up": ("top", None), "down": ("bottom", None)}, {"down": 0.7, "up": 0.3})
    assert g.groups["n"][0].probability == (0.3, 0.7)


@pytest.mark.parametrize("shares", [[0.1] * 10, [1 / 3] * 3, [1 / 7] * 7, [np.float32(0.5)] * 2, [1, 0], [True, False]])
def test_probabilities_may_be_rounded(shares):
    g = sg.Graph(SLOTS, "n")
    branches = {f"b{i}": (f"t{i}", None) for i in range(len(shares))}
    g.chance("n", branches, {f"b{i}": share for i, share in enumerate(shares)})
    assert sum(g.groups["n"][0].probability) == pytest.approx(1)


def test_choices_may_be_written_in_any_order():
    def values(order):
        g = sg.Graph(SLOTS, "n")
        g.choose("n", "tool", {choice: (choice, None) for choice in order})
        g.reward("tip", lambda x: x)
        g.reward("shake", lambda x: 10 * x)
        objective = objective_of(g)
        return [objective.value({"x": 2}, {"u": 0}, {"tool": tool}) for tool in ("tip", "shake")]

    assert values(["tip", "shake"]) == values(["shake", "tip"]) == [2, 20]


def test_the_picture_shows_nodes_rewards_and_what_is_on_the_edges():
    g = sg.Graph(SLOTS, "a")

    def move(x, u):
        return {"x": x + u}

    def score(x):
        return x

    g.choose("a", "tool", {"tip": ("b", move), "shake": ("b", None)})
    g.chance("b", {"up": ("c", move), "down": ("a", None)}, {"up": 0.25, "down": 0.75})
    g.chance("b", {"in": ("c", None)}, lambda: {"in": 1})
    g.reward("c", score)
    diagram = g.diagram()
    assert [(node.lines[0], node.kind) for node in diagram.nodes] == [
        ("a", "start"),
        ("b", "node"),
        ("c", "node"),
        ("score", "reward"),
    ]
    assert [(edge.label, edge.weight) for edge in diagram.edges] == [
        ("tool = tip: move", None),
        ("tool = shake", None),
        ("up: move", 0.25),
        ("down", 0.75),
        ("in", None),
        ("", None),
    ]
    assert g._repr_svg_().lstrip().startswith(("<svg", "<?xml"))
