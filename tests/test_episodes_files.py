"""The episode store among processes, threads, forks and kills; files that are something else or damaged."""

import contextlib
import os
import pickle
import sqlite3
import subprocess
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from small_tasks import refuses
from stored_episodes import output_of, script, visit

import symgraph as sg
from symgraph.learned import EpisodeStore, episodes


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.db"


@pytest.fixture
def store(path):
    with EpisodeStore(path) as store:
        yield store


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
        both(file, "is no SQLite file, or its first bytes are damaged; give the path of an episode store")
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
        with EpisodeStore(held, read_only=True) as reader, contextlib.suppress(sg.StorageError):
            assert len(reader.visits()) == 200  # a reader does not read it all to begin with
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
        for call in (store.episodes, lambda: store.settings, lambda: store.export(tmp_path / "x.parquet")):
            refuses(call, sg.StorageError, f"{held} is damaged", "is nothing that a store writes")


FORBIDDEN = """
folder = sys.argv[1]
EpisodeStore(f"{folder}/held").close()
os.chmod(f"{folder}/held", 0o444)
os.mkdir(f"{folder}/closed", 0o555)
EpisodeStore(f"{folder}/secret").close()
os.chmod(f"{folder}/secret", 0)
os.mkdir(f"{folder}/shelf")
EpisodeStore(f"{folder}/shelf/run").close()
os.chmod(f"{folder}/shelf", 0o555)
os.chmod(folder, 0o755)
if os.getuid() == 0:
    os.setuid(65534)  # root may do everything
for name, read_only in (("held", False), ("closed/new", False), ("secret", True), ("shelf/run", True)):
    try: EpisodeStore(f"{folder}/{name}", read_only=read_only)
    except Exception as error: print(type(error).__name__, error)
"""


def test_missing_permissions_are_named(tmp_path_factory):
    with tempfile.TemporaryDirectory() as folder:  # pytest's own is closed to other users
        said = output_of(script(FORBIDDEN, folder)).splitlines()
        for name in ("closed", "shelf"):
            Path(folder, name).chmod(0o755)  # or their contents could not be removed
    assert said[0] == (
        f"StorageError {folder}/held may not be written to by this user; change its permissions, or open it with "
        "read_only=True"
    )
    assert said[1].startswith(
        f"StorageError {folder}/closed/new: this user may not write to the folder {folder}/closed"
    )
    assert said[2] == f"StorageError {folder}/secret may not be read by this user; change its permissions"
    assert said[3].startswith(f"StorageError {folder}/shelf/run: attempt to write a readonly database; SQLite's log")
    assert said[3].endswith("copy it to a folder that may be written to")


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
