"""The C++ host of docs/examples/cpp_host: it builds around an exported planner, and plans what `solve` plans."""

import re
import shutil
from pathlib import Path

import pytest
from exported_hosts import STRICT, export, run
from exported_tasks import task

import symgraph as sg

HOST = Path(__file__).parents[1] / "docs/examples/cpp_host"
CYCLES, BUDGET = 8, 5.0  # [s]: far more than a plan takes, so that none ends early
LINE = re.compile(
    r"target (\S+) m: (\w+) at (\S+) rad, value (\S+), first seen (\S+), "
    r"(\d+) improvements in (\d+) looks, \S+ ms: (.*)"
)


@pytest.fixture(scope="module")
def host(tmp_path_factory):
    """The program, built with CMake where it is installed."""
    place = tmp_path_factory.mktemp("host")
    folder = export("cannon", place / "cannon")
    if shutil.which("cmake") is None:
        compiled = place / "cannon.o"
        run("gcc", "-std=c99", *STRICT, "-O2", "-c", folder / "cannon.c", "-o", compiled)
        program = place / "main"
        run("g++", "-std=c++17", *STRICT, "-O2", f"-I{folder}", HOST / "main.cpp", compiled, "-o", program, "-lm")
        return program
    build = place / "build"
    # The host's flags alone: the planner's are those of its own CMakeLists.txt.
    run("cmake", "-S", HOST, "-B", build, f"-DPLANNER_FOLDER={folder}", f"-DCMAKE_CXX_FLAGS={' '.join(STRICT)}")
    run("cmake", "--build", build)
    assert not list(build.rglob("cannon_main")), "the host does not need the planner's own program"
    return build / "host"


def rows(printed):
    return [LINE.fullmatch(line).groups() for line in printed.splitlines()]


def test_it_plans_as_solve_does(host):
    objective, _ = task("cannon")
    made = rows(run(host, CYCLES, BUDGET))
    assert len(made) == CYCLES
    for cycle, (x, cannon, theta, value, first, improvements, looks, message) in enumerate(made):
        assert float(x) == pytest.approx(0.5 + 2.0 * cycle / CYCLES, abs=0.005)  # it prints two places
        state = {"speed": 3.0, "target": [0.5 + 2.0 * cycle / CYCLES, 0.3], "lower_muzzle": [0, 0]}
        plan = sg.solve(objective, {**state, "upper_muzzle": [0, 0.8]})
        assert cannon == plan.selections["cannon"]
        assert float(theta) == pytest.approx(plan.actions["theta"], abs=1e-4)  # four places
        assert float(value) == pytest.approx(plan.value, rel=0.005)  # three figures
        assert float(first) < float(value)
        assert 1 < int(improvements) < int(looks)
        assert message == "ok"


def test_it_has_a_plan_where_time_is_over_at_once(host):
    for _, _, _, value, *_, message in rows(run(host, CYCLES, 1e-9)):
        assert float(value) < 0
        assert message.startswith("time is over")


def test_it_tells_how_it_is_used(host):
    run(host, "no number", status=2)
    run(host, CYCLES, -1, status=2)
