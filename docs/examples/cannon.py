"""
Two cannons, one target
=======================

Which cannon should fire, and at what angle? The first task of Yamaguchi & Atkeson, *Differential Dynamic
Programming for Graph-Structured Dynamical Systems*, Humanoids 2016: one choice, one continuous action, and a
reward for hitting the target, soon.
"""

# %%
# The task as a graph
# -------------------
# A *model* is a plain function. Its parameter names are the labels of the slots that it reads, it returns
# the slots that it writes, and its values are CasADi expressions. This one is the bullet's flight up to the
# moment when it passes the target's x position.

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

import symgraph as sg
from sims.cannon import MUZZLES, World, shoot


def fly(muzzle, target, speed, theta):
    distance = target[0] - muzzle[0]
    hit_time = distance / (speed * ca.cos(theta))
    hit_height = muzzle[1] + distance * ca.tan(theta) - 4.9 * hit_time**2
    return {"hit_time": hit_time, "hit_height": hit_height}


# %%
# Hitting comes first, so time has a small weight.


def score(hit_time, hit_height, target):
    return -((hit_height - target[1]) ** 2) - 1e-3 * hit_time**2


# %%
# Slots say what may be decided (actions, selections) and what is known or found out on the way (states).

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

# %%
# Both cannons share the model of the flight; only the muzzle that it reads differs.

graph.choose(
    "aim",
    "cannon",
    {
        "lower": ("landed", sg.Model(fly, rename={"muzzle": "lower_muzzle"})),
        "upper": ("landed", sg.Model(fly, rename={"muzzle": "upper_muzzle"})),
    },
)
graph.reward("landed", score)

# %%
# The plan
# --------
# The graph is unrolled to a tree, the tree becomes one symbolic expression of the expected reward, and
# ``solve`` maximises it. The world, here a simulated one, tells where the target stands.

objective = sg.Objective(sg.unroll(graph))
world = World(target_x=0.9)
state = world.reset(seed=0)
plan = sg.solve(objective, state)
print(plan)

# %%
# The tree: what may happen, with the probabilities and values of the plan; the path not taken is pale.

plan.diagram()

# %%
# The shot
# --------
# The world integrates the flight on its own; it lands where the plan said.

landed = world.execute("aim", plan.actions, plan.selections)["landed"]
print(f"passes the target after {landed['hit_time']:.3f} s at a height of {landed['hit_height']:.4f} m")

theta, cannon = plan.actions["theta"], plan.selections["cannon"]
velocity = state["speed"] * np.array([np.cos(theta), np.sin(theta)])
flight = shoot(MUZZLES[cannon], velocity, state["target"][0], points=50)

_, axes = plt.subplots(layout="constrained")
axes.plot(*flight.position, label="flight")
axes.plot(*np.array(list(MUZZLES.values())).T, "s", label="cannons")
axes.plot(*state["target"], "x", markersize=10, label="target")
axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
_ = axes.legend()

# %%
# Why start from many points
# --------------------------
# Over theta the value of each cannon has two maxima, a low and a high arc, if the target is within reach. The
# lower cannon does not reach this one: a single maximum is left, below. Ticks are start points, dots are where
# they ended.

_ = sg.plot_value(objective, state, plan, "theta")

# %%
# How far below the plan each start point was, step by step: the lower cannon, the upper one's high arc, and
# the plan.

_ = sg.plot_runs(plan)
plt.show()
