"""Planners in C: strict compilers and sanitizers have nothing to say, and they plan as `solve` does."""

import numpy as np
import pytest
from exported_hosts import CC, COMPILERS, C, identifier, run
from exported_tasks import random_point, situations, stacked, task

import symgraph as sg

LARGE = ["pouring 2x32", "pouring 3x200"]
TASKS = ["cannon", "push", "toss", *(pytest.param(name, marks=pytest.mark.slow) for name in LARGE)]
CLOSE = 1e-9  # values, relative


@pytest.fixture(scope="session")
def exported(tmp_path_factory):
    """A function: name of a task, options → the folder with its planner, written once."""
    made = {}

    def export(name, **options):
        key = name, *options.items()
        if key not in made:
            objective, uncertain = task(name)
            folder = tmp_path_factory.mktemp(identifier(name))
            made[key] = sg.export_c(objective, folder, name=identifier(name), uncertain=uncertain, **options)
        return made[key]

    return export


# What compilers say


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("options", [{}, {"precision": "single"}, {"weights": "file"}], ids=str)
@pytest.mark.parametrize("name", TASKS)
def test_strict_compilers_have_nothing_to_say(exported, name, options, compiler, tmp_path):
    folder = exported(name, **options)
    for file in (f"{identifier(name)}.c", "main.c"):
        run(*COMPILERS[compiler], "-O2", "-c", folder / file, "-o", tmp_path / "made.o")


@pytest.mark.parametrize(
    "optimizer", [sg.Adadelta(), sg.Adadelta.paper(), sg.Enumerate(), sg.Lbfgs(starts=1)], ids=repr
)
@pytest.mark.parametrize("compiler", COMPILERS)
def test_every_optimizer_compiles(compiler, optimizer, tmp_path):
    objective, _ = task("cannon")
    sg.export_c(objective, tmp_path, name="aim", optimizer=optimizer)
    run(*COMPILERS[compiler], "-c", tmp_path / "aim.c", "-o", tmp_path / "aim.o")


def test_it_needs_the_librarys_mathematics_alone(exported, tmp_path):
    folder = exported("toss", weights="file")
    run(CC, *C, "-O2", "-c", folder / "toss.c", "-o", tmp_path / "made.o")
    symbols = [line.split() for line in run("nm", tmp_path / "made.o").splitlines()]
    wanted = {parts[-1] for parts in symbols if parts[-2] == "U"}
    assert wanted <= {
        "memcpy",
        "memset",
        "memcmp",
        "memmove",
        *["sqrt", "exp", "erf", "log", "log1p", "sin", "cos", "tan", "fabs", "nextafter", "pow"],
    }
    variables = {parts[-1] for parts in symbols if parts[-2] in "dDbBC"}
    assert not variables


def test_the_same_task_is_written_in_the_same_words(exported, tmp_path):
    folder = exported("push")
    objective, uncertain = task("push")
    again = sg.export_c(objective, tmp_path, name="push", uncertain=uncertain)
    assert {path.name: path.read_text() for path in again.iterdir()} == {
        path.name: path.read_text() for path in folder.iterdir()
    }


# What it computes


@pytest.mark.parametrize("name", TASKS)
def test_it_computes_what_python_does(exported, name):
    objective, _ = task(name)
    planner = sg.CPlanner(exported(name))
    rng = np.random.default_rng(1)
    for state in situations(name, 5):
        for _ in range(4):
            actions, selections = random_point(objective, rng)
            value = objective.value(state, actions, selections)
            assert planner.value(state, actions, selections) == pytest.approx(value, rel=1e-11)
            slopes = stacked(objective.gradient(state, actions, selections))
            made = stacked(planner.gradient(state, actions, selections))
            np.testing.assert_allclose(made, slopes, rtol=0, atol=1e-11 * np.abs(slopes).max())


@pytest.mark.parametrize("name", TASKS)
def test_outcomes_are_those_of_python(exported, name):
    objective, _ = task(name)
    planner = sg.CPlanner(exported(name))
    rng = np.random.default_rng(2)
    (state,) = situations(name, 1)
    actions, selections = random_point(objective, rng)
    for mine, his in zip(
        planner.outcomes(state, actions, selections), objective.outcomes(state, actions, selections), strict=True
    ):
        assert (mine.path, mine.node, mine.cut) == (his.path, his.node, his.cut)
        for field in ("probability", "reward", "value", "deviation"):
            assert getattr(mine, field) == pytest.approx(getattr(his, field), rel=1e-9, abs=1e-12), field
        for label, gaussian in mine.states.items():
            assert np.ravel(gaussian.mean) == pytest.approx(np.ravel(his.states[label].mean), rel=1e-9, abs=1e-12)
            mine_covariance, his_covariance = (np.ravel(g.covariance) for g in (gaussian, his.states[label]))
            assert mine_covariance == pytest.approx(his_covariance, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("seed", [0, 7, 2**40 + 1])
@pytest.mark.parametrize("name", ["cannon", "toss"])
def test_the_same_seed_gives_the_same_plan(exported, name, seed):
    objective, _ = task(name)
    planner = sg.CPlanner(exported(name))
    for state in situations(name, 2, seed=3):
        plan, made = sg.solve(objective, state, seed=seed), planner.solve(state, seed=seed)
        assert made.value == pytest.approx(plan.value, rel=CLOSE)
        assert made.selections == plan.selections
        assert stacked(made.actions) == pytest.approx(stacked(plan.actions), abs=1e-6)
        assert made.status == plan.status
        assert len(made.runs) == len(plan.runs)
        for mine, his in zip(made.runs, plan.runs, strict=True):
            assert stacked(mine.start) == pytest.approx(stacked(his.start), rel=1e-12)
