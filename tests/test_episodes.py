"""The episode store: what goes in comes back, whatever happens to the process; what cannot be is refused by name."""

import itertools
import math
import sys
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_tasks import refuses
from stored_episodes import grown, visit

import symgraph as sg
from symgraph.learned import Episode, EpisodeStore, Visit


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
        "others for 'world', 'rates': world is stored as 'pouring', given as 'cannon'; rates is stored as [0.5], given",
        "another path",
    )
    assert store.settings["world"] == "pouring"


@pytest.mark.parametrize(
    ("stored", "given", "words"),
    [
        ({"a": {"b": 1, "c": [1, 2]}}, {"a": {"b": 1, "c": [1, 3]}}, "a['c'][1] is stored as 2, given as 3."),
        ({"a": [1, 2]}, {"a": [1, 2, "x"]}, "a[2] is stored as nothing, given as 'x'."),
        ({"a": {"b": 1}}, {"a": None}, "a is stored as {'b': 1}, given as None."),
        ({"a": {"b": 1, "c": 2}}, {"a": {"c": 2, "b": 1}}, "a is stored in the order 'b', 'c', given in the order 'c'"),
        ({"a": "x" * 999}, {}, f"a is stored as '{'x' * 119} …, given as nothing."),
    ],
    ids=["element", "longer", "kind", "order", "long"],
)
def test_settings_that_differ_are_shown_where_they_do(store, stored, given, words):
    store.set_settings(stored)
    refuses(lambda: store.set_settings(given), sg.InputError, words)


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

    assert store.export(tmp_path / "x.parquet") == 0
    assert pyarrow.parquet.read_table(tmp_path / "x.parquet").schema.field("seed").type == "int64"


def test_export_refuses_what_it_cannot_write(store, tmp_path, monkeypatch):
    store.begin(0, "s", 0, {"x": [1.0], "x[0]": 2.0})
    refuses(
        lambda: store.export(tmp_path / "x.parquet"),
        sg.InputError,
        "two labels lead to the column 'observed.x[0]': 'x[0]'",
    )
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    refuses(lambda: store.export(tmp_path / "x.parquet"), sg.MissingExtraError, "pip install 'symgraph[learned]'")
    assert not (tmp_path / "x.parquet").exists()


def test_export_names_paths_that_cannot_be(store, tmp_path):
    store.begin(0, "s", 0, {})
    refuses(lambda: store.export(None), sg.StorageError, "is no path of a file")
    for name in ("run.csv", "run"):
        words = "run", "the file will be in the format Parquet; give a name that ends in .parquet"
        refuses(lambda name=name: store.export(tmp_path / name), sg.InputError, *words)
    store.export(tmp_path / "RUN.PARQUET")
    refuses(lambda: store.export(tmp_path / "none" / "x.parquet"), sg.StorageError, "cannot be written: No such file")


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
