"""The parts of export_c: C text as items, names, the description, programs in numbers and halves; what is refused."""

import json
import re

import casadi as ca
import numpy as np
import pytest
from exported_hosts import COMPILERS, run
from exported_tasks import stacked, task
from hypothesis import given
from hypothesis import strategies as st
from wrapped_kernels import ctrl_c_after

import symgraph as sg
from symgraph.codegen.description import Description, c_names
from symgraph.codegen.items import functions_in, resolved, trimmed
from symgraph.compile import numbers
from symgraph.compile.differentiate import Differentiator
from symgraph.compile.halves import in_halves
from symgraph.compile.hoist import Hoister
from symgraph.compile.program import Kind
from symgraph.compile.reading import Reader

TEXT = """
#include <math.h>
#define USED 1
#define UNUSED 2
/* Of a pair. */
struct pair { int a, b; };
static const double table[] = {
  1, 2,
};
static const int other[] = {3};
/* Never called: helper says "used". */
static int idle(int x) { return x + UNUSED; }
static int helper(int x) {
  if (x) { return USED; }
  return (int) table[0]; /* other */
}
int public_one(struct pair *p) { return helper(p->a) + sizeof "idle"; }
"""


def test_what_nothing_uses_is_left_out():
    kept = trimmed(TEXT)
    for word in ("USED 1", "table[]", "int helper", "public_one", "struct pair", "#include", "/* Of a pair. */"):
        assert word in kept
    for word in ("UNUSED", "other[]", "int idle", "Never called"):
        assert word not in kept


def test_conditions_on_flags_are_resolved_and_others_stay():
    text = "#if A\na\n#if B\nab\n#else\nan\n#endif\n#elif B\nb\n#else\nn\n#endif\n#ifdef SINGLE\ns\n#else\nd\n#endif\n"
    rest = "#ifdef SINGLE\ns\n#else\nd\n#endif\n"
    assert resolved(text, {"A": True, "B": True}) == "a\nab\n" + rest
    assert resolved(text, {"A": True, "B": False}) == "a\nan\n" + rest
    assert resolved(text, {"A": False, "B": True}) == "b\n" + rest
    assert resolved("#if !A\nx\n#endif\n", {"A": False}) == "x\n"


def test_functions_are_found_with_their_bodies():
    assert set(functions_in(TEXT)) == {"idle", "helper", "public_one"}


@given(st.lists(st.text(max_size=8), max_size=8))
def test_names_for_c_are_identifiers_and_differ(words):
    made = c_names(words)
    assert len(set(made)) == len(made) == len(words)
    for name in made:
        assert re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name), name
        assert name not in ("int", "class", "register")


@pytest.mark.parametrize("name", ["cannon", "push", "toss"])
def test_description_survives_its_file(name, tmp_path):
    objective, uncertain = task(name)
    folder = sg.export_c(objective, tmp_path, name=name, uncertain=uncertain)
    read = json.loads((folder / f"{name}.json").read_text())
    description = Description.from_dict(read)
    assert json.loads(json.dumps(description.to_dict())) == read
    assert description == sg.CPlanner(folder).description


# Programs

X, Y, W = ca.MX.sym("x", 3), ca.MX.sym("y", 3), ca.MX.sym("w", 3, 3)
FUNCTION = ca.Function(
    "f",
    [X, Y, W],
    [
        ca.sum1(ca.tanh(W @ X) * (W.T @ Y)) + ca.sumsqr(W**2 @ X) * ca.sum1(W[:, 0]),
        ca.vertcat(X[0] * Y[1], ca.exp(X[2])),
    ],
)
KINDS = [Kind.LANE, Kind.BOUND, Kind.WEIGHT]


def given_numbers(seed=0):
    rng = np.random.default_rng(seed)
    return [rng.normal(size=3), rng.normal(size=3), rng.normal(size=9)]


def test_programs_in_numbers_say_what_casadi_does():
    program = Reader(FUNCTION).program(KINDS)
    x, y, w = given_numbers()
    for made, wanted in zip(numbers.run(program, [x, y, w]), FUNCTION(x, y, w.reshape(3, 3).T), strict=True):
        assert made == pytest.approx(wanted.full().ravel(), rel=1e-12)


def test_halves_say_what_the_whole_does():
    whole = Differentiator().with_weighted_gradient(Reader(FUNCTION).program(KINDS), by=0)
    weights, rest = Hoister(lanes=False, kind=Kind.WEIGHT, packs=False).halves(whole)
    early, late = Hoister(lanes=False, kind=Kind.BOUND, packs=False).halves(rest)
    forward, backward = in_halves(late, 2)
    x, y, w = given_numbers()
    pulls = np.array([0.3, -2.0])
    (derived,) = numbers.run(weights, [w])
    (block,) = numbers.run(early, [y, w, derived])
    value, margins, tape = numbers.run(forward, [x, y, w, pulls, derived, block])
    (slopes,) = numbers.run(backward, [x, y, w, pulls, derived, block, tape])
    symbols = FUNCTION.mx_in()
    results = FUNCTION.call(symbols)
    total = results[0] + ca.dot(ca.DM(pulls), results[1])
    wanted = ca.Function("g", symbols, [*results, ca.gradient(total, symbols[0])])(x, y, w.reshape(3, 3).T)
    for made, right in zip((value, margins, slopes), wanted, strict=True):
        assert made == pytest.approx(right.full().ravel(), rel=1e-12)


def test_numbers_of_weight_zero_have_no_part_even_with_infinite_slopes():
    x = ca.MX.sym("x")
    function = ca.Function("f", [x], [x**2, ca.sqrt(x)])
    whole = Differentiator().with_weighted_gradient(Reader(function).program([Kind.LANE]), by=0)
    with np.errstate(all="ignore"):
        assert numbers.run(whole, [np.zeros(1), np.zeros(1)])[-1] == 0.0


# What is refused


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"name": "2 cannons"}, "give a C identifier, e.g. 'cannon'"),
        ({"name": "struct"}, "give a C identifier"),
        ({"name": "math"}, "is that of a file of C's; give another one, e.g. 'my_math'"),
        ({"name": "Main"}, "is that of a file of C's"),
        ({"name": "walk_on"}, "which stands for something else"),
        ({"name": "n"}, "makes 'N_NODES', which stands for something else"),
        ({"optimizer": sg.Ipopt()}, "which needs a library; give Lbfgs"),
        ({"optimizer": sg.Enumerate(sg.Ipopt())}, "which needs a library; give Lbfgs"),
        ({"uncertain": ["targte"]}, "did you mean 'target'"),
        ({"uncertain": "hit_time"}, "is no start state"),
        ({"precision": "half"}, "give 'double' or 'single'"),
        ({"weights": "flash"}, "give 'constants' or 'file'"),
    ],
    ids=str,
)
def test_what_cannot_be_exported_is_told(options, words, tmp_path):
    objective, _ = task("cannon")
    with pytest.raises(sg.InputError, match=re.escape(words)):
        sg.export_c(objective, tmp_path / "made", **{"name": "cannon", **options})
    assert not (tmp_path / "made").exists()


def test_no_objective_and_no_folder(tmp_path):
    objective, _ = task("cannon")
    with pytest.raises(sg.InputError, match=r"write Objective\(unroll\(graph\)\)"):
        sg.export_c(objective.tree, tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(sg.StorageError, match="give another folder"):
        sg.export_c(objective, tmp_path / "file" / "folder", name="cannon")


def test_lookup_tables_are_refused(tmp_path):
    table = ca.interpolant("table", "linear", [np.linspace(0.0, 1.0, 5)], np.arange(5.0))
    graph = sg.Graph({"x": sg.Action(low=0.0, high=1.0)}, start="a")
    graph.reward("a", lambda x: table(x))
    with pytest.raises(sg.CompileError, match="write what it does as an expression, or fit a network"):
        sg.export_c(sg.Objective(sg.unroll(graph)), tmp_path)


def test_models_that_lack_samples_are_told_of(tmp_path):
    network = sg.learned.StochasticNetwork({"x": 1}, {"y": 1}, hidden=(4,), name="F")
    graph = sg.Graph({"x": sg.Action(low=0.0, high=1.0), "y": sg.State()}, start="a")
    graph.edge("a", "b", network)
    graph.reward("b", lambda y: y)
    with pytest.warns(
        UserWarning, match="model 'F' has 0 of 3 samples; where solve explores, a planner in C trusts it"
    ):
        sg.export_c(sg.Objective(sg.unroll(graph)), tmp_path)


# The planner in Python


@pytest.fixture(scope="module")
def cannon(tmp_path_factory):
    objective, _ = task("cannon")
    return sg.CPlanner(sg.export_c(objective, tmp_path_factory.mktemp("cannon"), name="cannon"))


STATE = {"speed": 3.0, "target": [1.3, 0.3], "lower_muzzle": [0.0, 0.0], "upper_muzzle": [0.0, 0.8]}


@pytest.mark.parametrize(
    ("state", "options", "words"),
    [
        ({}, {}, "state 'speed' is missing"),
        ({**STATE, "junk": 1.0}, {}, "state 'junk' is not a slot"),
        ({**STATE, "speed": np.nan}, {}, "is not finite"),
        ({**STATE, "target": 1.0}, {}, "state 'target' has 1 elements, the slot has 2"),
        ({**STATE, "target": sg.Gaussian([1.3, 0.3], sd=[0.1, 0.1])}, {}, "export it with uncertain=['target']"),
        (3, {}, "give {label: number, array or Gaussian}"),
        (STATE, {"seed": -1}, "give a whole number in [0, 2^64)"),
        (STATE, {"time_limit": -1.0}, "time_limit = -1.0"),
        (STATE, {"evaluations": 0}, "evaluations = 0; give a positive whole number"),
        (STATE, {"guess": {"thetta": 0.1}}, "did you mean 'theta'"),
        (STATE, {"guess": 4}, "give a plan or {label: value}"),
        (STATE, {"guess": [{"theta": 0.1}] * 17}, "takes at most 16"),
        (STATE, {"fixed": {"cannon": "middle"}}, "Choices: 'lower', 'upper'"),
        (STATE, {"fixed": {"theta": 3.0}}, "out of its bounds"),
    ],
    ids=str,
)
def test_what_the_planner_refuses_is_told(cannon, state, options, words):
    with pytest.raises(sg.InputError, match=re.escape(words)):
        cannon.solve(state, **options)


def test_guesses_held_values_and_budgets(cannon):
    objective, _ = task("cannon")
    plan = sg.solve(objective, STATE, fixed={"cannon": "lower"}, guess={"theta": 9.0})
    made = cannon.solve(STATE, fixed={"cannon": "lower"}, guess={"theta": 9.0})
    assert made.selections == plan.selections == {"cannon": "lower"}
    assert made.value == pytest.approx(plan.value, rel=1e-9)
    assert cannon.solve(STATE, fixed={"theta": 0.2}).actions == {"theta": 0.2}
    assert cannon.solve(STATE, guess=[plan, made]).value >= plan.value
    short = cannon.solve(STATE, evaluations=5)
    assert short.status.startswith("evaluation limit: ")
    assert cannon.solve(STATE, time_limit=0.0).status.startswith("time limit: ")
    with pytest.raises(sg.GraphError, match="without its tree"):
        short.diagram()


@pytest.mark.parametrize("evaluations", [60, 100, 150, 255])
def test_a_budget_leaves_no_choice_out(cannon, evaluations):
    objective, _ = task("cannon")
    best = sg.solve(objective, STATE)
    made = cannon.solve(STATE, evaluations=evaluations)
    assert made.selections == best.selections
    assert made.value >= best.value - 1e-3
    assert made.status.startswith("evaluation limit: ")


@pytest.mark.parametrize("evaluations", [1, 2, 5, 40])
def test_with_any_budget_a_guess_is_looked_at(cannon, evaluations):
    objective, _ = task("cannon")
    best = sg.solve(objective, STATE)
    assert cannon.solve(STATE, evaluations=evaluations, guess=best).value >= best.value - 1e-12


def test_ctrl_c_ends_a_search(tmp_path):
    slots = {"x": sg.Action(30, low=-2.0, high=2.0)}
    graph = sg.Graph(slots, start="a")
    graph.reward("a", lambda x: -ca.sumsqr(ca.sin(7 * x) * x) - 0.1 * ca.sumsqr(x[1:] - x[:-1] ** 2))
    objective = sg.Objective(sg.unroll(graph))
    planner = sg.CPlanner(sg.export_c(objective, tmp_path, name="lasting", optimizer=sg.Lbfgs(starts=20_000)))
    with ctrl_c_after(0.5):
        plan = planner.solve({})
    assert plan.status.startswith("interrupted: best of ")
    assert np.isfinite(plan.value)


# Tasks without some of what tasks have

PLAIN = {
    "x": sg.Action(low=-1.0, high=1.0),
    "y": sg.State(),
    "s": sg.Selection(["p", "q"]),
    "one": sg.Selection(["only"]),
}


def without_states():
    graph = sg.Graph(PLAIN, start="a")
    graph.edge("a", "b", lambda x: {"y": x})
    graph.reward("b", lambda y: -((y - 0.3) ** 2))
    return graph, {}


def without_actions():
    graph = sg.Graph({key: PLAIN[key] for key in ("y", "s", "one")}, start="a")
    graph.choose("a", "s", {"p": ("b", lambda y: {"y": y + 1}), "q": ("b", lambda y: {"y": y - 1})})
    graph.choose("b", "one", {"only": ("c", None)})
    graph.reward("c", lambda y: -(y**2))
    return graph, {"y": 0.4}


def without_decisions():
    graph = sg.Graph({"y": sg.State()}, start="a")
    graph.reward("a", lambda y: -(y**2))
    return graph, {"y": 0.4}


def with_odd_words():
    slots = {
        "class": sg.Action(low=-1.0, high=1.0, unit='m "/*%d*/ ??/'),
        "Größe": sg.State(unit="°C"),
        "x_covariance": sg.State(),
        "x": sg.State(),
        "int": sg.Selection(["%s", 'a"b', "*/", "\\", "for"]),
    }
    graph = sg.Graph(slots, start="a")
    ways = dict.fromkeys(slots["int"].choices, ("b", None))
    graph.choose("a", "int", ways)
    graph.reward(
        "b", sg.Model(lambda a, b, c, d: -((a - b * c) ** 2) + d, rename=dict(zip("abcd", slots, strict=False)))
    )
    return graph, {"Größe": 0.5, "x_covariance": 1.0, "x": sg.Gaussian(0.1, 0.01)}


@pytest.mark.parametrize("level", ["-O0", "-O2"])
@pytest.mark.parametrize("made", [without_states, without_actions, without_decisions, with_odd_words])
def test_tasks_without_some_of_what_tasks_have(made, level, tmp_path):
    graph, state = made()
    objective = sg.Objective(sg.unroll(graph))
    folder = sg.export_c(objective, tmp_path, name="task", uncertain=["x"] if "x" in state else [])
    for name, compiler in COMPILERS.items():
        run(*compiler, level, "-c", folder / "task.c", "-o", tmp_path / f"{name}.o")
        run(*compiler, level, "-c", folder / "main.c", "-o", tmp_path / f"{name}.o")
    plan, found = sg.CPlanner(folder).solve(state), sg.solve(objective, state)
    assert plan.value == pytest.approx(found.value, abs=1e-12)
    assert plan.selections == found.selections
    assert stacked(plan.actions) == pytest.approx(stacked(found.actions), abs=1e-6)


def test_a_folder_without_a_planner(tmp_path, cannon):
    with pytest.raises(sg.StorageError, match="holds no planner; give a folder"):
        sg.CPlanner(tmp_path)
    described = json.loads((cannon.folder / "cannon.json").read_text())
    (tmp_path / "cannon.json").write_text(json.dumps({**described, "format": 99}))
    with pytest.raises(sg.StorageError, match="another version of symgraph"):
        sg.CPlanner(tmp_path)
    (tmp_path / "cannon.json").write_text(json.dumps(described))
    with pytest.raises(sg.StorageError, match="export the planner again"):
        sg.CPlanner(tmp_path)
    (tmp_path / "cannon.json").write_text("{")
    with pytest.raises(sg.StorageError, match="cannot be read"):
        sg.CPlanner(tmp_path)


def test_where_nothing_is_finite(tmp_path):
    graph = sg.Graph({"x": sg.Action(low=0.0, high=1.0)}, start="a")
    graph.reward("a", lambda x: ca.sqrt(-1 - x))
    planner = sg.CPlanner(sg.export_c(sg.Objective(sg.unroll(graph)), tmp_path))
    with pytest.raises(sg.SolveError, match="no start point has a finite value"):
        planner.solve({})
