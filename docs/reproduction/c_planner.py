"""Planners in C against those in Python: agreement, precision, time budgets, sizes, speed, and 32-bit ARM.

From the repository's root: `python docs/reproduction/c_planner.py`, or with the names of some parts. Each part writes a
table to c_planner/. The part "arm" needs Debian's gcc-arm-linux-gnueabihf, libc6-dev-armhf-cross and qemu-user.
"""

import csv
import json
import os
import statistics
import sys
import tempfile
import time
from functools import cache
from pathlib import Path

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):  # before numpy
    os.environ[variable] = "1"

import numpy as np

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import exported_tasks
from exported_hosts import STRICT, built, export, identifier, numbers, run
from exported_tasks import situations, stacked, task

import symgraph as sg

FOLDER = Path(__file__).with_suffix("")
TASKS = ("cannon", "push", "pouring 2x32", "pouring 3x200")
SITUATIONS = 200
BUDGETS = (1, 5, 20, 100)  # [ms]
FLAGS = ("-O3", "-march=native", "-fno-ipa-ra")  # see docs/guide/planner_in_c.md
CLOSE, NEAR = 1e-9, 1e-6  # of values, relative; of actions
TEMPORARY = tempfile.TemporaryDirectory(prefix="symgraph-")


def write(name, rows):
    FOLDER.mkdir(exist_ok=True)
    with (FOLDER / f"{name}.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, rows[0], lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
    print(name)
    for row in rows:
        print("  ", *row.values(), flush=True)


@cache
def folder_of(name, **options):
    """The folder with a task's planner."""
    folder = Path(TEMPORARY.name, identifier(name) + "".join(f"_{value}" for value in options.values()))
    return export(name, folder, **options)


def apart(one, other):
    """The largest difference, relative to the largest number."""
    return float(np.abs(one - other).max() / max(np.abs(one).max(), np.finfo(float).tiny))


# Agreement


def agreement():
    """The same seeds, states and points in C and in Python: gradients, values, selections, actions."""
    rows = []
    for name, interpreted in [(name, False) for name in TASKS] + [("push", True)]:
        objective, _ = task(name)
        other = sg.Objective(objective.tree, compiled=False) if interpreted else objective
        planner, rng = sg.CPlanner(folder_of(name)), np.random.default_rng(1)
        slopes, values, actions, selections, better, runs, alike = [], [], [], 0, 0, 0, 0
        for i, state in enumerate(situations(name, SITUATIONS)):
            point = exported_tasks.random_point(objective, rng)
            slopes.append(apart(stacked(objective.gradient(state, *point)), stacked(planner.gradient(state, *point))))
            plan = sg.solve(other, state, seed=i, progress=False)
            made = planner.solve(state, seed=i)
            values.append(abs(made.value - plan.value) / abs(plan.value))
            better += values[-1] > CLOSE and made.value > plan.value
            selections += made.selections != plan.selections
            actions.append(float(np.abs(stacked(made.actions) - stacked(plan.actions)).max()))
            pairs = list(zip(made.runs, plan.runs, strict=True))
            runs += len(pairs)
            alike += sum(abs(a.value - b.value) <= CLOSE * abs(b.value) for a, b in pairs)
        rows.append(
            {
                "task": f"{name}, in CasADi's interpreter" if interpreted else name,
                "gradients": f"{max(slopes):.1e}",
                "values, median": f"{statistics.median(values):.1e}",
                "values, largest": f"{max(values):.1e}",
                f"values apart by more than {CLOSE:g}": sum(value > CLOSE for value in values),
                "of these better in C": better,
                "actions, largest": f"{max(actions):.1e}",
                f"actions apart by more than {NEAR:g}": sum(one > NEAR for one in actions),
                "other selections": selections,
                "climbs that end alike": f"{100 * alike / runs:.1f}%",
            }
        )
        write("agreement", rows)


def single():
    """Planners in single precision against Python in double."""
    rows = []
    for name in TASKS:
        objective, _ = task(name)
        planner, rng = sg.CPlanner(folder_of(name, precision="single")), np.random.default_rng(1)
        slopes, points, regrets, selections = [], [], [], 0
        for i, state in enumerate(situations(name, SITUATIONS if "200" not in name else 40)):
            for _ in range(5):
                point = exported_tasks.random_point(objective, rng)
                exact = objective.value(state, *point)
                points.append(abs(planner.value(state, *point) - exact) / abs(exact))
                his, mine = (stacked(one.gradient(state, *point)) for one in (objective, planner))
                slopes.append(apart(his, mine))
            plan, made = sg.solve(objective, state, seed=i, progress=False), planner.solve(state, seed=i)
            regrets.append(plan.value - objective.value(state, made.actions, made.selections))
            regrets[-1] /= abs(plan.value)
            selections += made.selections != plan.selections
        rows.append(
            {
                "task": name,
                "values, median": f"{statistics.median(points):.1e}",
                "values, largest": f"{max(points):.1e}",
                "gradients, median": f"{statistics.median(slopes):.1e}",
                "gradients, 99%": f"{np.quantile(slopes, 0.99):.1e}",
                "worth of plans, median loss": f"{statistics.median(regrets):.1e}",
                "worth of plans, 95%": f"{np.quantile(regrets, 0.95):.1e}",
                "other selections": selections,
            }
        )
        write("single", rows)


# Time

HOST = """
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#define COUNT (sizeof(planner_state) / sizeof(double))
static double memory[PLANNER_MEMORY / 8 + 1];
static double tell(void *user) {
  struct timespec now;
  (void) user;
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now); /* so that what the system gives to others does not count */
  return (double) now.tv_sec + 1e-9 * (double) now.tv_nsec;
}
/* For each state of a file: the time of a gradient and of a value, then value, time and evaluations of a plan. */
int main(int count, char **words) {
  const double seconds = atof(words[1]);
  FILE *file = fopen(words[2], "r");
  planner_planner *planner;
  planner_options options;
  planner_state state;
  planner_plan plan;
  planner_actions slopes;
  double numbers[COUNT], value;
  size_t i;
  (void) count;
  if (!file || planner_begin(memory, sizeof memory, &planner)) return 1;
  memset(&options, 0, sizeof options);
  options.clock = tell;
  options.seconds = seconds;
  for (;;) {
    double began, gradient, look, spent;
    int n;
    for (i = 0; i < COUNT; ++i)
      if (fscanf(file, "%lf", numbers + i) != 1) return 0;
    memcpy(&state, numbers, sizeof state);
    began = tell(0);
    if (planner_solve(planner, &state, &options, &plan) < 0) return 2;
    spent = tell(0) - began;
    began = tell(0);
    for (n = 0; n < 9; ++n)
      planner_gradient(planner, &state, &plan.actions, &plan.selections, &value, &slopes);
    gradient = (tell(0) - began) / 9;
    began = tell(0);
    for (n = 0; n < 9; ++n) planner_value(planner, &state, &plan.actions, &plan.selections, &value);
    look = (tell(0) - began) / 9;
    printf("%.9g %.9g %.17g %.9g %ld %ld\\n", gradient, look, plan.value, spent, plan.evaluations, plan.gradients);
  }
}
"""


@cache
def host_of(name):
    folder = folder_of(name)
    return built(folder, identifier(name), HOST, folder / "host", *FLAGS)


def told(name, seconds, count):
    """What the host says of some states: gradient [s], value [s], value, spent [s], evaluations, gradients."""
    states = folder_of(name) / f"states{count}"
    states.write_text("\n".join(" ".join(numbers(name, state)) for state in situations(name, count)))
    printed = run("taskset", "-c", str(min(os.sched_getaffinity(0))), host_of(name), seconds, states)
    return np.array([[float(word) for word in line.split()] for line in printed.splitlines()])


def spread(name, state):
    """The size of the differences of J over the bounds."""
    objective, _ = task(name)
    rng = np.random.default_rng(0)
    values = [objective.value(state, *exported_tasks.random_point(objective, rng)) for _ in range(64)]
    low, high = np.quantile(values, [0.25, 0.75])
    return high - low


def budgets():
    """The value that a budget of time reaches, and by how much it is overrun."""
    rows = []
    for name in TASKS:
        count = 100 if "200" not in name else 30
        spreads = np.array([spread(name, state) for state in situations(name, count)])
        whole = told(name, 0, count)
        for budget in BUDGETS:
            found = told(name, budget / 1e3, count)
            gaps = (whole[:, 2] - found[:, 2]) / spreads
            over = found[:, 3] - budget / 1e3
            rows.append(
                {
                    "task": name,
                    "budget [ms]": budget,
                    "used, median [ms]": f"{1e3 * np.median(found[:, 3]):.3g}",
                    "evaluations, median": f"{np.median(found[:, 4]):.0f}",
                    "gap to the whole search, median": f"{max(np.median(gaps), 0.0):.1e}",
                    "gap, 90%": f"{max(np.quantile(gaps, 0.9), 0.0):.1e}",
                    "overrun, median [gradients]": f"{max(np.median(over / found[:, 0]), 0.0):.2f}",
                    "overrun, 95%": f"{max(np.quantile(over / found[:, 0], 0.95), 0.0):.2f}",
                    "overrun, largest": f"{max((over / found[:, 0]).max(), 0.0):.2f}",
                    "overrun, largest [ms]": f"{max(1e3 * over.max(), 0.0):.3g}",
                }
            )
            write("budgets", rows)


def speed():
    """Plans per second in C and in Python, in turns; and the share of the time that is no evaluation."""
    rows = []
    for name in TASKS:
        objective, _ = task(name)
        count = 60 if "200" not in name else 10
        spent = []
        for state in situations(name, count):
            begin = time.perf_counter()
            sg.solve(objective, state, progress=False)
            spent.append(time.perf_counter() - begin)
        found = told(name, 0, count)
        gradient, look, _, seconds, evaluations, gradients = found.T
        counted = gradients * gradient + (evaluations - gradients) * look
        rows.append(
            {
                "task": name,
                "C: plans per second": f"{1 / np.median(seconds):.3g}",
                "Python: plans per second": f"{1 / np.median(spent[1:]):.3g}",
                "ratio": f"{np.median(spent[1:]) / np.median(seconds):.2f}",
                "gradient [µs]": f"{1e6 * np.median(gradient):.3g}",
                "value [µs]": f"{1e6 * np.median(look):.3g}",
                "no evaluation": f"{100 * max(0.0, 1 - np.median(counted / seconds)):.0f}%",
            }
        )
        write("speed", rows)


# Sizes


def sizes():
    """Files, object code, memory and stack."""
    rows = []
    for name in TASKS:
        for options in ({}, {"precision": "single"}, {"weights": "file"}):
            folder, c = folder_of(name, **options), identifier(name)
            described = json.loads((folder / f"{c}.json").read_text())
            sized = {}
            for level in ("-Os", "-O2"):
                made = folder / f"made{level}.o"
                run("gcc", "-std=c99", level, "-ffunction-sections", "-c", folder / f"{c}.c", "-o", made)
                sized[level] = int(run("size", made).splitlines()[1].split()[0])  # the others are 0: a test looks
            rows.append(
                {
                    "task": name,
                    "precision": described["precision"],
                    "weights": f"{described['weights']} in {described['weights_in']}",
                    "C file [kB]": f"{(folder / f'{c}.c').stat().st_size / 1e3:.0f}",
                    "object, -Os [kB]": f"{sized['-Os'] / 1e3:.0f}",
                    "object, -O2 [kB]": f"{sized['-O2'] / 1e3:.0f}",
                    "memory [kB]": f"{described['memory'] / 1e3:.1f}",
                    "stack [kB]": f"{described['stack'] / 1e3:.1f}",
                }
            )
            write("sizes", rows)


# Another processor


def arm():
    """The same plan on 32-bit ARM, by Debian's cross compiler under qemu."""
    rows = []
    for name in ("cannon", "push", "toss", "pouring 2x32"):
        for precision in ("double", "single"):
            folder, c = folder_of(name, precision=precision), identifier(name)
            (state,) = situations(name, 1)
            words = numbers(name, state)
            printed = {}
            for compiler, runner in (("gcc", ()), ("arm-linux-gnueabihf-gcc", ("qemu-arm",))):
                program = folder / f"main_{compiler}"
                sources = folder / f"{c}.c", folder / "main.c"
                run(compiler, "-std=c99", *STRICT, "-O2", "-static", f"-I{folder}", *sources, "-o", program, "-lm")
                printed[compiler] = run(*runner, program, *words)
            here, there = printed.values()
            rows.append(
                {
                    "task": name,
                    "precision": precision,
                    "x86-64": here.splitlines()[0] + "; " + value_of(here),
                    "ARM": there.splitlines()[0] + "; " + value_of(there),
                    "printed alike": "yes" if here == there else "no",
                }
            )
            write("arm", rows)


def value_of(printed):
    return next(line.split(":")[0] for line in printed.splitlines() if line.startswith("value"))


PARTS = {part.__name__: part for part in (agreement, single, budgets, speed, sizes, arm)}

if __name__ == "__main__":
    for part in sys.argv[1:] or PARTS:
        PARTS[part]()
