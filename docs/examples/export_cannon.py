"""
A planner in C
==============

A robot's controller may have neither Python nor room for it. ``export_c`` writes the whole planner of a task as C that
needs nothing but the C library: samples, climbs and choices, as ``solve`` does them. Here the two cannons of
:doc:`cannon` are exported, built, run, and compared with ``solve``.
"""

# %%
# The task
# --------
# Two cannons, one target: which one shoots, and at what angle?

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

import symgraph as sg


def fly(muzzle, target, speed, theta):
    distance = target[0] - muzzle[0]
    hit_time = distance / (speed * ca.cos(theta))
    return {"hit_time": hit_time, "hit_height": muzzle[1] + distance * ca.tan(theta) - 4.9 * hit_time**2}


def score(hit_time, hit_height, target):
    return -((hit_height - target[1]) ** 2) - 1e-3 * hit_time**2


graph = sg.Graph(
    {
        "theta": sg.Action(low=-1.57, high=1.57, unit="rad"),
        "cannon": sg.Selection(["lower", "upper"]),
        "speed": sg.State(unit="m/s"),
        "target": sg.State(2, unit="m"),
        "lower_muzzle": sg.State(2, unit="m"),
        "upper_muzzle": sg.State(2, unit="m"),
        "hit_time": sg.State(unit="s"),
        "hit_height": sg.State(unit="m"),
    },
    start="aim",
)
graph.choose(
    "aim",
    "cannon",
    {
        "lower": ("landed", sg.Model(fly, rename={"muzzle": "lower_muzzle"})),
        "upper": ("landed", sg.Model(fly, rename={"muzzle": "upper_muzzle"})),
    },
)
graph.reward("landed", score)
objective = sg.Objective(sg.unroll(graph))

# %%
# The folder
# ----------
# One call writes it. The planner is ``cannon.h`` and ``cannon.c``; ``main.c`` is a program around it, and ``README.md``
# tells what its structures hold.

place = tempfile.TemporaryDirectory()  # is removed when Python ends; keep yours
folder = sg.export_c(objective, Path(place.name) / "cannon", name="cannon")
for path in sorted(folder.iterdir()):
    print(f"{path.name:15} {path.stat().st_size:6} bytes")

# %%
# The header is what a program sees. The planner lives in memory of the caller's; this is how much.

for line in (folder / "cannon.h").read_text().splitlines():
    if line.startswith("#define") and "*/" in line:
        print(line)

# %%
# The state is a structure of doubles with the labels of the slots.

header = (folder / "cannon.h").read_text()
begin = header.index("typedef struct cannon_state")
print(header[begin : header.index("cannon_state;", begin) + len("cannon_state;")])

# %%
# Build it
# --------
# With CMake, or by hand: it is one C file.


compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
if compiler is None:
    sys.exit("There is no C compiler here, so the planner cannot be built: install one, e.g. apt install gcc")


def build(folder):
    if shutil.which("cmake") and shutil.which("make"):
        subprocess.run(["cmake", "-B", "build", "."], cwd=folder, check=True, stdout=subprocess.DEVNULL)
        subprocess.run(["cmake", "--build", "build"], cwd=folder, check=True, stdout=subprocess.DEVNULL)
        return folder / "build" / "cannon_main"
    subprocess.run([compiler, "-std=c99", "-O2", "cannon.c", "main.c", "-o", "main", "-lm"], cwd=folder, check=True)
    return folder / "main"


program = build(folder)

# %%
# The program takes the state as numbers, in the order of the structure.

print(subprocess.run([program, "--help"], check=True, capture_output=True, text=True).stdout.replace(place.name, ""))
numbers = ["3.0", "1.3", "0.3", "0", "0", "0", "0.8"]
print(subprocess.run([program, *numbers], check=True, capture_output=True, text=True).stdout)

# %%
# ``solve`` says the same, since the C planner draws the same start points from the same seed and climbs in the same
# steps.


def state_of(target_x):
    return {"speed": 3.0, "target": [target_x, 0.3], "lower_muzzle": [0.0, 0.0], "upper_muzzle": [0.0, 0.8]}


print(sg.solve(objective, state_of(1.3)))

# %%
# From Python
# -----------
# ``CPlanner`` compiles the C files of a folder and calls them, with the interface of ``solve``: to test what the robot
# will run, as it will run it.

planner = sg.CPlanner(folder)
targets = np.linspace(0.3, 2.9, 20)
plans = [sg.solve(objective, state_of(x)) for x in targets]
made = [planner.solve(state_of(x)) for x in targets]
same = sum(a.selections == b.selections for a, b in zip(plans, made, strict=True))
apart = max(abs(a.value - b.value) for a, b in zip(plans, made, strict=True))
print(f"the same cannon for {same} of {len(targets)} targets; values differ by at most {apart:.1e}")

# %%
# How fast
# --------
# A call of ``CPlanner`` takes longer than the search in it: Python checks the state, waits so that Ctrl-C can end the
# search, and makes a ``Plan``. It is there for tests, not for speed. So the C planner is also timed by itself, in a
# program that plans for a thousand targets.

loop = """\
#include "cannon.h"
#include <stdio.h>
#include <time.h>

static union { double first; unsigned char bytes[CANNON_MEMORY]; } memory;

int main(void) {
  cannon_planner *planner;
  cannon_plan plan;
  cannon_state state = {3.0, {0.0, 0.3}, {0.0, 0.0}, {0.0, 0.8}};
  clock_t began;
  int i;
  if (cannon_begin(memory.bytes, sizeof memory.bytes, &planner) != CANNON_OK) return 1;
  began = clock();
  for (i = 0; i < 1000; ++i) {
    state.target[0] = 0.3 + 2.6 * i / 1000;
    if (cannon_solve(planner, &state, 0, &plan) != CANNON_OK) return 1;
  }
  printf("%g\\n", 1000 * (double) CLOCKS_PER_SEC / (double) (clock() - began));
  return 0;
}
"""
(folder / "loop.c").write_text(loop)
subprocess.run([compiler, "-std=c99", "-O2", "cannon.c", "loop.c", "-o", "loop", "-lm"], cwd=folder, check=True)
in_c = float(subprocess.run([folder / "loop"], check=True, capture_output=True, text=True).stdout)


def per_second(plan):
    plan(state_of(1.3))  # the first call may compile
    began = time.perf_counter()
    for x in targets:
        plan(state_of(x))
    return len(targets) / (time.perf_counter() - began)


print(f"solve:                {per_second(lambda state: sg.solve(objective, state)):6.0f} plans per second")
print(f"CPlanner, in Python:  {per_second(planner.solve):6.0f}")
print(f"the C planner alone:  {in_c:6.0f}")

# %%
# Budgets
# -------
# A robot that has to act may limit a search to a number of evaluations, or to a time: the plan is then the best so far.
# A quarter of a budget goes to samples all over the bounds, the rest to climbs from the best of them: forty evaluations
# are enough here. A search that is given the plan for a target 5 cm before as a start point wants twenty.

budgets = [5, 10, 15, 20, 25, 30, 40, 60, 80]
befores = [planner.solve(state_of(x - 0.05)) for x in targets]


def missing(budget, guesses):
    gaps = [
        plan.value - planner.solve(state_of(x), guess=guess, evaluations=budget).value
        for x, plan, guess in zip(targets, made, guesses, strict=True)
    ]
    return max(np.mean(gaps), 1e-12)  # below is rounding, and the axis is logarithmic


cold = [missing(budget, [None] * len(targets)) for budget in budgets]
warm = [missing(budget, befores) for budget in budgets]

_, axes = plt.subplots(layout="constrained")
axes.plot(budgets, cold, "o-", label="from scratch")
axes.plot(budgets, warm, "s-", label="from the plan for a target 5 cm before")
axes.set(yscale="log", xlabel="budget [evaluations]", ylabel="value that is missing, mean over targets [m²]")
_ = axes.legend()
plt.show()
