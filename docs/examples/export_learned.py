"""
A planner in C that learns
==========================

A robot slides cups along a counter to guests. How far a cup slides it has to learn, and it goes on learning while the
planner is in use. So the weights of the learned model do not go into the C file but into a file beside it: a model
that is fitted anew gives a new file of weights, and the program stays as it was built.
"""

# %%
# The counter
# -----------
# A cup is let go at a speed, bare or on a piece of felt, which makes it slide farther. What is in it sloshes, which
# brakes. The robot knows none of this; it sees how far a cup went, with a noise of 1 cm.

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import symgraph as sg

FRICTION = np.array([0.30, 0.15])  # bare, on felt
GRAVITY = 9.81  # [m/s^2]


def slide(speed, fill, felt):
    return speed**2 / (2 * FRICTION[felt] * GRAVITY) * (1 - 0.3 * fill)


def try_out(count, rng):
    speed, fill, felt = rng.uniform(0.4, 2.0, count), rng.uniform(0.0, 1.0, count), rng.integers(0, 2, count)
    distance = slide(speed, fill, felt) + 0.01 * rng.normal(size=count)
    return np.column_stack([speed, fill, felt]), distance[:, None]


# %%
# The task
# --------
# The network stands in the graph like any other model. How full a cup is comes with an uncertainty. Felt is a nuisance
# to the guest, which costs as much as 5 cm beside the goal.

network = sg.learned.StochasticNetwork(
    {"speed": 1, "fill": 1, "felt": 1}, {"distance": 1}, hidden=(8, 8), name="F_slide"
)
graph = sg.Graph(
    {
        "speed": sg.Action(low=0.4, high=2.0, unit="m/s"),
        "under": sg.Selection(["bare", "felt"]),
        "fill": sg.State(),
        "felt": sg.State(),
        "goal": sg.State(unit="m"),
        "distance": sg.State(unit="m"),
    },
    start="filled",
)
graph.choose(
    "filled",
    "under",
    {"bare": ("ready", lambda: {"felt": 0.0}), "felt": ("ready", lambda: {"felt": 1.0})},
)
graph.edge("ready", "there", network)
graph.reward("ready", lambda felt: -(0.05**2) * felt)
graph.reward("there", lambda distance, goal: -((distance - goal) ** 2))
objective = sg.Objective(sg.unroll(graph))

# %%
# Fifteen cups, and the planner
# -----------------------------

rng = np.random.default_rng(0)
x, y = try_out(15, rng)
print(network.fit(x, y, progress=False))

place = tempfile.TemporaryDirectory()  # is removed when Python ends; keep yours
folders = [Path(place.name) / "fifteen", Path(place.name) / "all"]
options = {"name": "cups", "uncertain": ["fill"], "weights": "file"}
sg.export_c(objective, folders[0], **options)
for path in sorted(folders[0].iterdir()):
    print(f"{path.name:15} {path.stat().st_size:6} bytes")

# %%
# ``cups.weights`` begins with what it belongs to and ends with the numbers. ``cups_begin`` checks all of it, so that a
# file that is damaged, cut short or of another task is refused.
#
# The program is built once, and takes the file of weights as its first argument.

compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
if compiler is None:
    sys.exit("There is no C compiler here, so the planner cannot be built: install one, e.g. apt install gcc")
program = Path(place.name) / "cups_main"
sources = [folders[0] / "cups.c", folders[0] / "main.c"]
subprocess.run([compiler, "-std=c99", "-O2", *sources, "-o", program, "-lm"], check=True)


def run(weights, fill, fill_variance, goal):
    command = [program, weights, *map(str, (fill, goal, fill_variance))]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


print(run(folders[0] / "cups.weights", 0.5, 0.01, 0.8))

# %%
# A hundred cups more
# -------------------
# The network is fitted to all of them, and the planner is exported again.

more_x, more_y = try_out(100, rng)
print(network.fit(np.vstack([x, more_x]), np.vstack([y, more_y]), progress=False))
sg.export_c(objective, folders[1], **options)

for name in sorted(path.name for path in folders[0].iterdir()):
    same = (folders[0] / name).read_bytes() == (folders[1] / name).read_bytes()
    print(f"{name:15} {'the same' if same else 'differs'}")

# %%
# All but the weights is the same to the letter. The program that was built before plans with what has been learned
# since, and says what ``solve`` says.

print(run(folders[1] / "cups.weights", 0.5, 0.01, 0.8))
print(sg.solve(objective, {"fill": sg.Gaussian(0.5, sd=0.1), "goal": 0.8}))

# %%
# Where the cups end
# ------------------
# ``CPlanner`` reads both folders; the second one it finds compiled. Every plan is carried out on the counter, with a
# cup that is half full, and without the noise.

goals = np.linspace(0.1, 1.1, 40)
_, (above, below) = plt.subplots(2, 1, sharex=True, height_ratios=[2, 1], layout="constrained")
above.plot(goals, goals, "k:", linewidth=1, label="the goal")
for folder, label, style in zip(folders, ("fifteen cups", "a hundred more"), ("s", "o"), strict=True):
    planner = sg.CPlanner(folder)
    plans = [planner.solve({"fill": sg.Gaussian(0.5, sd=0.1), "goal": goal}) for goal in goals]
    felt = np.array([plan.selections["under"] == "felt" for plan in plans])
    ends = np.array([slide(plan.actions["speed"], 0.5, int(on)) for plan, on in zip(plans, felt, strict=True)])
    print(f"{label}: {100 * np.abs(ends - goals).mean():.1f} cm from the goal on average")
    above.plot(goals, ends, style, markersize=4, label=label)
    below.plot(goals, felt, style, markersize=4)
above.set(ylabel="the cup ends at [m]")
below.set(xlabel="goal [m]", yticks=[0, 1], yticklabels=["bare", "felt"], ylim=(-0.5, 1.5))
_ = above.legend()
plt.show()
