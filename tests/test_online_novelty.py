"""Which choices a loop draws: those known least in a situation, by what was executed before."""

import numpy as np
import pytest
from online_worlds import ALWAYS, NOTHING, Scripted, Spy, carry_graph, carrying, kick_graph, kick_slots, loop

import symgraph as sg
from symgraph.learned import Exploration
from symgraph.learned.deciding import Decider

HALF = Exploration(selections=0.5, actions=0.0, noise=0.0, episodes=ALWAYS)
ALL = Exploration(selections=1.0, actions=0.0, noise=0.0, episodes=ALWAYS)


class Stuck(Exception):
    """What a world raises that says what it has observed."""

    def __init__(self):
        super().__init__()
        self.observed = {"y": 0.0}


def stuck():
    raise Stuck


def draws(one):
    """Check every draw of a loop whose choices are all made at "aim", knowing s; return how many had one answer.

    With them comes how many of these are not what counting the choices would have given.
    """
    tries, clear, unlike = [], 0, 0
    for episode in one.store.episodes():
        visits, plans = one.store.visits(episode.number), one.store.plans(episode.number)
        for visit in visits[1:]:
            before = visits[visit.parent]
            if before.node != "aim":
                continue
            s, skill = one.store.known(before)["s"], visit.selections["skill"]
            if "selections" in plans[before.step]["explored"]:
                sd = np.std([where for where, _ in tries]) if tries else 0.0
                count = dict.fromkeys(("near", "far"), 0.0)
                for where, name in tries:
                    count[name] += np.exp(-(((where - s) / sd) ** 2) / 2) if sd > 1e-9 else 1.0
                if abs(count["near"] - count["far"]) > 1e-9:
                    clear += 1
                    assert skill == min(count, key=lambda name: count[name])
                    made = [name for _, name in tries]
                    unlike += made.count(skill) > len(made) / 2
            tries.append((s, skill))
    assert [(where.tolist(), made) for where, made in one._past.tries] == [
        ([s], {"skill": skill}) for s, skill in tries
    ]
    return clear, unlike


def spies():
    """Models of which plans take "far" where s is small, and "near" where it is 10."""
    return Spy({"u": 1, "s": 1}, {"y": 1}, "near", [0.0, 0.1]), Spy({"u": 1, "s": 1}, {"y": 1}, "far", [1.5, -0.5])


def test_what_is_drawn_is_known_least_in_kinds_of_situations_of_which_one_is_rare(tmp_path):
    def start(seed):
        return {"s": 0.2 + 10.0 * (seed % 5 == 0) + 1e-3 * (seed % 997)}

    world = Scripted(start, {"aim": lambda a, selections, w: {f"{selections['skill']}_end": {"y": 0.5}}})
    with loop(tmp_path, kick_graph(*spies()), world, 150, HALF) as one:
        list(one)
        clear, unlike = draws(one)
    assert clear >= 10
    assert unlike >= 3


def test_a_second_attempt_that_starts_elsewhere_counts_there(tmp_path):
    """What was tried in the first attempt says little of the second."""
    near, far = spies()
    graph = sg.Graph(kick_slots(), start="aim")
    graph.choose("aim", "skill", {"near": ("kicked", near), "far": ("kicked", far)})
    graph.reward("kicked", lambda y: -((y - 1.0) ** 2))
    world = Scripted(
        lambda seed: {"s": 0.2 + 1e-3 * (seed % 997)},
        {
            "aim": {"kicked": {"y": 0.5}},
            "kicked": lambda a, s, world: {"aim": {"s": 10.0 + 1e-3 * (world.seeds[-1] % 991)}},
        },
    )
    with loop(tmp_path, graph, world, 60, HALF, again="kicked", attempts=2) as one:
        assert [report.attempts for report in one] == [2] * 60
        clear, unlike = draws(one)
    assert clear >= 10
    assert unlike >= 3


def test_choices_that_a_later_plan_overrules_do_not_count(tmp_path):
    """Seen from the start "near" is best, once there "far"; an episode may fail before or while it is executed."""
    near, far = Spy({"s": 1}, {"y": 1}, "near", [1.0]), Spy({"s": 1}, {"y": 1}, "far", [-1.0])
    graph = sg.Graph(kick_slots(), start="start")
    graph.edge("start", "there")
    graph.choose("there", "skill", {"near": ("end", near), "far": ("end", far)})
    graph.reward("end", lambda y: -((y - 1.0) ** 2))
    fails = {"start": 1, "there": 2}  # in which episodes

    def at(node, reached):
        return lambda a, s, world: stuck() if len(world.seeds) - 1 == fails[node] else reached

    nodes = {"start": at("start", {"there": {"s": -1.0}}), "there": at("there", {"end": {"y": 1.0}})}
    with loop(tmp_path, graph, Scripted({"s": 1.0}, nodes), 4, NOTHING, decisions=["there"]) as one:
        assert [report.status for report in one] == ["done", "failed", "failed", "done"]
        for number in (0, 2, 3):
            assert [plan["selections"]["skill"] for plan in one.store.plans(number).values()] == ["near", "far"]
        tries = [(where.tolist(), made) for where, made in one._past.tries]
    assert tries == [([-1.0], {"skill": "far"})] * 3
    with loop(tmp_path, graph, Scripted({"s": 1.0}, nodes), 4, NOTHING, decisions=["there"]) as one:
        assert [(where.tolist(), made) for where, made in one._past.tries] == tries


@pytest.mark.parametrize("chosen", [True, False])
def test_choices_that_fail_count_as_made(tmp_path, chosen):
    """Of branches, and of a model that reads the selection."""
    graph, end = kick_graph(), "far_end"
    if not chosen:
        graph, end = sg.Graph(kick_slots(), start="aim"), "end"
        graph.edge("aim", "end", Spy({"u": 1, "skill": 2}, {"y": 1}, "kick"))
        graph.reward("end", lambda y: -((y - 1.0) ** 2))

    def aim(actions, selections, world):
        return stuck() if selections["skill"] == "near" else {end: {"y": 0.5}}

    with loop(tmp_path, graph, Scripted({"s": 0.2}, {"aim": aim}), 20, ALL) as one:
        skills = [report.selections["skill"] for report in one]
    assert skills.count("near") == skills.count("far") == 10
    assert all(set(pair) == {"near", "far"} for pair in zip(skills[::2], skills[1::2], strict=True))


def test_each_attempt_of_an_episode_counts_as_made(tmp_path):
    with loop(tmp_path, carry_graph(), carrying(), 12, ALL, decisions=["lifted"], again="thrown", attempts=4) as one:
        list(one)
        ways = [visit.selections["way"] for visit in one.store.visits() if visit.node in ("thrown", "rolled")]
    assert len(ways) > 12
    assert all(set(pair) == {"high", "low"} for pair in zip(ways[::2], ways[1::2], strict=False))


@pytest.mark.parametrize(
    ("explore", "kick"),
    [(ALL, 1.0 / 1.5), (Exploration(0.0, 1e-9, 0.0, episodes=ALWAYS), 1.0 / 1.5), (NOTHING, 1.5 / 11.25)],
    ids=["selections", "actions", "nothing"],
)
def test_while_it_explores_plans_take_models_for_certain(tmp_path, explore, kick):
    """A cautious plan kicks "far" gently, for its spread grows with the kick: what it does then it never learns.

    E = -(1.5 u - 1)² - (s u)² is greatest at u = 1.5 / (2.25 + s²), with s = 3 unless it is certain.
    """
    near, _ = spies()
    wide = Wide({"u": 1, "s": 1}, {"y": 1}, "far", [1.5, 0.0])
    world = Scripted({"s": 0.0}, {"aim": lambda a, s, world: {f"{s['skill']}_end": {"y": 1.5 * a["u"]}}})
    with loop(tmp_path, kick_graph(near, wide), world, 6, explore) as one:
        assert [report.status for report in one] == ["done"] * 6
        kicked = [actions["u"] for _, actions, selections in world.calls if selections["skill"] == "far"]
        assert len(kicked) >= 3
        assert kicked == pytest.approx([kick] * len(kicked), abs=1e-3)
        assert one.plan({"s": 0.0}).actions["u"] == pytest.approx(1.5 / 11.25, abs=1e-3)
    assert wide.spread.value == 3.0


class Wide(Spy):
    """A model whose standard deviation is three times the kick."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.spread = sg.Parameter(3.0, "spread")
        self.parameters = (*self.parameters, self.spread)
        self.spreads = (self.spread,)

    def propagate(self, inputs):
        mean = super().propagate(inputs)["y"].mean
        return {"y": sg.Gaussian(mean, (self.spread.symbol * inputs["u"].mean) ** 2)}


def test_parallel_strands_of_an_attempt_count_for_it(tmp_path, monkeypatch):
    """An attempt begins where the world has led back, not where it was asked to: other strands may go on meanwhile."""
    graph = sg.Graph(kick_slots(), start="aim")
    graph.edge("aim", "end")
    graph.edge("aim", "side")
    near, far = spies()
    graph.choose("side", "skill", {"near": ("near_end", near), "far": ("far_end", far)})
    for node in ("near_end", "far_end"):
        graph.reward(node, lambda y: -((y - 1.0) ** 2))
    side = Scripted(
        {"s": 0.2},
        {
            "aim": {"end": {}, "side": {}},
            "end": {"aim": {}},
            "side": lambda actions, selections, world: {f"{selections['skill']}_end": {"y": 0.5}},
        },
    )
    deciders = []
    begin = Decider.__init__

    def noted(self, *arguments, **options):
        deciders.append(self)
        begin(self, *arguments, **options)

    monkeypatch.setattr(Decider, "__init__", noted)
    with loop(tmp_path, graph, side, 1, NOTHING, again="end", attempts=2) as one:
        next(iter(one))
        made = [tried for _, tried in one._past.tries]
        assert [list(tried) for tried in made] == [["skill"], ["skill"]]
        assert [tried for _, tried in deciders[0]._tries] == made


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_planning_that_breaks_off_leaves_models_as_they_were(tmp_path, monkeypatch, error):
    near, _ = spies()
    wide = Wide({"u": 1, "s": 1}, {"y": 1}, "far", [1.5, 0.0])

    def broken(*arguments, **options):
        assert wide.spread.value == 0.0
        raise error

    monkeypatch.setattr("symgraph.learned.deciding.solve", broken)
    with loop(tmp_path, kick_graph(near, wide), Scripted({"s": 0.0}, {}), 1, ALL) as one, pytest.raises(error):
        next(iter(one))
    assert wide.spread.value == 3.0
