"""The programs of docs/reproduction/pouring, with few episodes."""

import csv
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from symgraph.learned import EpisodeStore

ROOT = Path(__file__).parents[1]
PROGRAMS = ROOT / "docs/reproduction/pouring"


@pytest.fixture(autouse=True)
def programs(monkeypatch):
    monkeypatch.syspath_prepend(PROGRAMS)


def started(program, *options):
    words = [sys.executable, PROGRAMS / f"{program}.py", *options]
    return subprocess.Popen(
        [str(word) for word in words], env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=subprocess.DEVNULL
    )


def run(program, *options):
    assert started(program, *options).wait() == 0


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def without_times(rows):
    return [{k: v for k, v in row.items() if k not in ("simulating", "planning", "fitting")} for row in rows]


@pytest.mark.slow
def test_runs_are_killed_gone_on_with_built_upon_evaluated_and_drawn(tmp_path):
    import evaluate
    import figures
    from setups import Run, chosen

    few = ("--runs", 1, "--processes", 1, "--episodes", 2)
    other = tmp_path / "undisturbed"
    where = ("--folder", other, "--results", other / "results.csv")
    undisturbed = started("learn", "run", *few, *where, "--only", "setup1/PT0-Rnone")
    both = (*few, "--folder", tmp_path / "runs", "--only", "setup2/PT1-Rshake")
    first = Run(chosen(["setup1/PT0-Rnone"], 2)[0], 0, tmp_path / "runs")
    killed = started("learn", "run", *both, "--results", tmp_path / "results.csv")
    while first.done < 1:
        assert killed.poll() is None
        time.sleep(0.05)
    killed.kill()
    killed.wait()
    assert first.done < 2
    run("learn", "run", *both, "--results", tmp_path / "results.csv")
    rows = rows_of(tmp_path / "results.csv")
    assert [(r["setup"], r["condition"], r["episode"], r["status"]) for r in rows] == [
        (setup, condition, str(k), "done")
        for setup, condition in (("setup1", "PT0-Rnone"), ("setup2", "PT1-Rshake"))
        for k in range(2)
    ]

    # The second run begins with the first one's episodes, to the last bit.
    second = Run(chosen(["setup2/PT1-Rshake"], 2, bases=False)[0], 0, tmp_path / "runs")
    stores = (EpisodeStore(one.folder / "episodes.sqlite", read_only=True) for one in (first, second))
    with next(stores) as earlier, next(stores) as later:
        assert [one.setup for one in later.episodes()] == ["setup1", "setup1", "setup2", "setup2"]
        assert later.episodes()[:2] == earlier.episodes()
        assert [v for k in range(2) for v in later.visits(k)] == earlier.visits()

    assert undisturbed.wait() == 0
    assert without_times(rows_of(other / "results.csv")) == without_times(rows[:2])

    run("evaluate", *both, "--situations", 1, "--results", tmp_path / "evaluation.csv")
    (evaluated,) = rows_of(tmp_path / "evaluation.csv")
    assert (evaluated["condition"], evaluated["material"], evaluated["status"]) == ("PT1-Rshake", "vsc", "done")
    evaluate.main(1, 1, 1, ["setup2/PT1-Rshake"], 2, tmp_path / "runs", tmp_path / "evaluation.csv")
    assert rows_of(tmp_path / "evaluation.csv") == [evaluated]  # nothing was left to do

    figures.main(tmp_path)
    assert {path.stem for path in tmp_path.glob("*.svg")} == {"fig9", "fig10", "fig11", "fig12", "more_variety"}
    assert [line["condition"] for line in rows_of(tmp_path / "table_conditions.csv")] == ["PT0-Rnone", "PT1-Rshake"]


def test_an_attempt_without_a_loop_is_paid_as_in_a_loop(tmp_path):
    from baselines import episode
    from setups import Run, chosen

    from sims.pouring import SETUPS, PouringWorld

    (condition,) = chosen(["setup1/PT0-Rtip"], 1)
    for number in range(3, 30):
        job = Run(condition, number, tmp_path)
        with job.loop() as loop:
            (report,) = loop
        if report.attempts == 1:
            break
    (row,) = job.rows()
    world = PouringWorld(**SETUPS["setup1"])
    again = episode(world, report.seed, report.selections["skill"], report.actions)
    shared = ("status", "material", "mouth", "target", "skill", "poured", "spilled", "released", "attempts", "return")
    assert {name: again[name] for name in shared} == {name: row[name] for name in shared}
    bonus = 10.0 * (report.selections["skill"] == "tip")
    assert float(row["return"]) == pytest.approx(report.total - bonus, rel=1e-4)  # written with 5 digits
    poured, spilled = report.known["poured_change"], report.known["spilled_change"]
    amounts = -100 * max(0, 0.3 - poured) ** 2 - 10 * spilled**2 - max(0, poured - 0.3) ** 2
    x, z = report.actions["pour_position"]
    corners, start = report.known["receiver_corners"].reshape(4, 3), report.known["waypoint"]
    way = np.array([corners[:, 0].mean() + x, z]) - start
    assert float(row["return"]) == pytest.approx(amounts - 0.1 * way @ way, rel=1e-3)


def test_a_situation_comes_again_with_other_noise():
    from baselines import same_situation

    from sims.pouring import SETUPS, PouringWorld

    world = PouringWorld(**SETUPS["varied"])
    seen = world.reset(5)
    spheres = world.behaviour.simulation.data.qpos.copy()
    fixed = same_situation(world)
    again = fixed.reset(6)
    for label in seen:
        np.testing.assert_allclose(again[label], seen[label], atol=1e-4, err_msg=label)
    assert np.abs(fixed.behaviour.simulation.data.qpos - spheres).max() > 0.01


def test_runs_without_pretraining_meet_the_situations_of_the_baselines(tmp_path):
    from setups import Run, chosen, seed_of

    (condition,) = chosen(["general/PT0-Rnone"], 1)
    with Run(condition, 1, tmp_path).loop() as loop:
        (report,) = loop
    assert report.seed == seed_of(1, 0)


def test_conditions_are_those_of_the_paper():
    from setups import CONDITIONS

    assert {(one.setup, one.name): [stage.name for stage in one.stages] for one in CONDITIONS} == {
        ("setup1", "PT0-Rnone"): ["setup1"],
        ("setup1", "PT0-Rtip"): ["setup1"],
        ("setup2", "PT0-Rnone"): ["setup2"],
        ("setup2", "PT1-Rnone"): ["setup1", "setup2"],
        ("setup2", "PT1-Rshake"): ["setup1", "setup2"],
        ("general", "PT0-Rnone"): ["general"],
        ("general", "PT1-Rnone"): ["setup1", "general"],
        ("general", "PT2-Rnone"): ["setup1", "setup2", "general"],
        ("general", "PT0-Rnone, both skills tried"): ["general"],
        ("general", "PT0-Rnone, both skills tried, one attempt"): ["general"],
        ("varied", "PT0-Rnone, both skills tried"): ["varied"],
    }
    given = {one.name: [one.stages[-1].given_at(k)["bonus"].tolist() for k in (9, 10)] for one in CONDITIONS}
    assert given["PT0-Rtip"] == [[10, 0], [0, 0]]
    assert given["PT1-Rshake"] == [[0, 10], [0, 0]]
    assert given["PT1-Rnone"] == [[0, 0], [0, 0]]


def test_convergence_is_the_first_ten_episodes_with_eight_good_returns():
    from figures import converged

    bad, good = {"return": "-1.5"}, {"return": "-0.5"}
    assert converged([bad] * 7 + [good] * 8 + [bad] * 5) == 5
    assert converged([bad] * 9 + [good] * 7) is None
    assert converged([good] * 10) == 0


def row(seed, total, status="done", **more):
    where = {"seed": str(seed), "status": status, "setup": "setup1", "material": "bnc", "mouth": "0.23"}
    amounts = {"target": "0.3", "poured": "0.33", "spilled": "0.2", "first_return": str(total), "return": str(total)}
    return where | amounts | {"run": "0", "skill": "tip", "explored": ""} | more


def test_policies_are_compared_situation_by_situation():
    from figures import average, differences_table, paired

    learned = [row(1, -1.0), row(1, -2.0), row(2, -0.5), row(3, -9.0)]
    others = [row(2, -0.75), row(1, -4.25), row(3, "", "failed")]
    assert sorted(paired(learned, others, "return")) == [0.25, 2.75]  # the third one broke off
    assert average(learned[:3], "return") == "-1.00 ± 0.50"  # of -1.5 and -0.5
    named = [one | {"condition": "c"} for one in learned], [one | {"policy": "p"} for one in others]
    (line,) = differences_table(*named)
    assert (line["situations"], line["return"]) == (2, "1.50 ± 1.25")


def test_what_broke_off_has_reached_nothing():
    from figures import summary

    said = summary([row(1, -0.5), row(2, -3.0), row(3, -0.5, run="1"), row(4, "", "failed", poured="")])
    assert {name: said[name] for name in ("episodes", "failed", "by run", "above -1 [%]", "reached [%]")} == {
        "episodes": 4,
        "failed": 1,
        "by run": "-1.75, -0.50",
        "above -1 [%]": "50",
        "reached [%]": "75",
    }
    assert said["spilled"] == "2 / 2"


def test_plans_alone_tell_when_a_run_has_converged():
    from figures import converged, converged_plans

    tried = [row(k, -5.0, explored="drawn" if k % 2 else "") | {"return": "-5" if k % 2 else "-0.1"} for k in range(30)]
    assert converged(tried) is None
    assert converged_plans(tried) == 0


def test_rows_that_were_half_written_are_dropped(tmp_path):
    from setups import append, read

    path = tmp_path / "rows.csv"
    path.write_text("a,b\n1,2\n3")
    assert read(path) == [{"a": "1", "b": "2"}]
    append(path, ("a", "b"), [{"a": 5, "b": 6}])
    assert path.read_text() == "a,b\n1,2\n5,6\n"


def test_runs_that_were_begun_with_another_seed_are_refused(tmp_path, monkeypatch):
    import learn
    import setups

    (condition,) = setups.chosen(["setup1/PT0-Rnone"])
    run = setups.Run(condition, 0, tmp_path)
    run.loop().close()
    assert not run.finished
    seed = setups.SEEDS
    monkeypatch.setattr(setups, "SEEDS", seed + 1)
    said = f"PT0-Rnone/0 was begun with seed {seed}, but SEEDS in setups.py makes it {seed + 1}; move that folder"
    asked = [lambda: run.done, lambda: run.finished, lambda: run.ended, run.rows]
    for ask in [*asked, lambda: learn.rebuild(tmp_path, tmp_path / "results.csv")]:
        with pytest.raises(SystemExit, match=said):
            ask()


def test_rows_of_other_seeds_are_dropped(tmp_path, capsys):
    """From the results of learning; the second stage of a run counts on from the first."""
    import learn
    from setups import COLUMNS, seed_of, write

    path = tmp_path / "results.csv"
    mine = [
        row(seed_of(int(run), number), -1.0, setup=setup, condition=name, run=run, episode="0")
        for setup, name, run, number in (("setup1", "PT0-Rnone", "1", 0), ("setup2", "PT1-Rnone", "0", 50))
    ]
    foreign = row(seed_of(2, 0), -1.0, setup="setup1", condition="PT0-Rnone", run="0", episode="0")
    write(path, COLUMNS, [*mine, foreign])
    learn.rebuild(tmp_path / "runs", path)
    assert [(kept["condition"], kept["run"]) for kept in rows_of(path)] == [("PT0-Rnone", "1"), ("PT1-Rnone", "0")]
    assert "setup1/PT0-Rnone, run 0: 1 rows of other seeds are dropped" in capsys.readouterr().out


def test_policies_pour_anew_where_seeds_have_changed(tmp_path, monkeypatch, capsys):
    import baselines
    import setups

    path, poured = tmp_path / "baselines.csv", []
    monkeypatch.setattr(baselines, "work", lambda pour, jobs, processes, look: poured.append([*jobs]))

    def main():
        baselines.main(runs=1, fresh=1, tries=2, processes=1, results=path)
        return [job.run for job in poured.pop()]

    assert main().count("0") == 80
    baselines.main(runs=1, fresh=3, tries=2, processes=1, only=["rule"], results=path)
    assert [job.policy for job in poured.pop()] == ["rule"] * (3 + 3 + 20)
    jobs = [
        baselines.Job(setup, policy, run, situation, 2)
        for setup, run, situation in (("general", "0", 60), ("general", "fresh", 0))
        for policy in baselines.POLICIES
    ]
    rows = [{**dict(zip(baselines.COLUMNS, job.key, strict=False)), "seed": job.seed} for job in jobs]
    setups.write(path, baselines.COLUMNS, rows)
    assert (main().count("0"), len(rows_of(path))) == (76, 8)
    monkeypatch.setattr(setups, "SEEDS", setups.SEEDS + 1)
    assert (main().count("0"), len(rows_of(path))) == (80, 4)
    assert "4 rows of other seeds are dropped" in capsys.readouterr().out
