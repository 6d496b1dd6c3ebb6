"""
A push at an object seen twice
==============================

A camera sees an object in two places, each with its own uncertainty, and it is in one of them. Where should the
gripper start, where should it point, and how far should it push, so that the object ends up in its middle wherever it
is? The second task of Yamaguchi & Atkeson, *Differential Dynamic Programming for Graph-Structured Dynamical Systems*,
Humanoids 2016: no choice to make, but chance, Gaussians and a model with jumps.
"""

# %%
# What a push does
# ----------------
# The gripper is a funnel: two arms run from its centre to the left and the right, 0.3 m ahead and aside. In its own
# frame, with x ahead, an object that an arm meets slides along it until the centre takes it, or the gripper halts.

import casadi as ca
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle

import symgraph as sg
from sims.push import Situation, World, success_probability


def push(local, advance):
    ahead, side = local[0] - advance, local[1]
    gap = local[0] - ca.fabs(side)  # to the arm, along the motion
    touched = ca.logic_and(ca.logic_and(gap >= 0, gap < advance), ca.fabs(side) <= 0.3)
    captured = ca.logic_and(touched, ahead < 0)
    pushed = ca.if_else(touched, ahead * ca.sign(side), side)
    return {"offset": ca.vertcat(ca.if_else(captured, 0, ahead), ca.if_else(captured, 0, pushed))}


# %%
# For given actions the way into the gripper's frame is linear, which Gaussians pass exactly.


def approach(place, gripper, theta):
    x, y = place[0] - gripper[0], place[1] - gripper[1]
    c, s = ca.cos(theta), ca.sin(theta)
    return {"local": ca.vertcat(c * x + s * y, c * y - s * x)}


# %%
# Away from the centre costs much, a long way little.


def score(offset, advance):
    return -1000 * ca.sumsqr(offset) - 0.001 * advance**2


# %%
# The graph
# ---------
# The two places are two branches of chance. They share the models; only the slot that ``approach`` reads differs.
# ``push`` jumps, so its slope at the mean says little about a Gaussian: "quadrature" looks at 25 points instead.


def graph_of(propagation):
    graph = sg.Graph(
        {
            "gripper": sg.Action(2, low=0.0, high=1.0, unit="m"),
            "theta": sg.Action(low=-np.pi, high=np.pi, unit="rad"),
            "advance": sg.Action(low=0.05, high=0.8, unit="m"),
            "first": sg.State(2, unit="m"),
            "second": sg.State(2, unit="m"),
            "local": sg.State(2, unit="m"),
            "offset": sg.State(2, unit="m"),
        },
        start="aim",
    )
    graph.chance(
        "aim",
        {
            "first": ("approached", sg.Model(approach, rename={"place": "first"})),
            "second": ("approached", sg.Model(approach, rename={"place": "second"})),
        },
        {"first": 0.5, "second": 0.5},
    )
    graph.edge("approached", "pushed", sg.Model(push, propagation=propagation))
    graph.reward("pushed", score)
    return graph


objective = sg.Objective(sg.unroll(graph_of("quadrature")))

# %%
# The plan
# --------
# A state that is uncertain is given as a Gaussian.

seen = Situation(first=np.array([0.35, 0.4]), first_sd=0.03, second=np.array([0.6, 0.55]), second_sd=0.08)
state = {
    "first": sg.Gaussian(seen.first, sd=[seen.first_sd] * 2),
    "second": sg.Gaussian(seen.second, sd=[seen.second_sd] * 2),
}
plan = sg.solve(objective, state)
print(plan)

# %%
# What if uncertainty is ignored?
# -------------------------------
# With "mean" a Gaussian counts as its mean. The shortest push that takes both means then looks best, and the funnel's
# edges run through them.

careless = sg.solve(sg.Objective(sg.unroll(graph_of("mean"))), state)


def draw(axes, plan, title):
    for mean, sd, color in ((seen.first, seen.first_sd, "tab:blue"), (seen.second, seen.second_sd, "tab:orange")):
        for k in (1, 2):
            axes.add_patch(Circle(mean, k * sd, color=color, alpha=0.25, linewidth=0))
    ahead = np.array([np.cos(plan.actions["theta"]), np.sin(plan.actions["theta"])])
    left = np.array([-ahead[1], ahead[0]])
    start = plan.actions["gripper"]
    end = start + plan.actions["advance"] * ahead
    for centre, style in ((start, "k--"), (end, "k-")):
        arms = np.array([centre + 0.3 * (ahead + left), centre, centre + 0.3 * (ahead - left)])
        axes.plot(*arms.T, style)
    axes.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": "tab:red"})
    success = success_probability(seen, start, plan.actions["theta"], plan.actions["advance"])
    axes.set(title=f"{title}: {100 * success:.0f}%", xlim=(-0.1, 1.1), ylim=(-0.1, 1.1), aspect="equal")


_, (left_panel, right_panel) = plt.subplots(1, 2, figsize=(9, 4.5), layout="constrained")
draw(left_panel, careless, "uncertainty ignored")
draw(right_panel, plan, "uncertainty planned for")

# %%
# The push
# --------
# The world puts the object down near one of the places, and the gripper pushes.

world = World(seen)
offsets = []
for seed in range(200):
    world.reset(seed)
    world.execute("aim", plan.actions, plan.selections)
    offsets.append(world.execute("approached", plan.actions, plan.selections)["pushed"]["offset"])
captured = np.all(np.array(offsets) == 0, axis=1)
print(f"captured in {captured.sum()} of {len(captured)} episodes")
plt.show()
