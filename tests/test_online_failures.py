"""Worlds that fail, do something else than before, or say what cannot be."""

import numpy as np
import pytest
from online_worlds import NOTHING, Scripted, Spy, kick_graph, kicking, loop, told
from small_tasks import refuses

import symgraph as sg


class Jammed(Exception):
    def __init__(self, text, **observed):
        super().__init__(text)
        self.observed = observed


def chain():
    """aim → moved → end, both learned, in which nothing is chosen."""
    slots = {"u": sg.Action(low=-1.0, high=1.0), "s": sg.State(), "y": sg.State(), "z": sg.State()}
    graph = sg.Graph(slots, start="aim")
    graph.edge("aim", "moved", Spy({"u": 1, "s": 1}, {"y": 1}, "move"))
    graph.edge("moved", "end", Spy({"y": 1}, {"z": 1}, "slide"))
    graph.reward("moved", lambda y: -(y**2))
    graph.reward("end", lambda z: -(z**2))
    return graph


def spies(one):
    return {name: lesson.model for name, lesson in one._lessons.all.items()}


def steady():
    return Scripted({"s": 0.5}, {"aim": {"moved": {"y": 2.0}}, "moved": {"end": {"z": 3.0}}})


def raises(error):
    def node(*_):
        raise error

    return node


def test_a_failure_that_says_what_it_observed_ends_the_episode_and_not_the_loop(tmp_path):
    world = steady()

    def moved(actions, selections, world):
        if len(world.seeds) == 2:
            raise Jammed("the cup fell", spilled=np.array([1.0, 2.0]), z=9.0)
        return {"end": {"z": 3.0}}

    world.nodes["moved"] = moved
    with loop(tmp_path, chain(), world, 3) as one:
        first, second, third = one
        assert [report.status for report in (first, second, third)] == ["done", "failed", "done"]
        assert second.reason == "Jammed at node 'moved': the cup fell"
        assert str(second) == "toy 1; failed: Jammed at node 'moved': the cup fell"
        assert second.total == -(2.0**2)
        np.testing.assert_array_equal(second.known.pop("spilled"), [1.0, 2.0])
        assert second.known == {"s": 0.5, "u": second.actions["u"], "y": 2.0, "z": 9.0}
        stored = one.store.episodes()[1]
        assert (stored.status, stored.reason, stored.total) == ("failed", second.reason, -4.0)
        assert stored.info["observed"] == {"spilled": [1.0, 2.0], "z": 9.0}
        assert [spy.samples for spy in spies(one).values()] == [3, 2]  # what the first edge did was learned from
        assert [past.total is None for past in one._past.episodes] == [False, True, False]
        before = told(one.store)
    with loop(tmp_path, chain(), world, 3) as one:
        assert [spy.samples for spy in spies(one).values()] == [3, 2]
        assert [past.total is None for past in one._past.episodes] == [False, True, False]
        assert told(one.store) == before


def test_an_error_that_says_nothing_comes_out_and_the_episode_goes_on_later(tmp_path):
    cause = KeyError("a typing error")
    error = ValueError("no such motor")
    error.__cause__ = cause
    world = steady()
    world.nodes["moved"] = raises(error)
    with loop(tmp_path, chain(), world, 2) as one:
        for _ in range(2):
            with pytest.raises(ValueError, match="no such motor") as caught:
                list(one)
            assert caught.value is error
            assert error.__cause__ is cause
            assert [episode.status for episode in one.store.episodes()] == ["running"]
            assert [visit.node for visit in one.store.visits()] == ["aim", "moved"]
            assert [len(lesson.x) for lesson in one._lessons.all.values()] == [1, 0]  # and not one more for each try
        with pytest.raises(ValueError, match="no such motor"):
            one.perform(world, 0)
    world = steady()
    with loop(tmp_path, chain(), world, 2) as one:
        assert [(report.number, report.status) for report in one] == [(0, "done"), (1, "done")]
        assert [spy.samples for spy in spies(one).values()] == [2, 2]
        assert [len(spy.fits) for spy in spies(one).values()] == [1, 2]  # the first was in the folder
    with loop(tmp_path / "reset", chain(), Scripted(raises(Jammed("nobody there")), {})) as one:
        with pytest.raises(Jammed, match="nobody there"):
            list(one)
        assert len(one.store) == 0


def test_performing_tells_of_failures_too(tmp_path):
    world = steady()
    with loop(tmp_path, chain(), world, 1) as one:
        list(one)
        world.nodes["moved"] = raises(Jammed("the cup fell"))
        report = one.perform(world, 0)
    assert (report.status, report.reason) == ("failed", "Jammed at node 'moved': the cup fell")


def interrupted_at_moved(folder):
    """A folder whose first episode was stopped on its way from "moved"."""
    world = steady()
    world.nodes["moved"] = raises(RuntimeError("power cut"))
    with loop(folder, chain(), world, 2) as one, pytest.raises(RuntimeError, match="power cut"):
        list(one)


@pytest.mark.parametrize(
    ("start", "nodes", "reason"),
    [
        ({"s": 0.25}, {}, "the world did not do again what it did before, step 0"),
        ({"s": 0.5, "more": 1.0}, {}, "the world did not do again what it did before, step 0"),
        ({"s": 0.5}, {"aim": {"moved": {"y": 2.0 + 1e-15}}}, "the world did not do again what it did before, step 1"),
        (
            {"s": 0.5},
            {"aim": raises(Jammed("stuck"))},
            "the world failed where it did not before, step 0: Jammed: stuck",
        ),
    ],
)
def test_a_world_that_does_something_else_than_before_interrupts_the_episode(tmp_path, start, nodes, reason):
    interrupted_at_moved(tmp_path)
    world = steady()
    world.start, world.nodes = start, world.nodes | nodes
    with loop(tmp_path, chain(), world, 2) as one:
        (noted,) = one.store.plans(0).values()
        report = next(iter(one))
        assert (report.number, report.status, report.reason) == (0, "interrupted", reason)
        assert (report.total, report.known["y"]) == (-4.0, 2.0)  # of what was stored
        assert (report.actions["u"], report.value) == (noted["actions"]["u"], noted["value"])
        world.start, world.nodes = {"s": 0.5}, steady().nodes
        assert [(report.number, report.status) for report in one] == [(1, "done")]
        assert len(one.store.visits(0)) == 2
        lessons = one._lessons.all
        np.testing.assert_array_equal(lessons["move"].x, [[noted["actions"]["u"], 0.5], [lessons["move"].x[1][0], 0.5]])
        assert [spy.samples for spy in spies(one).values()] == [2, 1]
        before = told(one.store)
    with loop(tmp_path, chain(), world, 2) as one:
        assert [len(lesson.x) for lesson in one._lessons.all.values()] == [2, 1]
        assert told(one.store) == before


def test_a_world_that_leads_to_fewer_nodes_than_before_interrupts_the_episode(tmp_path):
    graph = sg.Graph({"u": sg.Action(low=-1.0, high=1.0), "y": sg.State()}, start="aim")
    graph.edge("aim", "left", lambda u: {"y": u})
    graph.edge("aim", "right")
    graph.edge("right", "end")
    graph.reward("right", lambda: -1.0)
    nodes = {"aim": {"left": {}, "right": {"y": 1.0}}, "right": raises(RuntimeError("power cut"))}
    with loop(tmp_path, graph, Scripted({}, nodes), 1) as one, pytest.raises(RuntimeError, match="power cut"):
        list(one)
    nodes = {"aim": {"left": {}}}
    with loop(tmp_path, graph, Scripted({}, nodes), 1) as one:
        (report,) = one
        assert (report.status, report.total) == ("interrupted", -1.0)
        assert [visit.node for visit in one.store.visits()] == ["aim", "left", "right"]


START = "node 'aim': "
MOVED = "node 'moved': the world observed "


@pytest.mark.parametrize(
    ("start", "nodes", "words"),
    [
        (None, {}, (START, "the world's reset returned None; return {label: value}")),
        ({"s": "much"}, {}, (START, "observed 's' = 'much' is not a number")),
        ({"s": [1.0, 2.0]}, {}, (START, "observed 's' with 2 elements, the slot has 1; observe as many")),
        ({"s": float("nan")}, {}, (START, "observed 's' = nan, which is not finite; if that was a failure, raise")),
        ({"s": 1.0, "u": 0.5}, {}, (START, "observed 'u' = 0.5, which is decided and not observed; leave it out")),
        ({"s": 1.0, 3: 0.5}, {}, (START, "label of observed is 3")),
        (
            {},
            {},
            (
                "state 's' is missing at the start: edge 'aim' → 'moved': ",
                "return it, or hand it over as given=, of Stage",
            ),
        ),
        (None, {"aim": None}, (START, "the world returned None; return {node reached: {label: value}}")),
        (None, {"aim": ["moved"]}, (START, "the world returned ['moved']; return {node reached: {label: value}}")),
        (None, {"aim": {"moved": None}}, (START, "return {node reached: {label: value}}")),
        (None, {"aim": {"mved": {}}}, (START, "led to 'mved', which is no node of the graph; did you mean 'moved'?")),
        (
            None,
            {"aim": {"end": {}}},
            (START, "led to 'end', to which no branch leads from there; it can lead to 'moved'"),
        ),
        (
            None,
            {"aim": {}},
            (START, "led nowhere; return one entry for each group that happened, of 'moved', or raise"),
        ),
        (None, {"aim": {"moved": {"y": [1.0, 2.0]}}}, (MOVED, "'y' with 2 elements, the slot has 1")),
        (None, {"aim": {"moved": {"y": "0.3"}}}, ("node 'moved': ", "observed 'y' = '0.3' is not a number")),
        (None, {"aim": {"moved": {"y": float("inf")}}}, (MOVED, "'y' = inf, which is not finite")),
        (None, {"aim": {"moved": {"u": 1.0, "y": 1.0}}}, (MOVED, "'u' = 1.0, which is decided")),
    ],
)
def test_rubbish_is_refused_and_nothing_of_it_is_stored(tmp_path, start, nodes, words):
    world = steady()
    if start is not None or not nodes:
        world.start = start if start is not None else (lambda seed: None)
    world.nodes = world.nodes | nodes
    with loop(tmp_path, chain(), world, 1) as one:
        refuses(lambda: list(one), sg.InputError, *words)
        stored = [visit.node for visit in one.store.visits()]
        assert stored == (["aim"] if nodes else [])
        refuses(lambda: one.perform(world, 0), sg.InputError, *words)
        world.start, world.nodes = steady().start, steady().nodes  # once it is mended, the episode goes on
        assert [report.status for report in one] == ["done"]


def test_a_world_that_does_not_do_what_was_selected_is_refused(tmp_path):
    world = Scripted({"s": 0.2}, {"aim": {"near_end": {"y": 1.0}}})
    with loop(tmp_path, kick_graph(), world, 1) as one:
        words = "led to 'near_end', to which no branch leads from there with {'skill': 'far'}; it can lead to 'far_end'"
        refuses(lambda: list(one), sg.InputError, words)


def test_a_world_may_write_into_what_it_is_handed(tmp_path):
    graph = sg.Graph({"u": sg.Action(2, low=-1.0, high=1.0), "y": sg.State()}, start="aim")
    graph.edge("aim", "end", Spy({"u": 2}, {"y": 1}, "move"))
    graph.reward("end", lambda y: -((y - 0.5) ** 2))

    def aim(actions, selections, world):
        actions["u"] *= 100.0
        return {"end": {"y": 1.0}}

    with loop(tmp_path, graph, Scripted({}, {"aim": aim}), 3, NOTHING) as one:
        for report in one:
            assert abs(report.actions["u"]).max() <= 1.0
            assert abs(one.store.visits(report.number)[1].actions["u"]).max() <= 1.0


def test_what_is_observed_beside_the_slots_is_kept(tmp_path):
    world = kicking(lambda seed: {"s": 0.5, "temperature": float("nan"), "camera": np.zeros(3)})
    with loop(tmp_path, kick_graph(), world, 1) as one:
        (report,) = one
        assert list(one.store.visits()[0].observed) == ["s", "temperature", "camera"]
    assert np.isnan(report.known["temperature"])
