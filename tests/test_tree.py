"""Trees: breadth-first unrolling, visits per path, and what the selections decided."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_tasks import refuses

import symgraph as sg
from symgraph import tree as tree_module

SLOTS = {
    "x": sg.State(),
    "y": sg.State(),
    "z": sg.State(),
    "u": sg.Action(low=-1, high=1),
    "first": sg.Selection(["a", "b"]),
    "second": sg.Selection(["a", "b", "c"]),
}


def graph(start="n"):
    return sg.Graph(SLOTS, start)


def loop():
    g = graph()
    g.edge("n", "n")
    return g


def paths(tree):
    return [tree.path(node.index) for node in tree.nodes]


def lost():
    g = loop()
    g.edge("elsewhere", "n")
    return g


REFUSED = {
    "visits 0": (lambda: sg.unroll(loop(), max_visits=0), ["max_visits = 0", "at least 1"]),
    "visits 1.5": (lambda: sg.unroll(loop(), max_visits=1.5), ["max_visits = 1.5", "whole number"]),
    "visits True": (lambda: sg.unroll(loop(), max_visits=True), ["max_visits = True"]),
    "cut nan": (lambda: sg.unroll(loop(), cut_value=float("nan")), ["cut_value = nan", "finite"]),
    "cut infinite": (lambda: sg.unroll(loop(), cut_value=float("-inf")), ["cut_value = -inf", "finite"]),
    "cut words": (lambda: sg.unroll(loop(), cut_value="low"), ["cut_value = 'low'"]),
    "start": (
        lambda: sg.unroll(graph("nn")),
        ["start node 'nn' is in no edge, choose, chance, reward or requirement", "Nodes: (none)"],
    ),
    "misspelt": (
        lambda: sg.unroll(loop(), start="nn"),
        ["start node 'nn'", "did you mean 'n'?", "Nodes: 'n'"],
    ),
    "unreachable": (lambda: sg.unroll(lost()), ["node 'elsewhere' cannot be reached from the start 'n'"]),
    "no graph": (lambda: sg.unroll("graph"), ["unroll takes a Graph", "str"]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case):
    call, words = REFUSED[case]
    refuses(call, sg.GraphError, *words)


def test_a_tree_too_large_says_so(monkeypatch):
    monkeypatch.setattr(tree_module, "MAX_NODES", 100)
    g = loop()
    g.edge("n", "n")
    refuses(lambda: sg.unroll(g, max_visits=20), sg.GraphError, "more than 100 nodes", "max_visits = 20", "lower")


def test_breadth_first():
    g = graph()
    g.edge("n", "a")
    g.edge("n", "b")
    g.edge("a", "c")
    g.edge("b", "d")
    tree = sg.unroll(g)
    assert [node.name for node in tree.nodes] == ["n", "a", "b", "c", "d"]
    assert [node.parent for node in tree.nodes] == [None, 0, 0, 1, 2]
    assert [node.index for node in tree.nodes] == list(range(5))
    assert paths(tree) == ["n", "n/a", "n/b", "n/a/c", "n/b/d"]


@pytest.mark.parametrize("max_visits", [1, 2, 5])
def test_a_loop_is_cut_after_its_visits(max_visits):
    tree = sg.unroll(loop(), max_visits=max_visits)
    assert [node.cut for node in tree.nodes] == [False] * max_visits + [True]
    assert tree.nodes[-1].groups == ()
    assert repr(tree) == f"Tree({max_visits + 1} nodes, 1 of them cut, from 'n')"


def test_visits_count_on_each_path():
    """Four siblings lead to the same node: none is cut, though it is visited four times in all."""
    g = graph()
    for i in range(4):
        g.edge("n", f"way {i}")
        g.edge(f"way {i}", "shared")
    tree = sg.unroll(g, max_visits=1)
    assert sum(node.name == "shared" for node in tree.nodes) == 4
    assert not any(node.cut for node in tree.nodes)


def test_two_parallel_loops_are_counted_together():
    g = loop()
    g.edge("n", "m")
    g.edge("m", "n")
    tree = sg.unroll(g, max_visits=2)
    deepest = max(paths(tree), key=lambda path: path.count("/"))
    assert all(path.split("/").count("n") <= 3 for path in paths(tree))
    assert deepest.split("/").count("m") <= 2


def test_labels_stand_in_the_path():
    g = graph()
    g.choose("n", "first", {"a": ("m", None), "b": ("m", None)})
    g.chance("m", {"hit": ("end", None), "miss": ("n", None)}, {"hit": 0.5, "miss": 0.5})
    assert paths(sg.unroll(g, max_visits=1)) == [
        "n",
        "n/m[a]",
        "n/m[b]",
        "n/m[a]/end[hit]",
        "n/m[a]/n[miss]",
        "n/m[b]/end[hit]",
        "n/m[b]/n[miss]",
    ]


def test_start_from_a_later_node():
    g = graph()
    g.edge("n", "m")
    g.edge("m", "end")
    assert paths(sg.unroll(g, start="m")) == ["m", "m/end"]
    assert paths(sg.unroll(g, start="end")) == ["end"]


def test_a_selection_is_decided_once_on_a_path():
    g = graph()
    g.choose("n", "first", {"a": ("m", None), "b": ("m", None)})
    g.choose("m", "first", {"a": ("a end", None), "b": ("b end", None)})
    tree = sg.unroll(g)
    assert paths(tree) == ["n", "n/m[a]", "n/m[b]", "n/m[a]/a end[a]", "n/m[b]/b end[b]"]
    assert tree.nodes[1].groups[0].branches[0].share == 1.0
    assert tree.nodes[0].groups[0].branches[0].share is None


@settings(max_examples=40)
@given(st.lists(st.sampled_from(["first", "second"]), min_size=1, max_size=5), st.integers(1, 3))
def test_no_path_contradicts_itself(selections, max_visits):
    g = graph("n0")
    for depth, selection in enumerate(selections):
        target = f"n{(depth + 1) % len(selections)}"
        choices = SLOTS[selection].choices
        g.choose(f"n{depth}", selection, dict.fromkeys(choices, (target, None)))
    tree = sg.unroll(g, max_visits=max_visits)
    for node in tree.nodes:
        decided, at = {}, node
        while at.parent is not None:
            parent = tree.nodes[at.parent]
            for group in parent.groups:
                for branch in group.branches:
                    if branch.child == at.index:
                        selection = group.group.selection
                        assert decided.setdefault(selection, branch.branch.label) == branch.branch.label
            at = parent


def test_branches_that_cannot_happen_are_left_out():
    g = graph()
    g.chance("n", {"never": ("a", None), "always": ("b", None)}, {"never": 0.0, "always": 1.0})
    assert paths(sg.unroll(g)) == ["n", "n/b[always]"]


def test_needed_states_are_those_read_before_they_are_written():
    g = graph()
    g.choose(
        "n",
        "first",
        {"a": ("m", lambda x: {"y": x}), "b": ("m", lambda u: {"z": u})},
    )
    g.reward("m", lambda y, first: y)
    tree = sg.unroll(g)
    assert list(tree.needed_states) == ["x", "y"]  # on the path through b nobody writes y
    assert "choice 'a'" in tree.needed_states["x"]
    assert "reward" in tree.needed_states["y"]


def test_probability_models_need_their_states_too():
    g = graph()
    g.chance("n", {"hit": ("m", None)}, lambda z: {"hit": 1.0})
    assert list(sg.unroll(g).needed_states) == ["z"]


def test_each_model_is_listed_once():
    g = graph()
    g.edge("n", "n", lambda x: {"x": x + 1})
    g.reward("n", lambda x: x)
    assert len(sg.unroll(g, max_visits=4).models) == 2


def test_a_tree_keeps_the_graph_of_its_moment():
    g = loop()
    tree = sg.unroll(g, max_visits=1)
    g.reward("n", lambda x: x)
    assert sg.Objective(tree, compiled=False).value({}, {"u": 0}, {"first": "a", "second": "a"}) == 0.0


def test_picture():
    g = loop()
    g.chance("n", {"hit": ("end", None), "miss": ("over", None)}, {"hit": 0.25, "miss": 0.75})
    g.reward("n", lambda x: x)
    tree = sg.unroll(g, max_visits=1)
    diagram = tree.diagram(notes={2: ("J = 3",)}, reach={0: 1.0, 1: 1.0, 2: 1.0, 3: 0.0})
    by_key = {node.key: node for node in diagram.nodes}
    assert by_key["1"].kind == "cut"
    assert by_key["2"].lines == ("end", "J = 3")
    assert by_key["3"].muted
    assert not by_key["2"].muted
    assert [edge.weight for edge in diagram.edges if edge.kind == "chance"] == [0.25, 0.75]
    assert "reward" in {node.kind for node in diagram.nodes}
    assert tree._repr_svg_().lstrip().startswith(("<svg", "<?xml"))
