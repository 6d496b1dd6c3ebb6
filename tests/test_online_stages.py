"""Stages of the on-line loop, what is given in them, and arguments that do not fit."""

import os

import numpy as np
import pytest
from online_worlds import NOTHING, QUICK, Scripted, Spy, kick_graph, kicking, loop, told
from small_tasks import refuses
from stored_episodes import output_of, script

import symgraph as sg
from symgraph.learned import Exploration, OnlineLoop, Stage


def world_at(s):
    return kicking(lambda seed: {"s": s})


def test_stages_come_one_after_the_other_and_count_their_own_episodes(tmp_path):
    first, second = world_at(0.1), world_at(0.9)
    stages = [Stage("easy", first, 4, Exploration(1.0, 0.0, 0.0, episodes=1)), Stage("hard", second, 3, NOTHING)]
    stages += [Stage("last", first, 2, Exploration(1.0, 0.0, 0.0, episodes=1))]
    with OnlineLoop(kick_graph(), stages, tmp_path, optimizer=QUICK) as one:
        assert (one.episodes, one.done) == (9, 0)
        reports = []
        for report in one:
            reports.append(report)
            assert one.done == len(reports)
        assert [episode.setup for episode in one.store.episodes()] == ["easy"] * 4 + ["hard"] * 3 + ["last"] * 2
    assert [(r.number, r.setup) for r in reports] == [
        (i, ["easy", "hard", "last"][(i > 3) + (i > 6)]) for i in range(9)
    ]
    assert [report.known["s"] for report in reports] == [0.1] * 4 + [0.9] * 3 + [0.1] * 2
    assert ["drawn: selections" in report.explored for report in reports] == [i in (0, 7) for i in range(9)]
    assert len(first.calls) == 6
    seeds = [report.seed for report in reports]
    assert seeds == [*first.seeds[:4], *second.seeds, *first.seeds[4:]]
    assert len(set(seeds)) == 9


def shaped_graph():
    """A kick with a bonus for each skill, which is a state."""
    graph = kick_graph(bonus=sg.State(2))
    graph.reward("aim", sg.Model(lambda skill, bonus: skill[0] * bonus[0] + skill[1] * bonus[1]))
    return graph


def test_rewards_are_shaped_through_what_is_given(tmp_path):
    """A bonus for "near", which is otherwise worse, in two episodes of each stage."""

    def bonus(episode):
        return {"bonus": [5.0 if episode < 2 else 0.0, 0.0]}

    stages = [Stage(name, world_at(0.1), 4, NOTHING, bonus) for name in ("one", "two")]
    stages.append(Stage("plain", world_at(0.1), 1, NOTHING, {"bonus": [0.0, 0.0]}))
    with OnlineLoop(shaped_graph(), stages, tmp_path, optimizer=QUICK) as one:
        reports = list(one)
        assert [r.selections["skill"] for r in reports] == (["near"] * 2 + ["far"] * 2) * 2 + ["far"]
        assert [one.store.visits(i)[0].observed["bonus"][0] for i in range(9)] == [5.0, 5.0, 0.0, 0.0] * 2 + [0.0]
        for report in reports:
            paid = 5.0 if report.number % 4 < 2 and report.number < 8 else 0.0
            assert report.total == pytest.approx(paid - (report.known["y"] - 1.0) ** 2, rel=1e-12)
        assert one.perform(world_at(0.1), 0, {"bonus": [9.0, 0.0]}).selections == {"skill": "near"}
        words = "state 'bonus' is missing at the start: node 'aim', reward: ", "over as given="
        refuses(lambda: one.perform(world_at(0.1), 0), sg.InputError, *words)
        refuses(lambda: one.plan({"s": 0.1}), sg.InputError, "state 'bonus' is missing")
        assert one.plan({"s": 0.1, "bonus": [9.0, 0.0]}).selections == {"skill": "near"}


def test_what_is_given_must_be_states(tmp_path):
    for name, given, words in (
        ("typing error", {"bonos": [0.0, 0.0]}, "given: 'bonos' is no state; did you mean 'bonus'?"),
        ("action", {"u": 0.0}, "given: 'u' is no state"),
        ("nothing", lambda episode: None, "stage 'toy': given returned None for its episode 0; return {label: value}"),
        ("observed", {"bonus": [0.0, 0.0], "s": 0.1}, "given: 's' is what the world's reset observes; leave it out"),
        ("size", {"bonus": 1.0}, "given: 'bonus' = 1.0; the slot takes 2 finite numbers"),
        ("NaN", {"bonus": [0.0, np.nan]}, "given: 'bonus' = [0.0, nan]; the slot takes 2 finite numbers"),
        ("words", {"bonus": ["a", "b"]}, "given 'bonus' = ['a', 'b'] is not a number or an array of numbers"),
    ):
        with loop(tmp_path / name, shaped_graph(), world_at(0.1), given=given) as one:
            refuses(lambda one=one: list(one), sg.InputError, words)
            assert len(one.store) == 0
    refuses(lambda: Stage("toy", world_at(0.1), 1, NOTHING, [1.0]), sg.InputError, "'toy': given is [1.0]")
    for given in (dict, lambda episode, *more: {}):
        Stage("toy", world_at(0.1), 1, NOTHING, given)
    for given in (lambda: NOTHING, lambda episode, bonus: {}):
        words = "'toy': given is a function that cannot be called with the stage's episode alone"
        refuses(lambda given=given: Stage("toy", world_at(0.1), 1, NOTHING, given), sg.InputError, words)
    with loop(tmp_path / "perform", shaped_graph(), world_at(0.1)) as one:
        refuses(lambda: one.perform(world_at(0.1), 0, 3.0), sg.InputError, "given = 3.0; give {label: value}")


def test_more_episodes_in_the_last_stage_go_on_and_other_stages_are_refused(tmp_path):
    def stages(first, second, name="b"):
        return [Stage("a", world_at(0.1), first, NOTHING), Stage(name, world_at(0.2), second, NOTHING)]

    def made(*counts):
        return OnlineLoop(kick_graph(), stages(*counts), tmp_path, optimizer=QUICK)

    with made(2, 2) as one:
        list(one)
    with made(2, 3) as one:
        assert [(report.number, report.setup) for report in one] == [(4, "b")]
    words = (
        f"{tmp_path / 'episodes.sqlite'}: episode 2 is of stage 'b', but the stages have stage 'a' there; give those"
    )
    refuses(lambda: made(3, 3), sg.InputError, words)
    refuses(lambda: made(2, 3, "c"), sg.InputError, "episode 2 is of stage 'b', but the stages have stage 'c' there")
    refuses(
        lambda: made(2, 2), sg.InputError, "episode 4 is of stage 'b', but the stages have no such episode; give those"
    )
    made(2, 3).close()  # whatever was refused has let go of the folder


@pytest.mark.parametrize(
    ("change", "changed"),
    [
        ({"seed": 1}, "seed"),
        ({"remembered": 3}, "remembered"),
        ({"again": "near_end"}, "again"),
        ({"again": "near_end", "attempts": 2}, "attempts"),
    ],
)
def test_other_settings_are_refused(tmp_path, change, changed):
    with loop(tmp_path, kick_graph(), kicking(), 1) as one:
        list(one)
    refuses(
        lambda: loop(tmp_path, kick_graph(), kicking(), 2, **change),
        sg.InputError,
        "already has settings",
        f"{changed!r}",
    )
    other = kick_graph(Spy({"s": 1, "u": 1}, {"y": 1}, "near"))
    words = "others for 'learned': learned['near']['reads'] is stored in the order 'u', 's', given in the order 's'"
    refuses(lambda: loop(tmp_path, other, kicking(), 2), sg.InputError, words)
    changed = kick_graph()
    changed.groups["aim"][0].branches[0].model.learner.settings["decay"] = 0.5
    words = "with others for 'learned': learned['near']['decay'] is stored as nothing, given as 0.5. Go on with those"
    refuses(lambda: loop(tmp_path, changed, kicking(), 2), sg.InputError, words)
    # "aim" is where the graph starts, so it is decided there anyway
    with loop(tmp_path, kick_graph(), kicking(), 1, decisions=["aim"]):
        pass
    more = kick_graph(w=sg.State())
    words = "has settings, with others for 'slots': slots['w'] is stored as nothing, given as", "State(size=1"
    refuses(lambda: loop(tmp_path, more, kicking(), 2), sg.InputError, *words)


def test_two_loops_in_one_folder_are_refused(tmp_path):
    code = "try: EpisodeStore(sys.argv[1])\nexcept Exception as error: print(error)"
    with loop(tmp_path, kick_graph(), kicking(), 2) as one:
        next(iter(one))
        before = told(one.store)
        refuses(lambda: loop(tmp_path, kick_graph(), kicking(), 2), sg.StorageError, "is being written by this process")
        said = output_of(script(code, str(one.folder / "episodes.sqlite")))
        assert f"is being written by process {os.getpid()}" in said
        assert told(one.store) == before
        assert [report.number for report in one] == [1]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"decisions": "aim"}, "decisions = 'aim'; give a list of nodes"),
        ({"decisions": ["aime"]}, "decisions: 'aime' is no node of the graph; did you mean 'aim'?"),
        (
            {"decisions": ["near_end"]},
            "decisions: the graph ends at 'near_end', so there is nothing to decide; leave it",
        ),
        ({"again": "near"}, "again: 'near' is no node of the graph; did you mean 'near_end'?"),
        ({"again": "aim"}, "again: branches lead on from 'aim'; give a node at which the graph ends"),
        ({"attempts": 0}, "attempts is 0; give a positive whole number"),
        ({"attempts": 2}, "attempts = 2, but nothing leads back"),
        ({"remembered": -1}, "remembered = -1; give a whole number from 0"),
        ({"seed": -1}, "seed = -1; give a whole number from 0"),
        ({"seed": 0.5}, "seed = 0.5; give a whole number from 0"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(tmp_path, options, words):
    refuses(lambda: loop(tmp_path, kick_graph(), kicking(), 1, **options), sg.InputError, words)
    assert not list(tmp_path.iterdir())


def test_stages_and_folders_that_do_not_fit_are_refused(tmp_path):
    stage = Stage("toy", kicking(), 1)
    for stages in (stage, [], [stage, "toy"]):
        refuses(lambda stages=stages: OnlineLoop(kick_graph(), stages, tmp_path), sg.InputError, "give a list of Stage")
    twins = [stage, Stage("other", kicking(), 1), Stage("toy", kicking(), 2)]
    words = "stages[0] and stages[2] are both named 'toy'; give each a name of its own"
    refuses(lambda: OnlineLoop(kick_graph(), twins, tmp_path), sg.InputError, words)
    (tmp_path / "file").touch()
    refuses(
        lambda: OnlineLoop(kick_graph(), [stage], tmp_path / "file"),
        sg.StorageError,
        "file cannot be made: File exists",
    )
    refuses(lambda: OnlineLoop(kick_graph(), [stage], None), sg.StorageError, "path = None")
    for name, world, episodes, words in (
        ("", kicking(), 1, "Stage: name is ''"),
        ("toy", Spy({"u": 1}, {"y": 1}, "x"), 1, "which has no method 'reset'"),
        ("toy", kicking(), 0, "episodes = 0; give a positive whole number"),
        ("toy", kicking(), True, "episodes = True"),
    ):
        refuses(lambda name=name, world=world, n=episodes: Stage(name, world, n), sg.InputError, words)
    refuses(lambda: Stage("toy", kicking(), 1, 0.5), sg.InputError, "explore is 0.5; give an Exploration")


def test_numpys_numbers_are_numbers(tmp_path):
    with loop(tmp_path, kick_graph(), kicking(), np.int64(2), seed=np.int64(3)) as one:
        plans = [one.store.plans(report.number) for report in one]
    with loop(tmp_path / "other", kick_graph(), kicking(), 2, seed=3) as one:
        assert [one.store.plans(report.number) for report in one] == plans


def test_the_cost_of_an_episode_does_not_grow_with_their_number(tmp_path):
    """Neither the count of what is over nor the search for what is next reads all episodes."""
    with loop(tmp_path, kick_graph(), Scripted({"s": 0.2}, {"aim": {"far_end": {"y": 1.0}}}), 30) as one:
        read = []
        decoded = one.store._decoded
        one.store._decoded = lambda decode, cells: read.append(1) or decoded(decode, cells)
        counts = []
        for _ in one:
            assert one.done == len(counts) + 1
            counts.append(len(read))
            read.clear()
    assert counts == [0] * 30
