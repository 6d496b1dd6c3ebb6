"""A loop that is killed at any moment and made anew ends, to the last bit, as one that was never killed."""

import collections
import json
import sys

import numpy as np
import pytest
from online_worlds import Spy, kick_graph, kicking, loop, told
from stored_episodes import ROOT, output_of, script
from stored_models import same

from symgraph.learned import EpisodeStore, Exploration, StochasticNetwork

EPISODES = 4
KILLS = 9
LONGEST = 900  # that all children together may take on a busy machine [s]

# A loop of two attempts an episode; every child runs it in the same folder, and says into a pipe what it begins:
# an edge, a plan, a fit. The parent kills it some time after the n-th beginning of a kind. Children are forks, because
# the imports would take longer than all the rest.
CODE = """
import json, random, select, signal, time
sys.path.insert(0, sys.argv[4])
import torch
import symgraph as sg
from online_worlds import QUICK, kick, kick_slots
from symgraph.learned import Exploration, OnlineLoop, Stage, StochasticNetwork, deciding
torch.set_num_threads(1)

class World:
    def __init__(self, say): self.say = say
    def reset(self, seed):
        self.s = seed % 1000 / 1000
        return {"s": self.s}
    def execute(self, node, actions, selections):
        self.say("edge", node)
        time.sleep(0.01)
        if node == "aim":
            return {selections["skill"] + "_end": {"y": kick(selections["skill"], actions["u"], self.s)}}
        if node != "stopped":
            return {"stopped": {"z": actions["u"] ** 2 + self.s}}
        self.s = 0.5 * self.s + 0.1
        return {"aim": {"s": self.s}}
    def close(self): pass

def run(folder, episodes, out):
    def say(what, where): os.write(out, json.dumps([what, where]).encode() + b"\\n")
    one = lambda name, y: StochasticNetwork({"u": 1, "s": 1}, {y: 1}, (16,), name=name)
    graph = sg.Graph(kick_slots(z=sg.State()), start="aim")
    near, far, slide = one("near", "y"), one("far", "y"), one("slide", "z")
    graph.choose("aim", "skill", {"near": ("near_end", near), "far": ("far_end", far)})
    for node in ("near_end", "far_end"):
        graph.edge(node, "stopped", slide)
        graph.reward(node, lambda y: -(y - 1.0) ** 2)
    graph.reward("stopped", lambda z: -0.1 * z)
    loop = OnlineLoop(
        graph, [Stage("toy", World(say), episodes, Exploration(episodes=4))], folder,
        again="stopped", attempts=2, optimizer=QUICK, seed=3,
    )
    solve, store = deciding.solve, loop.store
    def solving(*arguments, **options):
        say("plan", options["seed"])  # one for each episode and step
        time.sleep(0.01)
        return solve(*arguments, **options)
    deciding.solve = solving
    for network in (near, far, slide):
        def fit(x, y, *, network=network, fit=network.fit, **options):
            say("fit", [network.name, len(x)])
            return fit(x, y, **options)
        network.fit = fit
    say("open", store.episodes()[-1].number if len(store) else 0)
    for report in loop:
        say("over", report.number)
    loop.close()

def child(folder, episodes, out):
    process = os.fork()
    if process == 0:
        try:
            run(folder, episodes, out)
        except BaseException as error:
            os.write(out, json.dumps(["error", repr(error)]).encode() + b"\\n")
        os._exit(0)
    return process

def events(folder, episodes, kill=None, delay=0.0):
    end, out = os.pipe()
    process = child(folder, episodes, out)
    os.close(out)
    seen, killed = b"", kill is None
    while more := os.read(end, 65536):
        seen += more
        said = [json.loads(line)[0] for line in seen.split(b"\\n")[:-1]]
        if not killed and said.count(kill[0]) >= kill[1]:
            killed = True
            time.sleep(delay)
            os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    os.close(end)
    return [json.loads(line) for line in seen.split(b"\\n")[:-1]]

folder, episodes, kills = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
rng = random.Random(0)
lasts = {"edge": 0.007, "plan": 0.007, "fit": 0.2}  # [s]; roughly
whole = events(folder + "/whole", episodes)
rounds = []
for round in range(kills):
    what = list(lasts)[round % 3]
    kill = what, rng.randint(1, 2)
    rounds.append(events(folder + "/killed", episodes, kill, rng.uniform(0.0, 1.1) * lasts[what]))
rounds.append(events(folder + "/killed", episodes))
print(json.dumps([whole, rounds]))
"""


@pytest.mark.timeout(2 * LONGEST)
def test_a_killed_loop_ends_as_one_that_was_not(tmp_path):
    sys.stdout.flush()
    process = script(CODE, str(tmp_path), str(EPISODES), str(KILLS), str(ROOT / "tests"))
    whole, rounds = json.loads(output_of(process, LONGEST))
    killed_in = collections.Counter(events[-1][0] for events in rounds[:-1])
    print(f"killed after the beginning of: {dict(killed_in)}")
    assert len([events for events in rounds if events[-1] != ["over", EPISODES - 1]]) >= KILLS - 2
    assert set(killed_in) >= {"edge", "plan", "fit"}
    assert not [event for events in [whole, *rounds] for event in events if event[0] == "error"]

    # The same episodes, decisions, rewards and weights, to the last bit.
    stores = [EpisodeStore(tmp_path / name / "episodes.sqlite", read_only=True) for name in ("whole", "killed")]
    assert told(stores[0]) == told(stores[1])
    assert len(stores[0].visits()) == EPISODES * 6
    for name in ("near", "far", "slide"):
        a, b = (StochasticNetwork.load(tmp_path / folder / f"{name}.safetensors") for folder in ("whole", "killed"))
        same(a, b)

    # Plans and fits are made again only where they were under way, edges only in the episode that was.
    finished = -1
    for events in rounds:
        assert events[0][1] >= finished
        finished = max([finished, *(where for what, where in events if what == "over")])
    for kind in ("plan", "fit"):
        made = collections.Counter(str(where) for events in rounds for what, where in events if what == kind)
        expected = collections.Counter(str(where) for what, where in whole if what == kind)
        under_way = collections.Counter(str(events[-1][1]) for events in rounds[:-1] if events[-1][0] == kind)
        assert set(expected.values()) == {1}
        assert expected <= made <= expected + under_way
    edges = sum(what == "edge" for events in rounds for what, _ in events)
    assert edges <= EPISODES * 5 + KILLS * 5  # an episode has five edges


def then_interrupted(function, countdown):
    """The function, after which Ctrl-C comes when the countdown says so."""

    def wrapper(*arguments, **options):
        function(*arguments, **options)
        if next(countdown, False):
            raise KeyboardInterrupt

    return wrapper


@pytest.mark.parametrize("moment", ["begin", "note_plan", "add", "end", "fit", "save"])
@pytest.mark.parametrize("anew", [False, True])
def test_ctrl_c_just_after_something_was_done_changes_nothing(tmp_path, moment, anew):
    """In the loop itself, as in a notebook, and in one that is made anew."""

    def made(name):
        spies = [Spy({"u": 1, "s": 1}, {"y": 1}, skill) for skill in ("near", "far")]
        return loop(tmp_path / name, kick_graph(*spies), kicking(), 8, Exploration(1.0, 1.0, 0.1, episodes=6))

    def content(one):
        lessons = one._lessons.all.values()
        starts = [{label: np.array(value) for label, value in start.items()} for start in one._past.starts(8, "toy")]
        return (
            told(one.store),
            [(lesson.model.samples, np.array(lesson.x).tolist(), lesson.y) for lesson in lessons],
            starts,
            [(where.tolist(), made) for where, made in one._past.tries],
        )

    with made("whole") as one:
        list(one)
        expected = content(one)
    one, interrupts = made("stopped"), 0
    while one.done < 8:
        places = [one.store] if hasattr(one.store, moment) else [lesson.model for lesson in one._lessons.all.values()]
        countdown = iter([False, True])
        for place in places:
            setattr(place, moment, then_interrupted(getattr(place, moment), countdown))
        try:
            list(one)
        except KeyboardInterrupt:
            interrupts += 1
        for place in places:
            delattr(place, moment)
        if anew:
            one.close()
            one = made("stopped")
    assert interrupts >= 3
    with one:
        one._catch_up(8)  # as the next episode would
        assert content(one) == expected
