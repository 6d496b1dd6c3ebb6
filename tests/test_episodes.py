"""The episode store: what goes in comes back, whatever happens to the process; what cannot be is refused by name."""

import contextlib
import itertools
import math
import os
import pickle
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_tasks import refuses

import symgraph as sg
from symgraph.learned import Episode, EpisodeStore, Visit, episodes

ROOT = Path(__file__).parents[1]


def script(code, *arguments, **options):
    """Start Python with code that finds this symgraph."""
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-c", f"import os, sys\nfrom symgraph.learned import EpisodeStore, Visit\n{code}", *arguments],
        env=os.environ | {"PYTHONPATH": paths},
        stdout=subprocess.PIPE,
        text=True,
        **options,
    )


def output_of(process):
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    return out


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.db"


@pytest.fixture
def store(path):
    with EpisodeStore(path) as store:
        yield store


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """A store for many examples, and numbers of episodes for it."""
    with EpisodeStore(tmp_path_factory.mktemp("store") / "run.db") as store:
        yield store, itertools.count()


def visit(step, parent=0, node="a", episode=0, observed=None, actions=None, selections=None, reward=0.0):
    return Visit(episode, step, parent, node, observed or {}, actions or {}, selections or {}, reward)


def grown(store):
    """An episode of a grasp, two attempts and what each of two groups observed."""
    store.begin(0, "water", 7, {"amount": 0.0, "position": [1.0, 2.0]}, reward=-0.5, node="start")
    store.add([visit(1, 0, "grasped", observed={"height": 0.25}, actions={"ratio": 0.5})])
    pour = {"actions": {"rate": [0.1, 0.2]}, "selections": {"skill": "tip"}}
    store.add(
        [
            visit(2, 1, "poured", observed={"amount": 0.3}, **pour, reward=-1.0),
            visit(3, 1, "moved", observed={"position": [1.5, 2.0]}, **pour),
        ]
    )
    store.add([visit(4, 2, "poured", observed={"amount": 0.4, "height": 0.125}, reward=-0.25)])


# What goes in comes back

LABELS = st.text(min_size=1, max_size=8) | st.sampled_from(["'; DROP TABLE visits; --", '"', "%s", "größe", "a\0b"])
FLOATS = st.floats()
VALUES = st.dictionaries(LABELS, FLOATS | st.lists(FLOATS, min_size=1, max_size=4).map(np.array), max_size=4)


@given(LABELS, LABELS, VALUES, VALUES, st.dictionaries(LABELS, LABELS, max_size=3), FLOATS)
def test_visits_come_back(shared, node, setup, observed, actions, selections, reward):
    store, numbers = shared
    number = next(numbers)
    first = store.begin(number, setup, number, observed, reward, node=node)
    assert first == Visit(number, 0, None, node, observed, {}, {}, reward)
    second = Visit(number, 1, 0, node, observed, actions, selections, reward)
    store.add([second])
    with EpisodeStore(store._database.path, read_only=True) as reader:
        assert reader.visits(number) == [first, second]
        assert reader.visits(number, setup=setup, node=[node]) == [first, second]
        assert [episode.setup for episode in reader.episodes(setup=[setup])][-1] == setup


@given(FLOATS, FLOATS)
def test_equal_visits_have_equal_bits(a, b):
    same = (math.isnan(a) and math.isnan(b)) or (a == b and math.copysign(1, a) == math.copysign(1, b))
    assert (visit(1, reward=a) == visit(1, reward=b)) == same
    assert (visit(1, observed={"x": a}) == visit(1, observed={"x": b})) == same
    assert visit(1, observed={"x": a}) != visit(1, observed={"x": np.array([a])})
    assert visit(1, observed={"x": np.array([a])}) != visit(1, observed={"x": np.array([a, a])})


@pytest.mark.parametrize(
    "given",
    [3, True, -0.0, 2**80, np.float32(0.1), np.int8(-3), np.array(0.1), np.float64(0.1), np.bool_(True)],
    ids=repr,
)
def test_a_number_comes_back_as_a_float(store, given):
    store.begin(0, "s", 0, {"x": given})
    value = store.visits()[0].observed["x"]
    assert type(value) is float
    assert value == given
    assert math.copysign(1, value) == math.copysign(1, given)


@pytest.mark.parametrize(
    "given", [[1], [1, 2.5], (0.1,), np.array([1, 2], np.int16), np.array([0.1], np.float32), np.ones((3, 1))], ids=repr
)
def test_a_list_or_an_array_comes_back_as_an_array(store, given):
    store.begin(0, "s", 0, {"x": given})
    value = store.visits()[0].observed["x"]
    assert value.dtype == np.float64
    assert np.array_equal(value, np.ravel(given).astype(float))


def test_what_is_stored_does_not_change_with_the_array_that_was_given(store):
    array = np.array([1.0, 2.0])
    first = store.begin(0, "s", 0, {"x": array})
    array[:] = 0.0
    store.known(first)["x"][:] = 0.0
    assert first.observed["x"].tolist() == store.known(first)["x"].tolist() == [1.0, 2.0]


def test_episodes_come_back(store):
    store.begin(5, "water", 7, {})
    store.begin(2, "paste", 2**63 - 1, {})
    store.begin(3, "water", np.int64(8), {})
    store.end(5, "failed", total=math.nan, reason="it 'fell'", seconds={"planning": 0.1}, info={"skill": ["tip", None]})
    store.end(3, "done", total=-0.0)
    two, three, five = store.episodes()
    assert (two.number, two.setup, two.seed, two.status) == (2, "paste", 2**63 - 1, "running")
    assert (two.total, two.reason, two.seconds, two.info, two.ended) == (None, "", {}, {}, None)
    assert (three.seed, three.total, math.copysign(1, three.total)) == (8, 0.0, -1.0)
    assert math.isnan(five.total)
    assert (five.reason, five.seconds, five.info) == ("it 'fell'", {"planning": 0.1}, {"skill": ["tip", None]})
    assert two.begun.endswith("+00:00")
    assert five.begun <= five.ended
    assert isinstance(five, Episode)

    def numbers(**narrow):
        return [episode.number for episode in store.episodes(**narrow)]

    assert numbers(setup="water") == [3, 5]
    assert numbers(setup=["water", "paste"], status=("running", "done")) == [2, 3]
    assert numbers(setup=[]) == numbers(setup="'") == []
    assert len(store) == 3


def test_visits_are_narrowed_and_ordered(store):
    grown(store)
    store.begin(1, "paste", 0, {})
    assert [(v.episode, v.step) for v in store.visits()] == [(0, 0), (0, 1), (0, 2), (0, 3), (0, 4), (1, 0)]
    assert [v.step for v in store.visits(node="poured")] == [2, 4]
    assert [v.step for v in store.visits(0, setup=["water"], node=("moved", "start"))] == [0, 3]
    assert store.visits(1, setup="water") == store.visits(9) == []


def test_known_follows_the_path(store):
    grown(store)
    known = {v.step: store.known(v) for v in store.visits()}
    paths = {0: [0], 1: [0, 1], 2: [0, 1, 2], 3: [0, 1, 3], 4: [0, 1, 2, 4]}
    seen = {v.step: v.observed for v in store.visits()}
    for step, path in paths.items():
        expected = {}
        for at in path:
            expected |= seen[at]
        assert visit(1, observed=known[step]) == visit(1, observed=expected)
    assert known[4]["amount"] == 0.4
    assert known[3]["amount"] == 0.0

    new = visit(5, 4, observed={"amount": 0.5})
    assert store.known(new)["height"] == 0.125  # not stored yet
    store.add([new])
    assert store.known(visit(6, 5))["amount"] == 0.5
    store.begin(1, "water", 0, {"amount": 9.0})
    assert store.known(visit(1, episode=1)) == {"amount": 9.0}
    refuses(lambda: store.known(visit(9, 8)), sg.InputError, "episode 0 has no step 8", "add that visit first")


def test_plans_come_back_and_the_last_one_counts(store):
    grown(store)
    store.note_plan(0, 1, {"value": 1.0})
    plan = {
        "actions": {"rate": np.array([0.1, 0.2])},
        "value": np.float64(-1.5),
        "status": "converged",
        "tried": (1, 2),
    }
    store.note_plan(0, 1, plan)
    store.note_plan(0, 0, {"value": math.inf})
    assert store.plans(0) == {
        0: {"value": math.inf},
        1: {"actions": {"rate": [0.1, 0.2]}, "value": -1.5, "status": "converged", "tried": [1, 2]},
    }
    assert list(store.plans(0)) == [0, 1]
    assert store.plans(1) == {}


def test_settings_are_written_once(store, path):
    assert store.settings == {}
    store.set_settings({"world": "pouring", "rates": np.array([0.5]), "limit": math.nan})
    store.set_settings({"limit": math.nan, "rates": [0.5], "world": "pouring"})
    assert store.settings["rates"] == [0.5]
    refuses(
        lambda: store.set_settings({"world": "cannon", "limit": math.nan}),
        sg.InputError,
        f"{path} already has settings",
        "'world', 'rates'",
        "another path",
    )
    assert store.settings["world"] == "pouring"


def test_an_old_store_goes_on_and_opening_changes_nothing(path):
    with EpisodeStore(path) as store:
        grown(store)
        before = store.visits()
    bytes_before = path.read_bytes()
    with EpisodeStore(path) as store:
        assert store.visits() == before
        assert store.episodes()[0].status == "running"
        assert repr(store) == f"<EpisodeStore {str(path)!r}, 1 episodes>"
    assert path.read_bytes() == bytes_before
    with EpisodeStore(path) as store:
        store.add([visit(5, 4)])
        store.end(0, "interrupted")
    assert repr(store) == f"<EpisodeStore {str(path)!r}, closed>"
    assert sorted(file.name for file in path.parent.iterdir()) == ["run.db", "run.db-lock"]


def test_strange_paths_and_links_lead_to_the_file_they_name(tmp_path):
    name = tmp_path / "a?mode=memory#%41 ü'.db"
    with EpisodeStore(name) as store:
        store.begin(0, "s", 0, {})
        (tmp_path / "link").symlink_to(name)
        refuses(lambda: EpisodeStore(tmp_path / "link"), sg.StorageError, "being written by this process")
    assert name.exists()
    with EpisodeStore(tmp_path / "link", read_only=True) as store:
        assert len(store) == 1


# Wrong values and wrong order


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ("0.5", "is not a number or an array of numbers; give a float"),
        (None, "= None is not a number"),
        (object(), "is not a number"),
        ([1.0, [2.0]], "is not a number"),
        ([1.0, "2"], "is not a number"),
        (1j, "is not a number"),
        (10**400, "is not a number"),
        ({"x": 1.0}, "is not a number"),
        ([], "is empty"),
        (np.ones((2, 2)), "has shape (2, 2); give a number or a 1-D array"),
    ],
    ids=repr,
)
def test_wrong_values_are_refused_by_name(store, wrong, words):
    place = "episode 0, step {}: {} 'amount'".format
    refuses(lambda: store.begin(0, "s", 0, {"amount": wrong}), sg.InputError, place(0, "observed"), words)
    assert len(store) == 0
    store.begin(0, "s", 0, {})
    good = visit(1)
    refuses(lambda: store.add([good, visit(2, observed={"amount": wrong})]), sg.InputError, place(2, "observed"), words)
    refuses(lambda: store.add([good, visit(2, actions={"amount": wrong})]), sg.InputError, place(2, "action"), words)
    assert [v.step for v in store.visits()] == [0]


def test_wrong_names_and_numbers_are_refused(store):
    store.begin(0, "s", 0, {})
    place = "episode 0, step 1: "
    for wrong, *words in (
        (visit(1, node=""), place + "node is ''", "non-empty string"),
        (visit(1, node=3), place + "node is 3"),
        (visit(1, node="\ud800"), place + "node holds '\\ud800', which is no character"),
        (visit(1, observed={"": 1.0}), place + "a label of observed is ''"),
        (visit(1, actions={2: 1.0}), place + "a label of action is 2"),
        (visit(1, observed=[1.0]), place + "observed = [1.0]; give a mapping of labels"),
        (visit(1, selections={"skill": 1}), place + "the choice of selection 'skill' is 1"),
        (visit(1, reward="1"), place + "reward = '1' is not a number"),
        (visit(1, reward=[1.0, 2.0]), place + "reward has 2 elements; give one number"),
        (visit(-1), "step of a visit = -1; give a whole number"),
        (visit(1.0), "step of a visit = 1.0; give a whole number"),
        (visit(2**63), "give a whole number from 0 to 2⁶³ - 1"),
        (visit(1, None), place + "parent = None"),
        (visit(0, 0), "episode 0, step 0: parent = 0"),
        (visit(1, 1), place + "parent = 1; a parent is reached earlier"),
        ("a", "'a' is no Visit"),
    ):
        refuses(lambda wrong=wrong: store.add([wrong]), sg.InputError, *words)
    refuses(lambda: store.add(visit(1)), sg.InputError, "visits = Visit(", "give a list of Visit")
    refuses(lambda: store.add(None), sg.InputError, "visits = None")
    refuses(lambda: store.begin(True, "s", 0, {}), sg.InputError, "number of the episode = True")
    refuses(lambda: store.begin(1, "", 0, {}), sg.InputError, "episode 1: setup is ''")
    refuses(lambda: store.begin(1, "s", -1, {}), sg.InputError, "episode 1: seed = -1; give a whole number")
    refuses(lambda: store.begin(1, "s", 0, None), sg.InputError, "episode 1, step 0: observed = None; give a mapping")
    refuses(lambda: store.visits(-1), sg.InputError, "episode = -1")
    refuses(lambda: store.episodes(status=[1]), sg.InputError, "status is 1; give a non-empty string")
    assert len(store.visits()) == 1
    store.add([])


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"a": {"b": object()}}, "['a']['b'] = <object"),
        ({"a": [0, {1}]}, "['a'][1] = {1}, which JSON cannot hold"),
        ({"a": {1: 2}}, "['a']: name 1 is not a string"),
        ({"a": np.array(["x"])}, "['a'] = array(['x']"),
        ({"a": 10**5000}, "digits"),
        ([1], "= [1]; give a mapping"),
    ],
    ids=["object", "set", "name", "strings", "digits", "list"],
)
def test_what_json_cannot_hold_is_refused(store, wrong, words):
    store.begin(0, "s", 0, {})
    refuses(lambda: store.set_settings(wrong), sg.InputError, "settings", words)
    refuses(lambda: store.note_plan(0, 0, wrong), sg.InputError, "episode 0, step 0: plan", words)
    refuses(lambda: store.end(0, "done", info=wrong), sg.InputError, "episode 0: info", words)
    assert store.settings == store.plans(0) == {}
    assert store.episodes()[0].status == "running"


def test_a_mapping_that_holds_itself_is_refused(store):
    endless = {}
    endless["a"] = endless
    refuses(lambda: store.set_settings(endless), sg.InputError, "settings is nested too deeply, or holds itself")


def test_wrong_order_is_refused_and_stores_nothing(store, path):
    refuses(lambda: store.add([visit(1)]), sg.InputError, "there is no episode 0 to add to; call begin first")
    refuses(lambda: store.end(0, "done"), sg.InputError, "there is no episode 0 to end")
    store.begin(0, "s", 0, {})
    refuses(
        lambda: store.begin(0, "s", 0, {}), sg.InputError, f"episode 0 is already in {path}; the next free number is 1"
    )
    store.add([visit(1)])
    refuses(lambda: store.add([visit(2), visit(1)]), sg.InputError, "episode 0, step 1 is already there")
    refuses(lambda: store.add([visit(2), visit(2)]), sg.InputError, "episode 0, step 2 is already there")
    refuses(
        lambda: store.add([visit(2), visit(5, 4)]),
        sg.InputError,
        "episode 0, step 5: parent 4 is no step of this episode; add the parent first",
    )
    refuses(lambda: store.add([visit(2), visit(1, episode=3)]), sg.InputError, "there is no episode 3")
    assert [v.step for v in store.visits()] == [0, 1]
    store.add([visit(2), visit(3, 2)])  # a parent of the same call

    refuses(lambda: store.note_plan(0, 9, {}), sg.InputError, "episode 0 has no step 9", "add its visit first")
    refuses(lambda: store.end(0, "doen"), sg.InputError, "status 'doen'", "did you mean 'done'?", "'interrupted'")
    refuses(lambda: store.end(0, "running"), sg.InputError, "status 'running' is none of its options")
    refuses(lambda: store.end(0, "done", total="x"), sg.InputError, "episode 0: total = 'x' is not a number")
    refuses(lambda: store.end(0, "done", reason=None), sg.InputError, "episode 0: reason is None; give a string")
    refuses(lambda: store.end(0, "done", seconds={"a": "b"}), sg.InputError, "episode 0: seconds of 'a'")
    store.end(0, "done")
    words = "episode 0: it has ended (done); begin another one"
    refuses(lambda: store.end(0, "done"), sg.InputError, "cannot end " + words)
    refuses(lambda: store.add([visit(4)]), sg.InputError, "cannot add to " + words)
    refuses(lambda: store.note_plan(0, 0, {}), sg.InputError, "cannot note a plan in " + words)


# One writer, many readers


def test_a_second_writer_is_refused(store, path):
    for _ in range(2):
        refuses(
            lambda: EpisodeStore(path), sg.StorageError, f"{path} is being written by this process", "read_only=True"
        )
    code = "try: EpisodeStore(sys.argv[1])\nexcept Exception as error: print(type(error).__name__, error)"
    said = output_of(script(code, str(path)))
    assert said.startswith(f"StorageError {path} is being written by process {os.getpid()}, and it can have only one")
    store.begin(0, "s", 0, {})
    store.close()
    store.close()
    EpisodeStore(path).close()


def test_a_store_that_nobody_holds_gives_up_its_lock(path):
    EpisodeStore(path)
    with EpisodeStore(path) as store:
        store.begin(0, "s", 0, {})


def test_a_reader_cannot_write_and_a_closed_store_does_nothing(store, path):
    store.begin(0, "s", 0, {})
    with EpisodeStore(path, read_only=True) as reader:
        for write in (
            lambda: reader.begin(1, "s", 0, {}),
            lambda: reader.add([visit(1)]),
            lambda: reader.end(0, "done"),
            lambda: reader.note_plan(0, 0, {}),
            lambda: reader.set_settings({}),
        ):
            refuses(write, sg.StorageError, f"{path} was opened with read_only=True")
        assert "1 episodes, read only" in repr(reader)
        store.add([visit(1)])
        assert len(reader.visits()) == 2
        store.close()
        assert len(reader.visits()) == 2
    for call in (reader.visits, reader.episodes, lambda: len(reader), lambda: store.begin(1, "s", 0, {})):
        refuses(call, sg.StorageError, f"{path} is closed; open it again")


def test_a_reader_makes_nothing(tmp_path):
    refuses(
        lambda: EpisodeStore(tmp_path / "none", read_only=True),
        sg.StorageError,
        "none does not exist",
        "leave out read_only",
    )
    (tmp_path / "empty").touch()
    refuses(lambda: EpisodeStore(tmp_path / "empty", read_only=True), sg.StorageError, "is empty; wait until a writer")
    assert [file.name for file in tmp_path.iterdir()] == ["empty"]
    assert (tmp_path / "empty").stat().st_size == 0
    EpisodeStore(tmp_path / "empty").close()
    EpisodeStore(tmp_path / "empty", read_only=True).close()


def test_a_store_stays_in_its_thread_and_its_process(store, path):
    caught = []

    def use():
        try:
            store.visits()
        except sg.StorageError as error:
            caught.append(str(error))

    thread = threading.Thread(target=use)
    thread.start()
    thread.join()
    assert "was opened by another thread; use it there" in caught[0]
    refuses(lambda: pickle.dumps(store), sg.InputError, "hand on its path", str(path))


FORKS = """
def attempt(what):
    try: what()
    except Exception as error: print(type(error).__name__, error, flush=True)
path = sys.argv[1]
store = EpisodeStore(path)
if os.fork() == 0:
    attempt(store.visits)
    attempt(lambda: store.begin(0, "s", 0, {}))
    attempt(lambda: EpisodeStore(path, read_only=True))
    store.close()
    os._exit(0)
os.wait()
store.begin(0, "s", 0, {})
if os.fork() == 0:
    os.close(1)
    sys.stdin.read()
    os._exit(0)
print("child is there", flush=True)
os.kill(os.getpid(), 9)
"""


def test_a_forked_child_neither_uses_nor_keeps_the_store(path):
    process = script(FORKS, str(path), stdin=subprocess.PIPE)
    lines = process.stdout.read().splitlines()
    assert len(lines) == 4
    assert all(line.startswith(f"StorageError {path} was open") for line in lines[:3])
    assert all("start processes anew" in line for line in lines[:3])
    assert process.wait(60) == -9
    with EpisodeStore(path) as store:  # although the second child still lives
        assert len(store) == 1
    process.stdin.close()
    process.stdout.close()


STEADY = """
store = EpisodeStore(sys.argv[1])
store.begin(0, "s", 0, {"x": 0.0})
print("begun", flush=True)
for step in range(1, 100000, 3):
    store.add([Visit(0, step + i, 0, "a", {"x": [float(step)] * 20}, {}, {}, 1.0) for i in range(3)])
"""


def test_a_reader_sees_whole_transactions_while_another_process_writes(path):
    process = script(STEADY, str(path))
    try:
        assert process.stdout.readline() == "begun\n"
        counts = []
        with EpisodeStore(path, read_only=True) as reader:
            start = time.monotonic()
            while time.monotonic() - start < 1.0:
                seen = reader.visits()
                assert [v.step for v in seen] == list(range(len(seen)))
                counts.append(len(seen))
        assert all(count % 3 == 1 for count in counts)
        assert counts == sorted(counts)
        assert counts[-1] > counts[0]
        assert process.poll() is None
        refuses(lambda: EpisodeStore(path), sg.StorageError, f"being written by process {process.pid}")
    finally:
        process.kill()
        process.communicate()
    with EpisodeStore(path) as store:
        assert len(store.visits()) >= counts[-1]


# A child writes as fast as it can and says what was stored; it is killed at a random moment. Then what it said must be
# there, every group of three whole, and the lock gone. Every third round begins with a new file, to hit that as well.
KILLS = """
import random, select, signal, sqlite3, time
folder, seed, rounds = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
rng = random.Random(seed)

def write(path, out):
    store = EpisodeStore(path)
    number = len(store)
    while True:
        store.begin(number, "s", 0, {"x": 0.0})
        os.write(out, b"%d 0;" % number)
        for step in range(1, 60, 3):
            store.add([Visit(number, step + i, step - 1, "a", {"x": [0.1] * 50}, {}, {}, 1.0) for i in range(3)])
            os.write(out, b"%d %d;" % (number, step + 2))
        store.note_plan(number, 0, {"value": 1.0})
        store.end(number, "done", total=60.0)
        number += 1

path, total = None, 0
for round in range(rounds):
    if round % 3 == 0:
        path, told = f"{folder}/{round}.db", set()
    end, out = os.pipe()
    child = os.fork()
    if child == 0:
        write(path, out)
    os.close(out)
    deadline, said = time.monotonic() + rng.uniform(0.0, 0.25 if round % 3 else 0.06), b""
    while (left := deadline - time.monotonic()) > 0:
        if select.select([end], [], [], left)[0]:
            said += os.read(end, 65536)
    os.kill(child, signal.SIGKILL)
    assert os.WTERMSIG(os.waitpid(child, 0)[1]) == signal.SIGKILL
    while more := os.read(end, 65536):
        said += more
    os.close(end)
    told |= {tuple(map(int, pair.split())) for pair in said.split(b";")[:-1]}
    if told and round % 2:  # whoever comes first has to recover the log
        with EpisodeStore(path, read_only=True) as reader:
            assert told <= {(v.episode, v.step) for v in reader.visits()}
    with EpisodeStore(path) as store:
        found = {(v.episode, v.step) for v in store.visits()}
        assert told <= found, told - found
        for episode in store.episodes():
            steps = [v.step for v in store.visits(episode.number)]
            assert steps == list(range(len(steps))) and len(steps) % 3 == 1
            assert episode.status == "running" or (len(steps) == 61 and store.plans(episode.number))
        total += len(found)
    with sqlite3.connect(path) as raw:
        assert raw.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    raw.close()
print(total)
"""


def test_what_was_stored_survives_sigkill_at_any_moment(tmp_path):
    total = int(output_of(script(KILLS, str(tmp_path), "0", "24")))
    print(f"{total} visits looked at")
    assert total > 1000


# Files that are something else


@pytest.fixture
def held(path):
    """The path of a store with an episode of 200 visits, closed."""
    with EpisodeStore(path) as store:
        store.begin(0, "s", 0, {"x": 1.0})
        store.add([visit(step, observed={"x": [float(step)] * 30}) for step in range(1, 200)])
    return path


def both(path, *words):
    for read_only in (False, True):
        refuses(lambda read_only=read_only: EpisodeStore(path, read_only=read_only), sg.StorageError, str(path), *words)


def execute(path, *statements):
    raw = sqlite3.connect(path)
    with raw:
        for statement in statements:
            raw.execute(statement)
    raw.close()


def test_what_cannot_be_a_file_is_refused(tmp_path, held):
    both(tmp_path, "is a folder or a device, not a file")
    both("/dev/zero", "is a folder or a device")
    both(tmp_path / "none" / "run.db", f"the folder {tmp_path / 'none'} does not exist; make it first")
    both(held / "run.db", f"{held} is a file, not a folder")
    (tmp_path / "loop").symlink_to("loop")
    both(tmp_path / "loop", "cannot be opened")
    os.mkfifo(tmp_path / "pipe")
    both(tmp_path / "pipe", "not a file")
    refuses(lambda: EpisodeStore(None), sg.StorageError, "path = None is no path of a file")
    refuses(lambda: EpisodeStore("a\0b"), sg.StorageError, "is no path of a file")


def test_foreign_files_are_refused_and_left_alone(tmp_path):
    text, short, other, marked = (tmp_path / name for name in ("text", "short", "other", "marked"))
    text.write_text("episode,step\n" * 1000)
    short.write_text("no")
    execute(other, "CREATE TABLE mine (x)")
    execute(marked, "PRAGMA application_id = 77")
    before = {file: file.read_bytes() for file in (text, short, other, marked)}
    for file in (text, short):
        both(file, "is damaged: file is not a database", "take another copy")
    for file in (other, marked):
        both(file, "is an SQLite database of another program, not an episode store; give another path")
    assert before == {file: file.read_bytes() for file in tmp_path.iterdir()}  # no lock files either


def test_a_newer_version_is_refused(held):
    execute(held, f"PRAGMA user_version = {episodes.VERSION + 1}")
    both(
        held, f"has version {episodes.VERSION + 1} of an episode store, this symgraph knows {episodes.VERSION}; upgrade"
    )
    execute(held, "PRAGMA user_version = 0")
    both(held, "is damaged: it says it has version 0")


def test_a_damaged_file_is_refused(held):
    whole = held.read_bytes()
    held.write_bytes(whole[: len(whole) // 2])
    refuses(lambda: EpisodeStore(held), sg.StorageError, f"{held} is damaged", "take another copy")
    rng = np.random.default_rng(0)
    for _ in range(10):
        page = 4096 * int(rng.integers(1, len(whole) // 4096))
        held.write_bytes(whole[:page] + rng.bytes(4096) + whole[page + 4096 :])
        refuses(lambda: EpisodeStore(held), sg.StorageError, f"{held} is damaged", "take another copy")
        with EpisodeStore(held, read_only=True) as reader:  # which does not read it all to begin with
            with contextlib.suppress(sg.StorageError):
                assert len(reader.visits()) == 200
    held.write_bytes(whole)
    EpisodeStore(held).close()


@pytest.mark.parametrize(
    "change",
    [
        "UPDATE visits SET observed = '{'",
        "UPDATE visits SET observed = '[1.0]'",
        "UPDATE visits SET actions = '{\"x\": [[1.0]]}'",
        "UPDATE visits SET observed = '{\"x\": null}'",
        "UPDATE visits SET selections = 7",
        "UPDATE visits SET reward = 'much'",
        "UPDATE visits SET node = CAST(x'ff' AS TEXT)",
        "UPDATE visits SET parent = 1000 WHERE step = 5",
        "DROP TABLE visits",
    ],
)
def test_contents_that_make_no_sense_are_refused(held, change):
    execute(held, change)
    with EpisodeStore(held) as store:
        refuses(lambda: [store.known(v) for v in store.visits()], sg.StorageError, f"{held} is damaged")


def test_episodes_and_settings_that_make_no_sense_are_refused(held, tmp_path):
    execute(held, "UPDATE episodes SET info = 'x', total = 'y'", "INSERT INTO settings VALUES (1, '3')")
    with EpisodeStore(held, read_only=True) as store:
        for call in (store.episodes, lambda: store.settings, lambda: store.export(tmp_path / "x")):
            refuses(call, sg.StorageError, f"{held} is damaged", "is nothing that a store writes")


FORBIDDEN = """
folder = sys.argv[1]
EpisodeStore(f"{folder}/held").close()
os.chmod(f"{folder}/held", 0o444)
os.mkdir(f"{folder}/closed", 0o555)
EpisodeStore(f"{folder}/secret").close()
os.chmod(f"{folder}/secret", 0)
os.chmod(folder, 0o755)
if os.getuid() == 0:
    os.setuid(65534)  # root may do everything
for name, read_only in (("held", False), ("closed/new", False), ("secret", True)):
    try: EpisodeStore(f"{folder}/{name}", read_only=read_only)
    except Exception as error: print(type(error).__name__, error)
"""


def test_missing_permissions_are_named(tmp_path_factory):
    import tempfile

    with tempfile.TemporaryDirectory() as folder:  # pytest's own is closed to other users
        said = output_of(script(FORBIDDEN, folder)).splitlines()
        Path(folder, "closed").chmod(0o755)
    assert said[0] == (
        f"StorageError {folder}/held may not be written to by this user; change its permissions, or open it with "
        "read_only=True"
    )
    assert said[1].startswith(
        f"StorageError {folder}/closed/new: this user may not write to the folder {folder}/closed"
    )
    assert said[2] == f"StorageError {folder}/secret may not be read by this user; change its permissions"


def test_a_full_disk_loses_the_transaction_and_no_more(store, path):
    store.begin(0, "s", 0, {})
    store._database._connection.execute(f"PRAGMA max_page_count = {store._database._pragma('page_count') + 1}")
    big = [visit(step, observed={"x": [1 / 3] * 300}) for step in range(1, 20)]
    refuses(lambda: store.add(big), sg.StorageError, str(path), "full", "make room on the disk")
    assert len(store.visits()) == 1
    store._database._connection.execute("PRAGMA max_page_count = 100000")
    store.add(big)
    assert len(store.visits()) == 20


def test_a_database_that_another_program_locks_is_named(store, path, monkeypatch):
    store.begin(0, "s", 0, {})
    store._database._connection.execute("PRAGMA busy_timeout = 10")
    other = sqlite3.connect(path, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    refuses(lambda: store.add([visit(1)]), sg.StorageError, str(path), "locked", "end that one")
    other.execute("ROLLBACK")
    other.close()
    store.add([visit(1)])


# Export


def test_export_holds_every_visit(store, tmp_path):
    import pyarrow.parquet

    grown(store)
    store.begin(1, "paste", 8, {"amount": math.nan})
    store.end(0, "done", total=-1.75)
    target = tmp_path / "run.parquet"
    target.write_text("an older one")
    assert store.export(target) == 6
    table = pyarrow.parquet.read_table(target)
    about = ["episode", "setup", "seed", "status", "total", "step", "parent", "node", "reward"]
    assert table.column_names == [
        *about,
        "observed.amount",
        "observed.position[0]",
        "observed.position[1]",
        "observed.height",
        "action.ratio",
        "action.rate[0]",
        "action.rate[1]",
        "selection.skill",
    ]
    rows = table.to_pylist()
    whole = {e.number: e for e in store.episodes()}
    for row, v in zip(rows, store.visits(), strict=True):
        e = whole[v.episode]
        assert [row[name] for name in about] == [
            e.number, e.setup, e.seed, e.status, e.total, v.step, v.parent, v.node, v.reward
        ]  # fmt: skip
        expected = {f"selection.{label}": choice for label, choice in v.selections.items()}
        for prefix, values in (("observed", v.observed), ("action", v.actions)):
            for label, value in values.items():
                if isinstance(value, float):
                    expected[f"{prefix}.{label}"] = value
                else:
                    expected |= {f"{prefix}.{label}[{i}]": number for i, number in enumerate(value.tolist())}
        found = {name: cell for name, cell in row.items() if name not in about and cell is not None}
        assert repr(dict(sorted(found.items()))) == repr(dict(sorted(expected.items())))  # NaN is nan, not null
    assert sorted(file.name for file in tmp_path.iterdir() if "run.db" not in file.name) == ["run.parquet"]


def test_export_of_nothing_has_the_columns_of_every_table(store, tmp_path):
    import pyarrow.parquet

    assert store.export(tmp_path / "x") == 0
    assert pyarrow.parquet.read_table(tmp_path / "x").schema.field("seed").type == "int64"


def test_export_refuses_what_it_cannot_write(store, tmp_path, monkeypatch):
    store.begin(0, "s", 0, {"x": [1.0], "x[0]": 2.0})
    refuses(
        lambda: store.export(tmp_path / "x"), sg.InputError, "two labels lead to the column 'observed.x[0]': 'x[0]'"
    )
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    refuses(lambda: store.export(tmp_path / "x"), sg.MissingExtraError, "pip install 'symgraph[learned]'")
    assert not (tmp_path / "x").exists()


def test_export_names_paths_that_cannot_be(store, tmp_path):
    store.begin(0, "s", 0, {})
    refuses(lambda: store.export(None), sg.StorageError, "is no path of a file")
    refuses(lambda: store.export(tmp_path / "none" / "x"), sg.StorageError, "cannot be written: No such file")


# Speed


def test_ten_thousand_visits_are_read_at_once(store):
    store.begin(0, "s", 0, {})
    observed = {"position": np.arange(3) / 3, "amount": 0.1}
    for first in range(1, 10_000, 1000):
        store.add([visit(step, step - 1, observed=observed) for step in range(first, first + 1000)])
    start = time.perf_counter()
    visits = store.visits()
    read = time.perf_counter()
    for v in visits:
        store.known(v)
    print(f"{len(visits)} visits in {read - start:.2f} s, known in {time.perf_counter() - read:.2f} s")
    assert read - start < 2.0  # measured 0.2 s
    assert time.perf_counter() - read < 2.0  # measured 0.2 s
