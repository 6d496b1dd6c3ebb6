"""The on-line loop as a whole: it learns, reports, plans and performs, and compiles nothing while it learns."""

import subprocess

import casadi as ca
import numpy as np
import pytest
from online_worlds import best, kick_graph, kicking, loop, networks, told
from small_tasks import refuses
from stored_models import same

import symgraph as sg
from symgraph.learned import Exploration, StochasticNetwork

EXPLORE = Exploration(selections=1.0, actions=0.5, noise=0.1, episodes=25)
SEEDS = range(10**6, 10**6 + 10)  # of situations that were never met


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """A loop that has learned to kick, its reports, and what was compiled or built after the first ten episodes."""
    from symgraph import situation as situation_module
    from symgraph.compile import toolchain

    built = []

    def counted(name, function):
        def wrapper(*arguments, **options):
            built.append(name)
            return function(*arguments, **options)

        return wrapper

    one = loop(tmp_path_factory.mktemp("learned"), kick_graph(*networks((20,))), kicking(), 28, EXPLORE)
    reports = []
    with pytest.MonkeyPatch.context() as patch, one:
        for report in one:
            reports.append(report)
            if report.number == 9:
                patch.setattr(subprocess, "run", counted("compiler", subprocess.run))
                patch.setattr(toolchain, "load", counted("load", toolchain.load))
                for name in ("expected_value", "make_kernel", "FlatFunction"):
                    patch.setattr(situation_module, name, counted(name, getattr(situation_module, name)))
                patch.setattr(ca.Function, "__init__", counted("Function", ca.Function.__init__))
        patch.undo()
        yield one, reports, built


def test_it_ends_near_the_known_optimum(learned):
    one, _, _ = learned
    performed = [one.perform(kicking(), seed) for seed in SEEDS]
    lost = [best(report.known["s"]) - report.total for report in performed]
    print(f"lost: median {np.median(lost):.4f}, worst {max(lost):.4f}")
    assert min(lost) >= -1e-12
    assert np.median(lost) < 0.01  # the returns of random kicks spread by about 2
    assert {report.selections["skill"] for report in performed} == {"near", "far"}


def test_reports_say_what_happened(learned):
    one, reports, _ = learned
    assert [report.number for report in reports] == list(range(28))
    assert "exploring: model 'near' has 0 of 3 samples" in reports[0].explored
    assert {report.explored for report in reports} >= {"", "drawn: selections", "drawn: selections, actions"}
    for report in reports:
        assert (report.setup, report.status, report.reason, report.attempts) == ("toy", "done", "", 1)
        assert report.total == pytest.approx(-((report.known["y"] - 1.0) ** 2), rel=1e-12)
        assert list(report.known) == ["s", "u", "skill", "y"]
        assert report.known["u"] == report.actions["u"]
        assert report.known["skill"] == report.selections["skill"]
        assert list(report.seconds) == ["simulating", "planning", "fitting"]
        assert all(seconds > 0 for seconds in report.seconds.values())
    last = reports[-1]
    assert last.explored == ""
    assert last.expected["y"] == pytest.approx(last.known["y"], abs=0.2)
    assert str(last) == f"toy 27; skill = {last.selections['skill']}; return {last.total:.3g}"
    assert "; exploring: model" in str(reports[0])
    assert last.value == one.store.plans(27)[0]["value"]
    stored = one.store.episodes()[-1]
    assert (stored.total, stored.seed, stored.seconds) == (last.total, last.seed, last.seconds)
    assert stored.info == {"returns": [last.total], "selections": last.selections, "value": last.value, "explored": ""}


def test_fits_compile_and_build_nothing(learned):
    _, _, built = learned
    assert built == []


def test_a_loop_that_is_over_runs_nothing(learned):
    one, _, _ = learned
    assert (one.episodes, one.done) == (28, 28)
    before = told(one.store)
    assert list(one) == []
    assert told(one.store) == before


def test_performing_and_planning_change_nothing(learned):
    one, _, _ = learned
    models = {name: lesson.model for name, lesson in one._lessons.all.items()}
    weights = [parameter.value.copy() for model in models.values() for parameter in model.parameters]
    samples = {name: (model.samples, len(one._lessons.all[name].x)) for name, model in models.items()}
    files = {file: file.read_bytes() for file in one.folder.glob("*.safetensors")}
    before, past = told(one.store), list(one._past.episodes)
    first, second = (one.perform(kicking(), 5) for _ in range(2))
    plan = one.plan({"s": 0.25, "something else": "ignored"})
    assert (first.total, first.actions, first.selections) == (second.total, second.actions, second.selections)
    assert (first.setup, first.seed, first.status) == ("performed", 5, "done")
    assert sg.solve(sg.Objective(sg.unroll(one.graph)), {"s": 0.25}).value == pytest.approx(plan.value, abs=1e-6)
    assert told(one.store) == before
    assert one._past.episodes == past
    assert {name: (model.samples, len(one._lessons.all[name].x)) for name, model in models.items()} == samples
    assert {file: file.read_bytes() for file in one.folder.glob("*.safetensors")} == files
    after = [parameter.value for model in models.values() for parameter in model.parameters]
    for a, b in zip(weights, after, strict=True):
        np.testing.assert_array_equal(a, b)


def test_plans_are_made_where_decisions_are(learned):
    one, _, _ = learned
    refuses(lambda: one.plan({"s": 0.0}, "near_end"), sg.InputError, "nothing is planned at 'near_end'", "'aim'")
    refuses(lambda: one.plan({}), sg.InputError, "'s'")
    refuses(lambda: one.plan([0.5]), sg.InputError, "known = [0.5]; give {label: value}")


def test_models_are_kept_in_files(learned):
    one, _, _ = learned
    for name, lesson in one._lessons.all.items():
        same(StochasticNetwork.load(one.folder / f"{name}.safetensors"), lesson.model)


def test_a_copied_folder_goes_on_as_the_loop_itself(tmp_path):
    """More episodes in the last stage, in the same process, in a new one, or all at once: it is all the same."""
    at_once, in_parts = tmp_path / "at once", tmp_path / "in parts"
    with loop(at_once, kick_graph(*networks()), kicking(), 8, EXPLORE) as one:
        list(one)
        whole, models = told(one.store), [lesson.model for lesson in one._lessons.all.values()]
    for episodes in (3, 5, 8):
        with loop(in_parts, kick_graph(*networks()), kicking(), episodes, EXPLORE) as part:
            assert part.done in (0, 3, 5)
            list(part)
    with loop(in_parts, kick_graph(*networks()), kicking(), 8, EXPLORE) as again:
        assert told(again.store) == whole
        for a, b in zip(models, again._lessons.all.values(), strict=True):
            same(a, b.model)
