"""What the models of the on-line loop are taught, and what the graph pays for what was observed."""

import casadi as ca
import numpy as np
import pytest
from online_worlds import NOTHING, Scripted, Spy, kick_graph, kicking, loop, networks
from small_tasks import refuses

import symgraph as sg
from symgraph.learned import BranchNetwork, Exploration, StochasticNetwork

DRAWN = Exploration(1.0, 1.0, 0.0, episodes=1e9)


def test_each_model_is_fitted_once_for_each_edge_that_ran_to_exactly_its_samples(tmp_path):
    near, far = Spy({"u": 1, "s": 1}, {"y": 1}, "near"), Spy({"u": 1, "s": 1}, {"y": 1}, "far")
    world = kicking()
    with loop(tmp_path, kick_graph(near, far), world, 9, DRAWN) as one:
        reports = list(one)
    for spy in (near, far):
        mine = [report for report in reports if report.selections["skill"] == spy.name]
        x = np.array([[report.actions["u"], report.known["s"]] for report in mine])
        y = np.array([[report.known["y"]] for report in mine])
        assert len(mine) > 1
        assert len(spy.fits) == len(mine)
        for count, (fitted_x, fitted_y, _) in enumerate(spy.fits, start=1):
            np.testing.assert_array_equal(fitted_x, x[:count])
            np.testing.assert_array_equal(fitted_y, y[:count])
        assert len({seed for _, _, seed in spy.fits}) == len(mine)


def two_ways():
    """Two edges share a network under other labels; one of its inputs is a selection."""
    shared = Spy({"skill": 2, "move": 1, "from": 2}, {"to": 1, "cost": 1}, "shared")
    slots = {"skill": sg.Selection(["near", "far"]), "u": sg.Action(low=0.0, high=1.0)}
    slots |= {"v": sg.Action(low=2.0, high=3.0), "a": sg.State(2), "b": sg.State(2)}
    slots |= {label: sg.State() for label in ("c", "d", "p", "q")}
    graph = sg.Graph(slots, start="here")
    graph.edge("here", "left", sg.Model(shared, rename={"move": "u", "from": "a", "to": "c", "cost": "p"}))
    graph.edge("here", "right", sg.Model(shared, rename={"move": "v", "from": "b", "to": "d", "cost": "q"}))
    graph.edge("left", "end", sg.Model(shared, rename={"move": "v", "from": "b", "to": "c", "cost": "q"}))
    for node, label in (("left", "c"), ("right", "d")):
        graph.reward(node, sg.Model(lambda x: -(x**2), rename={"x": label}))
    return graph, shared


def test_a_shared_network_gets_the_samples_of_all_its_edges(tmp_path):
    graph, shared = two_ways()
    observed = {"left": {"c": 10.0, "p": 11.0}, "right": {"d": 20.0, "q": 21.0}}
    world = Scripted({"a": [1.0, 2.0], "b": [3.0, 4.0]}, {"here": observed, "left": {"end": {"c": 30.0, "q": 31.0}}})
    with loop(tmp_path, graph, world, 2, DRAWN) as one:
        reports = list(one)
        assert [visit.node for visit in one.store.visits(0)] == ["here", "left", "right", "end"]
    rows = []
    for report in reports:
        hot = [float(report.selections["skill"] == choice) for choice in ("near", "far")]
        u, v = report.actions["u"], report.actions["v"]
        rows += [[*hot, u, 1.0, 2.0], [*hot, v, 3.0, 4.0], [*hot, v, 3.0, 4.0]]
        assert report.known["c"] == 30.0  # the latest, although "right" was reached after "left"
        assert (report.known["p"], report.known["q"]) == (11.0, 31.0)
        assert report.total == -(10.0**2) - 20.0**2
    assert [len(x) for x, _, _ in shared.fits] == [2, 3, 5, 6]  # one fit for each executed node
    np.testing.assert_array_equal(shared.fits[-1][0], rows)
    np.testing.assert_array_equal(shared.fits[-1][1], [[10.0, 11.0], [20.0, 21.0], [30.0, 31.0]] * 2)


def falling(reads):
    """A thing that stays or falls, by chance, and may slide when it stays."""
    falls = BranchNetwork(reads, ["stays", "falls"], (16,), samples_needed=1, name="falls")
    slots = {"u": sg.Action(low=-1.0, high=1.0), "y": sg.State()}
    graph = sg.Graph(slots, start="put")
    slide = Spy({"u": 1}, {"y": 1}, "slide")
    graph.chance("put", {"stays": ("table", slide), "falls": ("floor", None)}, falls)
    graph.reward("floor", lambda: -1.0)
    return graph, falls, slide


def test_a_network_of_branches_learns_which_one_happened(tmp_path):
    graph, falls, slide = falling({"u": 1})
    world = Scripted({}, {"put": lambda a, s, w: {"floor": {}} if a["u"] > 0.2 else {"table": {"y": a["u"]}}})
    with loop(tmp_path, graph, world, 16, Exploration(0.0, 1.0, 0.0, episodes=1e9)) as one:
        reports = list(one)
        lesson = one._lessons.all["falls"]
        actions = [report.actions["u"] for report in reports]
        np.testing.assert_array_equal(np.ravel(lesson.x), actions)
        assert lesson.y == ["falls" if u > 0.2 else "stays" for u in actions]
        assert [report.total for report in reports] == [-1.0 if u > 0.2 else 0.0 for u in actions]
        assert len(slide.fits) == sum(u <= 0.2 for u in actions)
    assert falls.samples == 16
    assert falls.predict([0.9])[1] > 0.7
    assert falls.predict([-0.7])[1] < 0.3


def test_limits_clip_what_is_learned_and_nothing_else(tmp_path):
    slots = {"u": sg.Action(low=-1.0, high=1.0), "y": sg.State(2), "z": sg.State()}
    graph, slide = sg.Graph(slots, start="aim"), Spy({"u": 1}, {"y": 2, "z": 1}, "slide")
    graph.edge("aim", "end", slide)
    graph.reward("end", lambda y, z: y[0] + 10.0 * y[1] + 100.0 * z)
    observed = [([0.5, 0.5], 1.0), ([7.0, 7.0], 200.0), ([-9.0, -9.0], -1.0)]
    values = iter(observed)
    world = Scripted({}, {"aim": lambda *_: {"end": dict(zip(("y", "z"), next(values), strict=True))}})
    with loop(tmp_path, graph, world, 3, NOTHING, limits={"y": (-1.0, [2.0, 3.0]), "z": (0.0, 100.0)}) as one:
        reports = list(one)
        stored = [visit.observed for visit in one.store.visits() if visit.step]
    assert [(list(seen["y"]), seen["z"]) for seen in stored] == observed
    assert [report.total for report in reports] == [y[0] + 10.0 * y[1] + 100.0 * z for y, z in observed]
    np.testing.assert_array_equal(slide.fits[-1][1], [[0.5, 0.5, 1.0], [2.0, 3.0, 100.0], [-1.0, -1.0, 0.0]])
    for limits, words in (
        ({"yy": (0.0, 1.0)}, "limits: 'yy' is no state; did you mean 'y'?"),
        ({"u": (0.0, 1.0)}, "limits: 'u' is no state"),
        ({"y": (1.0, 0.0)}, "limits of 'y' = (1.0, 0.0); give (low, high)"),
        ({"y": 3.0}, "limits of 'y' = 3.0; give (low, high)"),
        ({"y": ([0.0, 0.0, 0.0], 1.0)}, "numbers or one for each element"),
        ([1.0], "limits = [1.0]; give {label: (low, high)}"),
    ):
        refuses(lambda limits=limits: loop(tmp_path / "other", graph, world, limits=limits), sg.InputError, words)


def test_rewards_are_those_of_the_graph_for_what_was_observed(tmp_path):
    """By hand: several at a node, several groups, some that depend on what is decided where they are paid."""
    slots = {"u": sg.Action(low=-1.0, high=1.0), "v": sg.Action(low=-1.0, high=1.0)}
    slots |= {"skill": sg.Selection(["near", "far"]), "s": sg.State(), "y": sg.State(2), "z": sg.State()}
    graph = sg.Graph(slots, start="aim")
    graph.reward("aim", lambda s: 3.0 * s)
    graph.reward("aim", lambda u, skill: u**2 + 10.0 * skill[1])  # paid when "aim" is left
    graph.edge("aim", "up", lambda u: {"y": [u, 2.0 * u]})
    graph.edge("aim", "down", lambda u: {"z": u})
    graph.reward("up", lambda y, v: y[0] - y[1] + 100.0 * v)  # "up" is a decision: paid when it is left
    graph.reward("up", lambda y: y[1] ** 2)
    graph.reward("down", lambda z, u: z * u)  # "down" is none: paid on arrival
    graph.choose("up", "skill", {"near": ("end", None), "far": ("end", None)})
    graph.reward("end", lambda y, z: y[0] * z)
    observed = {"up": {"y": [0.5, -2.0]}, "down": {"z": 4.0}}
    world = Scripted({"s": 0.25, "z": 7.0}, {"aim": observed, "up": {"end": {"y": [1.5, 0.0]}}})
    with loop(tmp_path, graph, world, 6, DRAWN, decisions=["up"]) as one:
        for report in one:
            _, up, down, end = one.store.visits(report.number)
            first, second = one.store.plans(report.number)[0], one.store.plans(report.number)[1]
            u, v = first["actions"]["u"], second["actions"]["v"]
            far = first["selections"]["skill"] == "far"
            start = one.store.visits(report.number)[0]
            assert start.reward == 3.0 * 0.25
            assert up.reward == pytest.approx(u**2 + 10.0 * far + 4.0, rel=1e-14)
            assert down.reward == pytest.approx(4.0 * u, rel=1e-14)
            assert end.reward == pytest.approx(0.5 + 2.0 + 100.0 * v + 1.5 * 7.0, rel=1e-14)
            assert report.total == pytest.approx(0.75 + up.reward + down.reward + end.reward, rel=1e-14)


def test_what_the_world_does_not_observe_follows_from_the_edge_model(tmp_path):
    slots = {"u": sg.Action(low=-1.0, high=1.0), "s": sg.State(), "y": sg.State(2), "z": sg.State(), "w": sg.State()}
    graph = sg.Graph(slots, start="aim")
    graph.edge("aim", "moved", lambda u, s: {"y": [u + s, u - s], "z": 5.0 * u})
    slide = Spy({"y": 2, "z": 1}, {"w": 1}, "slide")
    graph.edge("moved", "end", slide)
    graph.reward("end", lambda w: -(w**2))
    world = Scripted({"s": 0.25}, {"aim": {"moved": {"z": 8.0}}, "moved": {"end": {"w": 1.0}}})
    with loop(tmp_path, graph, world, 1, DRAWN) as one:
        (report,) = one
    u = report.actions["u"]
    np.testing.assert_array_equal(slide.fits[0][0], [[u + 0.25, u - 0.25, 8.0]])
    np.testing.assert_array_equal(report.known["y"], [u + 0.25, u - 0.25])
    assert report.known["z"] == 8.0  # observed, which is better than what follows


def test_what_a_learned_model_needs_must_be_observed(tmp_path):
    graph = kick_graph()
    place = "node 'aim', choice 'far': model 'far' learns 'y', which was not observed on the way to 'far_end'"
    world = Scripted({"s": 0.2}, {"aim": {"far_end": {"x": 1.0}}})
    with loop(tmp_path / "writes", graph, world) as one:
        refuses(lambda: list(one), sg.InputError, place, "observed were 'x'")
        assert [visit.node for visit in one.store.visits()] == ["aim"]  # so that a mended world can go on
        world.nodes["aim"] = {"far_end": {"y": 1.0}}
        assert [report.status for report in one] == ["done"] * 3
    # Not what was known before: it says nothing of what the edge did.
    world = Scripted({"s": 0.2, "y": 3.0}, {"aim": {"far_end": {}}})
    with loop(tmp_path / "stale", kick_graph(), world) as one:
        refuses(lambda: list(one), sg.InputError, place, "observed were (none)")


def test_what_follows_must_make_sense_to_be_learned_from(tmp_path):
    slots = {"u": sg.Action(low=0.0, high=1.0), "s": sg.State(), "r": sg.State(), "y": sg.State()}
    graph = sg.Graph(slots, start="aim")
    graph.edge("aim", "moved")
    graph.edge("moved", "rooted", lambda s: {"r": ca.sqrt(s)})
    graph.edge("rooted", "end", Spy({"r": 1, "u": 1}, {"y": 1}, "slide"))
    graph.reward("end", lambda y: y)
    nodes = {"aim": {"moved": {"s": -1.0}}, "moved": {"rooted": {}}, "rooted": {"end": {"y": 1.0}}}
    with loop(tmp_path, graph, Scripted({"s": 1.0}, nodes)) as one:
        words = "model 'slide' cannot learn from 'r' = nan; observe it, or mend the model it follows from"
        refuses(lambda: list(one), sg.InputError, words)


def test_what_a_reward_reads_must_be_known(tmp_path):
    """Two models lead to one node, and nobody can tell which one did."""
    graph = sg.Graph({"u": sg.Action(low=0.0, high=1.0), "w": sg.State()}, start="aim")
    ways = {"one": ("end", lambda u: {"w": u}), "other": ("end", lambda u: {"w": -u})}
    graph.chance("aim", ways, {"one": 0.5, "other": 0.5})
    graph.reward("end", lambda w: w)
    with loop(tmp_path, graph, Scripted({}, {"aim": {"end": {}}})) as one:
        refuses(
            lambda: list(one), sg.InputError, "reads 'w', which was not observed on the way to 'end'; known are 'u'"
        )


def test_branches_that_nobody_can_tell_apart_are_refused(tmp_path):
    slots = {"u": sg.Action(low=-1.0, high=1.0), "y": sg.State()}
    words = "lead to 'end', so that nobody can tell which of them is to learn from it; give each a node of its own"
    a, b = Spy({"u": 1}, {"y": 1}, "a"), Spy({"u": 1}, {"y": 1}, "b")
    learned = sg.Graph(slots, start="put")
    learned.chance("put", {"stays": ("end", a), "falls": ("end", b)}, {"stays": 0.5, "falls": 0.5})
    which = sg.Graph(slots, start="put")
    falls = BranchNetwork({"u": 1}, ["stays", "falls"], (4,), name="falls")
    which.chance("put", {"stays": ("end", None), "falls": ("end", None)}, falls)
    groups = sg.Graph(slots, start="put")
    groups.edge("put", "end", a)
    groups.edge("put", "end", lambda u: {"y": u})
    for graph in (learned, which, groups):
        refuses(lambda graph=graph: loop(tmp_path, graph, Scripted({}, {})), sg.InputError, "node 'put'", words)


def test_a_model_that_was_fitted_elsewhere_is_refused(tmp_path):
    spy = Spy({"u": 1, "s": 1}, {"y": 1}, "far")
    spy.samples = 40
    refuses(
        lambda: loop(tmp_path, kick_graph(None, spy), kicking()),
        sg.InputError,
        "model 'far' has seen 40 samples, of which the episodes in",
        "give a new model",
    )


def test_a_file_that_is_ahead_of_its_episodes_is_fitted_anew(tmp_path):
    """After a power cut, which may take visits that a model has learned from."""
    with loop(tmp_path, kick_graph(), kicking(), 6, Exploration(1.0, 1.0, 0.0, episodes=6)) as one:
        list(one)
    (tmp_path / "far.safetensors").write_text("5")
    (tmp_path / "near.safetensors").write_text("3")
    with loop(tmp_path, kick_graph(), kicking(), 6, Exploration(1.0, 1.0, 0.0, episodes=6)) as one:
        fits = {name: [len(x) for x, _, _ in lesson.model.fits] for name, lesson in one._lessons.all.items()}
    assert fits == {"far": [3], "near": []}
    (tmp_path / "far.safetensors").unlink()
    elsewhere = Spy({"u": 1, "s": 1}, {"y": 1}, "far")
    elsewhere.samples = 5
    refuses(
        lambda: loop(tmp_path, kick_graph(None, elsewhere), kicking(), 6), sg.InputError, "has seen 5 samples", "know 3"
    )


def test_a_model_file_that_is_damaged_may_be_deleted(tmp_path):
    with loop(tmp_path, kick_graph(*networks()), kicking(), 4, DRAWN) as one:
        list(one)
        counts = {name: lesson.model.samples for name, lesson in one._lessons.all.items()}
    file = tmp_path / "far.safetensors"
    file.write_bytes(file.read_bytes()[:-9])
    words = f"{file}: ", "it was cut off or added to; delete the file, and the loop fits the model to its episodes"
    refuses(lambda: loop(tmp_path, kick_graph(*networks()), kicking(), 4), sg.StorageError, *words)
    StochasticNetwork({"u": 1, "s": 1}, {"y": 1}, (2,), name="far").save(file)
    words = "holds a model with hidden = (2,)", "make it with the same settings"
    refuses(lambda: loop(tmp_path, kick_graph(*networks()), kicking(), 4), sg.StorageError, *words)
    file.unlink()
    with loop(tmp_path, kick_graph(*networks()), kicking(), 4) as one:
        assert {name: lesson.model.samples for name, lesson in one._lessons.all.items()} == counts
    assert file.exists()


def test_a_reward_that_was_learned_before_is_used_as_it_is(tmp_path):
    liked = Spy({"y": 1}, {"liking": 1}, "liked", [2.0])
    liked.samples = 40
    with loop(tmp_path, kick_graph(reward=liked), kicking(), 2) as one:
        assert [report.total for report in one] == [2.0 * visit.observed["y"] for visit in one.store.visits()[1::2]]
    assert liked.fits == []


def test_models_that_cannot_be_kept_are_refused(tmp_path):
    class Half:
        name, reads, writes = "half", ("u", "s"), ("y",)

        def propagate(self, inputs):
            return {"y": inputs["u"]}

        def fit(self, x, y):
            pass

    refuses(
        lambda: loop(tmp_path, kick_graph(None, Half()), kicking()),
        sg.InputError,
        "choice 'far': model 'half' has a method 'fit' but no 'parameters'",
        "take 'fit' away",
    )
    for spread in ("spread", sg.Parameter(1.0, "spread")):
        spreading = Spy({"u": 1, "s": 1}, {"y": 1}, "far")
        spreading.spreads = (spread,)
        refuses(
            lambda one=spreading: loop(tmp_path, kick_graph(None, one), kicking()),
            sg.InputError,
            "choice 'far'",
            "'spreads'",
            "spread",
            "'parameters'",
        )
    one, other = (Spy({"u": 1, "s": 1}, {"y": 1}, name) for name in ("my kick", "my_kick"))
    refuses(lambda: loop(tmp_path, kick_graph(one, other), kicking()), sg.InputError, "my_kick.safetensors", "differ")
    same = (Spy({"u": 1, "s": 1}, {"y": 1}, "kick") for _ in range(2))
    refuses(lambda: loop(tmp_path, kick_graph(*same), kicking()), sg.InputError, "two learned models are named 'kick'")
