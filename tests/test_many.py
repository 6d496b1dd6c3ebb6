"""solve_many: the same plans as one by one, in processes, on a cluster, kept in a file, as a table, as a map."""

import fcntl
import json
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import casadi as ca
import distributed
import joblib
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from small_tasks import refuses

import symgraph as sg
from symgraph import many
from symgraph.plan_file import FORMAT

ROOT = Path(__file__).parents[1]
QUICK = sg.Lbfgs(starts=4)


def throw():
    """Reach x with one of two arms: the weak one ends at 2, the strong one costs something."""
    slots = {"u": sg.Action(2, low=-1, high=1), "arm": sg.Selection(["weak", "strong"]), "x": sg.State()}
    graph = sg.Graph(slots | {"y": sg.State()}, start="go")
    ways = {"weak": ("end", lambda u: {"y": u[0] + u[1]}), "strong": ("paid", lambda u: {"y": 3 * u[0]})}
    graph.choose("go", "arm", ways)
    graph.edge("paid", "end")
    graph.reward("paid", lambda: -0.3)
    graph.reward("end", lambda y, x, u: -((y - x) ** 2) - 0.1 * (u[0] ** 2 + u[1] ** 2) * x**0.5)
    return sg.Objective(sg.unroll(graph))


@pytest.fixture(scope="module")
def objective():
    return throw()


@pytest.fixture
def solved(monkeypatch):
    """The states that were planned for in this process."""
    states = []

    def noted(objective, state, *arguments, **options):
        states.append(state)
        return sg.solve(objective, state, *arguments, **options)

    monkeypatch.setattr(many, "solve", noted)
    return states


def states_of(count):
    return [{"x": x} for x in np.linspace(0.5, 4, count)]


def same(one, other):
    """All but the time."""
    assert one.columns.keys() == other.columns.keys()
    for name in one.columns.keys() - {"seconds"}:
        np.testing.assert_array_equal(one.columns[name], other.columns[name], err_msg=name)


def test_rows_are_the_plans_of_solve(objective):
    states = states_of(5)
    table = sg.solve_many(objective, states, QUICK, seed=3, processes=1)
    assert len(table) == 5
    for row, state in zip(table, states, strict=True):
        plan = sg.solve(objective, state, QUICK, seed=3)
        assert (row.value, row.selections, row.status) == (plan.value, plan.selections, plan.status)
        assert (row.deviation, row.violation) == (0.0, 0.0)
        np.testing.assert_array_equal(row.actions["u"], plan.actions["u"])
    assert [row.value for row in table[1:3]] == table.columns["value"][1:3].tolist()
    assert repr(table) == "<plans for 5 of 5 situations>"


@pytest.mark.parametrize("options", [{"fixed": {"arm": "weak"}}, {"guess": {"u": [0.5, 0.5]}}, {"time_limit": 10.0}])
def test_options_are_those_of_solve(objective, options):
    table = sg.solve_many(objective, states_of(3), QUICK, processes=1, **options)
    for row, state in zip(table, states_of(3), strict=True):
        assert row.value == sg.solve(objective, state, QUICK, **options).value


def test_two_processes_find_the_same(objective):
    states = states_of(40)
    same(
        sg.solve_many(objective, states, QUICK, processes=2),
        sg.solve_many(objective, states, QUICK, processes=1),
    )


def test_a_dask_cluster_finds_the_same(objective):
    states = states_of(12)
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster),
        joblib.parallel_config(backend="dask"),
    ):
        table = sg.solve_many(objective, states, QUICK)
    same(table, sg.solve_many(objective, states, QUICK, processes=1))


def test_what_is_in_the_file_is_not_planned_again(objective, solved, tmp_path):
    states = states_of(6)
    sg.solve_many(objective, states[:4], QUICK, processes=1, file=tmp_path / "plans")
    assert len(solved) == 4
    table = sg.solve_many(objective, states, QUICK, processes=1, file=tmp_path / "plans")
    assert solved == states
    same(table, sg.solve_many(objective, states, QUICK, processes=1))
    again = sg.solve_many(objective, states[::-1], QUICK, processes=1, file=tmp_path / "plans")
    assert len(solved) == 12  # nothing was left to do; the six are of the table without a file
    np.testing.assert_array_equal(again.columns["value"], table.columns["value"][::-1])
    assert isinstance(again[0].actions["u"], np.ndarray)


def test_equal_situations_are_planned_once(objective, solved):
    table = sg.solve_many(objective, [{"x": 1.0}, {"x": 2.0}, {"x": [1.0]}], QUICK, processes=1)
    assert len(solved) == 2
    assert table[0].value == table[2].value


def test_half_a_line_at_the_end_is_taken_away(objective, solved, tmp_path):
    file = tmp_path / "plans"
    sg.solve_many(objective, states_of(3), QUICK, processes=1, file=file)
    whole = file.read_bytes()
    for cut in (1, 20, len(whole) - len(whole.split(b"\n")[0]) // 2):
        file.write_bytes(whole[:-cut])
        before = len(solved)
        sg.solve_many(objective, states_of(3), QUICK, processes=1, file=file)
        assert len(solved) - before == (1 if cut < 100 else 3)
        assert len(file.read_bytes().splitlines()) == 4
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    assert lines[0]["format"] == FORMAT


def refused_file(objective, file, kind, *words, **options):
    """Planning into the file is refused, and it stays as it was."""
    before = file.read_bytes()
    call = {"optimizer": QUICK, "processes": 1, "file": file} | options
    refuses(lambda: sg.solve_many(objective, states_of(2), **call), kind, str(file), *words)
    assert file.read_bytes() == before


def test_a_file_of_another_objective_or_other_options_is_refused(objective, tmp_path):
    file = tmp_path / "plans"
    sg.solve_many(objective, states_of(2), QUICK, processes=1, file=file)
    for options in ({"seed": 1}, {"fixed": {"arm": "weak"}}, {"optimizer": sg.Ipopt()}, {"guess": {"u": [1, 1]}}):
        refused_file(objective, file, sg.InputError, f"begun with another {next(iter(options))};", **options)
    refused_file(sg.Objective(objective.tree, risk=1.0), file, sg.InputError, "begun with another objective and risk;")
    wider = throw()
    wider.graph.slots["u"] = sg.Action(2, low=-2, high=2)  # the expression is the same
    refused_file(wider, file, sg.InputError, "begun with another objective;")


def test_a_file_that_was_begun_with_other_weights(tmp_path):
    weight = sg.Parameter(0.3, "w")

    class Shift:
        reads, writes, parameters = ("u",), ("reward",), (weight,)

        def propagate(self, inputs):
            return {"reward": sg.Gaussian(-((inputs["u"].mean - weight.symbol) ** 2), ca.MX(1, 1))}

    graph = sg.Graph({"u": sg.Action(low=0.0, high=1.0)}, "a")
    graph.reward("a", Shift())
    objective, file = sg.Objective(sg.unroll(graph), compiled=False), tmp_path / "plans.jsonl"
    sg.solve_many(objective, [{}], QUICK, file=file, processes=1)
    weight.value = 0.4
    words = str(file), "begun with another set of weights;"
    refuses(lambda: sg.solve_many(objective, [{}], QUICK, file=file, processes=1), sg.InputError, *words)


def test_a_file_of_something_else_is_refused(objective, tmp_path):
    file = tmp_path / "plans"
    sg.solve_many(objective, states_of(2), QUICK, processes=1, file=file)
    begun = file.read_bytes()
    file.write_bytes(begun + b"{}\n")
    refused_file(objective, file, sg.StorageError, "line 4 is no row", "take the line away")
    for precious in (b"a diary\nof mine\n", b'{"precious": 1}', b'{"precious": 1}\n', b"[]\n"):
        file.write_bytes(precious)
        refused_file(objective, file, sg.StorageError, "is no file of plans")
    refuses(lambda: sg.solve_many(objective, states_of(2), QUICK, file=tmp_path), sg.StorageError, "give another file")


def test_a_call_that_is_refused_begins_no_file(objective, tmp_path):
    file = tmp_path / "plans"
    for options in ({"optimizer": sg.Lbfgs}, {"seed": -1}, {"fixed": {"arm": "both"}}):
        call = {"optimizer": QUICK, "processes": 1, "file": file} | options
        refuses(lambda call=call: sg.solve_many(objective, states_of(2), **call), sg.InputError)
    assert not file.exists()
    assert len(sg.solve_many(objective, states_of(2), QUICK, processes=1, file=file)) == 2


def test_the_same_said_otherwise_goes_on(objective, solved, tmp_path):
    """An order, what is the default, a guess that was planned anew."""
    states = [{"x": 1.0}, {"x": sg.Gaussian(1.5, sd=0.1)}, {"x": 2.0}]
    for k, options in enumerate(({}, {"fixed": {}}, {"optimizer": None}, {"seed": np.int64(0)})):
        call = {"optimizer": sg.Lbfgs(), "processes": 1, "file": tmp_path / "plans"} | options
        sg.solve_many(objective, states[::-1] if k else states[:2], **call)
    assert len(solved) == 3
    for _ in range(2):
        guess = sg.solve(objective, {"x": 1.0}, QUICK)
        sg.solve_many(objective, states[:1], QUICK, processes=1, guess=guess, file=tmp_path / "guessed")
    assert len(solved) == 4


def test_a_row_is_a_guess(objective):
    row = sg.solve_many(objective, states_of(1), QUICK, processes=1)[0]
    plan = sg.solve(objective, states_of(1)[0], sg.Ipopt(), guess=row)
    assert plan.value == pytest.approx(row.value, abs=1e-6)
    refuses(lambda: sg.solve_many(objective, states_of(1), processes=1, file=3), sg.InputError, "file = 3 is no path")


def test_two_calls_do_not_write_one_file(objective, tmp_path):
    file = tmp_path / "plans"
    sg.solve_many(objective, states_of(1), QUICK, processes=1, file=file)
    with file.open("ab") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        refused_file(objective, file, sg.StorageError, "is being written by another call")
    assert len(sg.solve_many(objective, states_of(2), QUICK, processes=1, file=file)) == 2


@pytest.mark.parametrize("optimizer", [QUICK, sg.Ipopt()], ids=["lbfgs", "ipopt"])
def test_threads_find_the_same(objective, optimizer):
    states = states_of(12)
    with joblib.parallel_config(backend="threading", n_jobs=2):
        table = sg.solve_many(objective, states, optimizer)
    same(table, sg.solve_many(objective, states, optimizer, processes=1))


def fatal(u):
    """Kills the process in which it is traced, but for the test's own."""
    if multiprocessing.parent_process() is not None or "loky" in sys.argv[0] or os.getpid() != OWN:
        os.kill(os.getpid(), signal.SIGKILL)
    return u


OWN = int(os.environ.setdefault("SYMGRAPH_TEST_PROCESS", str(os.getpid())))


def test_a_worker_that_dies_is_told(tmp_path):
    graph = sg.Graph({"u": sg.Action(low=0, high=1), "x": sg.State()}, start="go")
    graph.reward("go", lambda u, x: fatal(u) * x)
    table = sg.solve_many(sg.Objective(sg.unroll(graph)), states_of(6), QUICK, processes=2)
    assert len(table) == 6
    assert table[0].status == "not planned: a worker process died; call again with fewer processes"


def test_a_situation_without_a_plan_leaves_the_others_alone(objective, tmp_path):
    for _ in range(2):  # the second from the file
        table = sg.solve_many(
            objective, [{"x": 1.0}, {"x": -1.0}, {"x": 2.0}], QUICK, processes=1, file=tmp_path / "plans"
        )
        assert np.isfinite(table.columns["value"]).tolist() == [True, False, True]
        assert table[1].status.startswith("not planned: no start point has a finite value")
        assert np.isnan(table.columns["u[0]"]).tolist() == [False, True, False]
        assert table.columns["arm"].tolist()[1] == ""


def test_ctrl_c_returns_what_is_there(objective, monkeypatch, tmp_path):
    calls = []

    def interrupted(*arguments, **options):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return sg.solve(*arguments, **options)

    monkeypatch.setattr(many, "solve", interrupted)
    table = sg.solve_many(objective, states_of(5), QUICK, processes=1, file=tmp_path / "plans")
    assert [row.status.startswith("not planned: interrupted") for row in table] == [False, False, True, True, True]
    full = sg.solve_many(objective, states_of(5), QUICK, processes=1, file=tmp_path / "plans")
    assert len(calls) == 6
    assert np.isfinite(full.columns["value"]).all()


KILLED = """
import sys
sys.path[:0] = [{root!r}, {tests!r}]
import numpy as np
from symgraph import many
from symgraph.plan_file import FORMAT
import symgraph as sg
from test_many import QUICK, states_of, throw

if __name__ == "__main__":
    sg.solve_many(throw(), states_of(1000), QUICK, processes={processes}, file={file!r})
    print("done")
"""


@pytest.mark.parametrize("processes", [1, 2])
def test_killed_at_random_moments_it_ends_with_the_same_table(objective, tmp_path, processes):
    file, script = tmp_path / "plans", tmp_path / "run.py"
    script.write_text(KILLED.format(root=str(ROOT), tests=str(ROOT / "tests"), processes=processes, file=str(file)))
    draw = random.Random(processes)
    counts = []
    for _ in range(5):
        run = subprocess.Popen([sys.executable, str(script)], start_new_session=True)
        before = counts[-1] if counts else 0
        while run.poll() is None and (not file.exists() or len(file.read_bytes().splitlines()) <= before + 1):
            time.sleep(0.01)
        time.sleep(draw.uniform(0.0, 0.3))
        if run.poll() is None:
            os.killpg(run.pid, signal.SIGKILL)
        run.wait()
        counts.append(len(file.read_bytes().split(b"\n")) - 2)
    assert counts == sorted(counts)
    subprocess.run([sys.executable, str(script)], check=True, stdout=subprocess.DEVNULL)
    lines = file.read_bytes().splitlines()
    assert len(lines) == 1001  # nothing was planned twice
    same(
        sg.solve_many(objective, states_of(1000), QUICK, processes=1, file=file),
        sg.solve_many(objective, states_of(1000), QUICK, processes=1),
    )


# The table


def test_notes_stay_with_their_plans():
    graph = sg.Graph({"u": sg.Action(low=0, high=1), "x": sg.State()}, start="go")
    graph.chance("go", {"on": ("go", None), "out": ("end", None)}, lambda x: {"on": x, "out": 0.6})
    graph.reward("end", lambda u: u)
    table = sg.solve_many(sg.Objective(sg.unroll(graph)), [{"x": 0.5}], processes=1)
    assert any("sum to 1.1" in note for note in table[0].notes)
    assert "recurs more than 3 times" in table.columns["notes"][0]


def test_labels_that_lead_to_one_column():
    graph = sg.Graph({"u": sg.Action(2, low=0, high=1), "u[0]": sg.State()}, start="go")
    graph.reward("go", lambda u: u[0])
    table = sg.solve_many(sg.Objective(sg.unroll(graph)), [{"u[0]": 1.0}], processes=1)
    refuses(lambda: table.columns, sg.InputError, "slot 'u[0]'", "rename it")


def test_columns_hold_every_element_and_deviations(objective):
    states = [{"x": 1.0}, {"x": sg.Gaussian(2.0, sd=0.3)}]
    columns = sg.solve_many(objective, states, QUICK, processes=1).columns
    assert list(columns) == [
        *("x", "u[0]", "u[1]", "x sd", "arm"),
        *("value", "deviation", "violation", "seconds", "status", "notes"),
    ]
    assert columns["x"].tolist() == [1.0, 2.0]
    np.testing.assert_allclose(columns["x sd"], [np.nan, 0.3])
    assert columns["deviation"][1] > 0.0


def test_pandas_takes_the_columns(objective):
    table = sg.solve_many(objective, states_of(4), QUICK, processes=1)
    frame = pd.DataFrame(table.columns)
    assert frame.shape == (4, 10)
    assert set(frame[frame.x > 2.2].arm) == {"strong"}


def test_a_slot_that_is_named_like_a_result():
    graph = sg.Graph({"u": sg.Action(low=0, high=1), "value": sg.State()}, start="go")
    graph.reward("go", lambda u, value: u * value)
    table = sg.solve_many(sg.Objective(sg.unroll(graph)), [{"value": 1.0}], processes=1)
    refuses(lambda: table.columns, sg.InputError, "slot 'value'", "rename it")


def test_a_map_has_a_marker_for_each_way(objective):
    plt.switch_backend("agg")
    states = [*states_of(9), {"x": -1.0}]
    table = sg.solve_many(objective, states, QUICK, processes=1)
    axes = sg.plot_map(table, "x", "u[0]").axes[0]
    drawn = {one.get_label(): one.get_offsets() for one in axes.collections}
    assert set(drawn) == {"arm = weak", "arm = strong", "no plan"}
    assert len(drawn["arm = weak"]) == table.columns["arm"].tolist().count("weak")
    assert axes.get_xlabel() == "x"
    assert len(sg.plot_map(table, "x", range(10)).axes[0].collections[0].get_offsets()) > 0
    plt.close("all")
    graph = sg.Graph({"u": sg.Action(low=0, high=1), "x": sg.State()}, start="go")
    graph.require("go", lambda u, x: u - x, low=0)
    graph.reward("go", lambda u: -u)
    half = sg.solve_many(sg.Objective(sg.unroll(graph)), [{"x": 0.5}, {"x": 2.0}], QUICK, processes=1)
    drawn = {one.get_label(): one.get_offsets() for one in sg.plot_map(half, "x", "u").axes[0].collections}
    assert len(drawn["plan, requirements missed"]) == 1
    plt.close("all")
    refuses(lambda: sg.plot_map(half.columns, "x", "u"), sg.InputError, "takes a PlanTable, got dict")
    refuses(lambda: sg.plot_map(table, "z", "x"), sg.InputError, "no column 'z'", "Columns: 'x'")
    refuses(lambda: sg.plot_map(table, "arm", "x"), sg.InputError, "plot_map: x = 'arm'")
    refuses(lambda: sg.plot_map(table, "x", [1, 2]), sg.InputError, "each of 10 rows")


def test_what_does_not_fit(objective):
    refuses(lambda: sg.solve_many(objective.tree, []), sg.InputError, "takes an Objective, got Tree")
    refuses(lambda: sg.solve_many(objective, {"x": 1.0}), sg.InputError, "states is one mapping", "solve for one")
    refuses(lambda: sg.solve_many(objective, [{"x": 1.0}, {}]), sg.InputError, "states[1]: state 'x' is missing")
    for processes in (0, -1, 1.5, True):
        refuses(
            lambda processes=processes: sg.solve_many(objective, states_of(2), processes=processes),
            sg.InputError,
            f"processes = {processes!r}",
        )
    assert len(sg.solve_many(objective, [], processes=1)) == 0
