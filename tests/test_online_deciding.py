"""Where the on-line loop plans, what it keeps, what it tries, and a second attempt."""

import math

import casadi as ca
import numpy as np
import pytest
from online_worlds import ALWAYS, NOTHING, Scripted, carry_graph, carrying, kick_graph, loop
from small_tasks import refuses

import symgraph as sg
from symgraph.learned import Exploration, OnlineLoop, Stage


def test_plans_are_made_at_decision_nodes_only_and_what_lies_behind_is_kept(tmp_path):
    world = carrying()
    with loop(tmp_path, carry_graph(), world, 5, decisions=["lifted"]) as one:
        reports = list(one)
        for report in reports:
            assert [visit.node for visit in one.store.visits(report.number)] == ["seen", "taken", "lifted", "thrown"]
            assert list(one.store.plans(report.number)) == [0, 2]
            assert report.total == pytest.approx(0.0, abs=1e-6)  # every reward can be had in full
    assert [node for node, *_ in world.calls] == ["seen", "taken", "lifted"] * 5
    for k in range(0, 15, 3):
        (_, seen, first), (_, taken, second), (_, lifted, third) = world.calls[k : k + 3]
        assert first["hand"] == second["hand"] == third["hand"] == "right"
        assert seen["grip"] == taken["grip"] == lifted["grip"] == pytest.approx(0.7, abs=1e-4)
        np.testing.assert_array_equal(seen["throw"], taken["throw"])
        assert seen["throw"].sum() == pytest.approx(0.5 + 0.5, abs=1e-4)  # for the weight that was thought of
        assert lifted["throw"].sum() == pytest.approx(0.5 - 0.5, abs=1e-4)  # planned anew for the one that was felt


def test_a_selection_that_lies_behind_is_kept_although_nothing_holds_it(tmp_path):
    """A search from the decision so far ends on a low hill here; those that find the highest know of no hand."""
    world = carrying()
    graph = carry_graph(lambda y: ca.cos(6.0 * y) - 0.1 * y**2)
    with loop(tmp_path, graph, world, 8, decisions=["lifted"], remembered=0) as one:
        assert [report.value for report in one] == pytest.approx([1.0] * 8, abs=0.2)
    assert [selections["hand"] for _, _, selections in world.calls] == ["right"] * 24


def test_what_is_drawn_holds_for_all_decisions_of_an_attempt(tmp_path):
    world, explore = carrying(), Exploration(selections=1.0, actions=1.0, noise=0.0, episodes=ALWAYS)
    with loop(tmp_path, carry_graph(), world, 12, explore, decisions=["taken", "lifted"]) as one:
        assert {report.explored for report in one} == {"drawn: selections, actions"}
    for k in range(0, 36, 3):
        (_, first, chosen), *later = world.calls[k : k + 3]
        for _, actions, selections in later:
            assert selections == chosen
            assert actions["grip"] == first["grip"]
            np.testing.assert_array_equal(actions["throw"], first["throw"])
    assert {selections["hand"] for _, _, selections in world.calls} == {"left", "right"}


def test_the_graph_is_gone_through_up_to_the_number_of_attempts(tmp_path):
    """`again` need not be a decision; where the world leads back, a new attempt begins."""
    for attempts in (1, 2, 3):
        world = carrying()
        explore = Exploration(selections=1.0, actions=0.0, noise=0.0, episodes=ALWAYS)
        with loop(
            tmp_path / str(attempts),
            carry_graph(),
            world,
            12,
            explore,
            decisions=["taken", "lifted"],
            again="thrown",
            attempts=attempts,
        ) as one:
            reports = list(one)
            for report in reports:
                visits = one.store.visits(report.number)
                ways = [visit.selections["way"] for visit in visits if visit.node in ("thrown", "rolled")]
                assert report.attempts == len(ways)
                assert ways[:-1] == ["high"] * (len(ways) - 1)  # after "rolled" it is over
                assert ways[-1] == "low" or len(ways) == attempts
                assert {visit.selections["hand"] for visit in visits[1:4]} == {visits[1].selections["hand"]}
                assert one.store.episodes()[report.number].info["returns"] == list(report.returns)
                end = next(visit.step for visit in visits if visit.node in ("thrown", "rolled"))
                first = [visit.reward for visit in visits if visit.step <= end]
                assert report.returns[0] == pytest.approx(sum(first))
                assert report.total == pytest.approx(sum(visit.reward for visit in visits))
        assert max(report.attempts for report in reports) == attempts
        assert min(report.attempts for report in reports) == 1


def test_a_world_that_does_not_lead_back_ends_the_episode(tmp_path):
    world = carrying()
    world.nodes["thrown"] = {}
    with loop(tmp_path, carry_graph(), world, 2, decisions=["lifted"], again="thrown", attempts=5) as one:
        assert [(report.status, report.attempts) for report in one] == [("done", 1)] * 2
    assert [node for node, *_ in world.calls].count("thrown") == 2


def tried(folder, explore, episodes=160):
    """Decisions, plans and what was explored, of kicks whose best is the skill "far" with u = 0.8."""
    world = Scripted({"s": 0.2}, {"aim": lambda a, s, w: {f"{s['skill']}_end": {"y": 0.5}}})
    with loop(folder, kick_graph(), world, episodes, explore) as one:
        reports = list(one)
        plans = [one.store.plans(report.number)[0] for report in reports]
        actions = np.array([report.actions["u"] for report in reports])
        planned = np.array([plan["planned"]["u"] for plan in plans])
    return [report.selections["skill"] for report in reports], actions, planned, [r.explored for r in reports]


def is_share(count, total, probability):
    """Within four standard deviations of a binomial: a seed in 16000 would fail."""
    return abs(count - total * probability) <= 4 * math.sqrt(total * probability * (1 - probability))


def test_exploration_draws_as_often_as_it_says(tmp_path):
    skills, actions, _, explored = tried(tmp_path, Exploration(0.6, 0.3, 0.0, episodes=ALWAYS))
    total = len(skills)
    assert is_share(sum("selections" in text for text in explored), total, 0.6)
    assert is_share(sum("actions" in text for text in explored), total, 0.3)
    assert is_share(explored.count("drawn: selections, actions"), total, 0.6 * 0.3)
    # What is planned is always "far", so that what is drawn is "near" until there are as many.
    made = {"near": 0, "far": 0}
    for skill, text in zip(skills, explored, strict=True):
        if "selections" in text:
            assert made[skill] == min(made.values())
        made[skill] += 1
    assert all(text for skill, text in zip(skills, explored, strict=True) if skill == "near")
    drawn = actions[["actions" in text for text in explored]]
    edges = np.linspace(-1.0, 1.0, 5)
    assert all(is_share(count, len(drawn), 0.25) for count in np.histogram(drawn, edges)[0])
    best = {"near": 1.0, "far": 0.8}  # (1 + 0.2) / 1.5
    for skill, action, text in zip(skills, actions, explored, strict=True):
        if "actions" not in text:
            assert action == pytest.approx(best[skill], abs=1e-3)


def test_noise_has_the_spread_it_says_and_stays_in_bounds(tmp_path):
    _, actions, planned, explored = tried(tmp_path / "little", Exploration(0.0, 0.0, 0.04, episodes=ALWAYS))
    noise = actions - planned
    assert set(explored) == {""}
    np.testing.assert_allclose(planned, 0.8, atol=1e-3)
    sd = 0.04 * 2.0  # of the range; 0.2 to the bound are 2.5 of it
    assert abs(noise.mean()) < 4 * sd / math.sqrt(len(noise))
    assert noise.std() == pytest.approx(sd, rel=4 / math.sqrt(2 * len(noise)))
    _, actions, _, _ = tried(tmp_path / "much", Exploration(0.0, 0.0, 0.5, episodes=ALWAYS))
    assert actions.min() == -1.0
    assert actions.max() == 1.0
    above = 0.5 * math.erfc((1.0 - 0.8) / 1.0 / math.sqrt(2))  # the normal distribution beyond the upper bound
    assert is_share((actions == 1.0).sum(), len(actions), above)


def test_without_episodes_nothing_is_explored(tmp_path):
    skills, actions, planned, explored = tried(tmp_path, Exploration(1.0, 1.0, 1.0, episodes=0), episodes=20)
    assert set(skills) == {"far"}
    assert set(explored) == {""}
    np.testing.assert_array_equal(actions, planned)


def test_actions_come_closer_to_plans_and_selections_end_at_once():
    explore = Exploration(0.5, 0.4, 0.1, episodes=20)
    for episode, share in ((0, 1.0), (5, 0.75), (19, 0.05), (20, 0.0), (1000, 0.0)):
        now = explore.at(episode)
        assert [now.actions, now.noise] == pytest.approx([0.4 * share, 0.1 * share])
        assert now.selections == (0.5 if episode < 20 else 0.0)
        assert [now.at(0).selections, now.at(1).selections] == [now.selections, 0.0]
        assert now.explores == (episode < 20)
    assert not Exploration(0.0, 0.0, 0.0).explores
    assert Exploration(episodes=np.int64(3)) == Exploration(episodes=3)
    assert Exploration(noise=np.float32(0.5)) == Exploration(noise=0.5)
    for name, value in (("selections", 1.5), ("actions", -0.1), ("noise", math.nan), ("noise", True)):
        words = f"{name} is {value!r}; give a number from 0 to 1"
        refuses(lambda name=name, value=value: Exploration(**{name: value}), sg.InputError, words)
    for value in (-1, "many"):
        words = f"episodes is {value!r}; give a number of at least 0"
        refuses(lambda value=value: Exploration(episodes=value), sg.InputError, words)


def test_a_loop_goes_on_with_a_plan_that_was_noted(tmp_path):
    """An edge that fails is tried again with the same decision, and the plan is not made twice."""
    world = carrying()
    lifted, failures = world.nodes["lifted"], [RuntimeError("the cable came off")]

    def unsteady(*arguments):
        if failures:
            raise failures.pop()
        return lifted(*arguments)

    world.nodes["lifted"] = unsteady
    with loop(tmp_path, carry_graph(), world, 2, Exploration(episodes=ALWAYS), decisions=["lifted"]) as one:
        with pytest.raises(RuntimeError, match="the cable came off"):
            list(one)
        noted = one.store.plans(0)
        assert (list(noted), one.done) == ([0, 2], 0)
        assert [report.number for report in one] == [0, 1]
        assert one.store.plans(0) == noted
        assert len(one._lessons.all["fly"].x) == sum(visit.node == "thrown" for visit in one.store.visits())
    assert [node for node, *_ in world.calls[:6]] == ["seen", "taken", "lifted"] * 2
    for (_, actions, _), (_, again, _) in zip(world.calls[:3], world.calls[3:6], strict=True):
        for label in actions:
            np.testing.assert_array_equal(actions[label], again[label])


def test_ctrl_c_stops_the_loop_and_leaves_a_folder_that_goes_on(tmp_path):
    """In the world, and in a search, which returns what it has found so far."""

    class Stopping(sg.Lbfgs):
        def run(self, problem, rng):
            search = super().run(problem, rng)
            if stops:
                stops.pop()
                search.interrupted = True
            return search

    stops, world = [], carrying()
    lifted = world.nodes["lifted"]
    options = {"decisions": ["lifted"], "optimizer": Stopping(starts=2, iterations=30)}
    with loop(tmp_path / "whole", carry_graph(), carrying(), 3, NOTHING, **options) as one:
        expected = [report.total for report in one]
    with loop(tmp_path / "stopped", carry_graph(), world, 3, NOTHING, **options) as one:
        reports = iter(one)
        assert next(reports).number == 0
        stops.append(1)
        with pytest.raises(KeyboardInterrupt):
            next(reports)
        assert one.store.plans(1) == {}
        world.nodes["lifted"] = lambda *arguments: (_ for _ in ()).throw(KeyboardInterrupt)
        with pytest.raises(KeyboardInterrupt):
            list(one)
        assert (one.done, len(one.store.visits(1))) == (1, 3)
    world.nodes["lifted"] = lifted
    with loop(tmp_path / "stopped", carry_graph(), world, 3, NOTHING, **options) as one:
        assert [report.number for report in one] == [1, 2]
        assert [episode.total for episode in one.store.episodes()] == expected


def test_start_points_come_from_the_better_half_of_what_was_done(tmp_path):
    """Failed episodes do not count as good, although nothing bad was paid in them."""

    class Broken(Exception):
        def __init__(self, text):
            super().__init__(text)
            self.observed = {}

    def aim(actions, selections, world):
        if len(world.calls) % 3 == 0:
            raise Broken("jammed")
        return {f"{selections['skill']}_end": {"y": actions["u"]}}

    explore = Exploration(1.0, 1.0, 0.0, episodes=ALWAYS)
    world = Scripted({"s": 0.2}, {"aim": aim})
    with OnlineLoop(kick_graph(), [Stage("toy", world, 12, explore)], tmp_path, remembered=100) as one:
        reports = list(one)
        done = sorted((report for report in reports if report.status == "done"), key=lambda report: -report.total)
        assert len(done) == 8
        starts = one._past.starts(12, "toy")
        assert one._past.starts(12, "another stage") == []
    assert sorted(start["u"] for start in starts) == sorted(report.actions["u"] for report in done[:4])
