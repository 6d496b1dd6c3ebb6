"""
Bring your own network
======================

A robot puts balls into a box: it throws them, or it walks over and drops them in, which is sure but takes time. How far
a throw goes is learned by networks of our own, written and trained in torch. Several of them, trained from different
beginnings, agree where there are data and part where there are none, and that is all the planner needs to know when not
to trust them.
"""

# %%
# The throws
# ----------
# Balls are light, and air slows them down. The robot has seen two hundred throws, all of them gentle.

import copy

import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import nn

import symgraph as sg

GRAVITY, DRAG, STEP = 9.81, 0.12, 2e-3  # [m/s^2], [1/m], [s]


def flight(speed, angle):
    """How far balls fly that leave the hand 1 m above the floor [m]."""
    x, height = np.zeros_like(speed), np.ones_like(speed)
    along, up = speed * np.cos(angle), speed * np.sin(angle)
    while (height > 0).any():
        flies = height > 0
        brake = DRAG * np.hypot(along, up)
        x, height = x + flies * STEP * along, height + flies * STEP * up
        along, up = along - STEP * brake * along, up - STEP * (GRAVITY + brake * up)
    return x


def throws(count, slowest, fastest, rng):
    speed, angle = rng.uniform(slowest, fastest, count), rng.uniform(0.2, 1.2, count)
    seen = flight(speed, angle) + 0.01 * rng.standard_normal(count)
    return np.column_stack([speed, angle]), seen[:, None]


rng = np.random.default_rng(0)
inputs, distances = throws(200, 1.0, 4.0, rng)


# %%
# The networks
# ------------
# Any module will do. This one scales its inputs with buffers, and hands the speed past the layers.


class Throw(nn.Module):
    def __init__(self):
        super().__init__()
        self.register_buffer("middle", torch.tensor([3.0, 0.7]))
        self.register_buffer("scale", torch.tensor([1.5, 0.3]))
        self.net = nn.Sequential(nn.Linear(2, 32), nn.Tanh(), nn.Linear(32, 32), nn.Tanh(), nn.Linear(32, 1))

    def forward(self, x):
        scaled = (x - self.middle) / self.scale
        return self.net(scaled) + scaled[:, :1]


def train(module, x, y, steps):
    x, y = (torch.as_tensor(part, dtype=torch.float32) for part in (x, y))
    optimizer = torch.optim.Adam(module.parameters(), lr=3e-3)
    for _ in range(steps):
        chosen = torch.randint(len(x), (64,))
        optimizer.zero_grad()
        nn.functional.mse_loss(module(x[chosen]), y[chosen]).backward()
        optimizer.step()


ensemble = []
for seed in range(4):
    torch.manual_seed(seed)
    ensemble.append(Throw())
    train(ensemble[-1], inputs, distances, 600)

# %%
# The task
# --------
# :func:`symgraph.learned.from_torch` takes the list as it is. Its mean and spread are those of a mixture of the
# members. Speed and angle stand beside each other in the row that the module takes.

landing = sg.learned.from_torch(ensemble, reads={"speed": 1, "angle": 1}, writes={"landing": 1}, name="throw")

graph = sg.Graph(
    {
        "how": sg.Selection(["throw", "walk"]),
        "speed": sg.Action(low=1.0, high=7.0, unit="m/s"),
        "angle": sg.Action(low=0.2, high=1.2, unit="rad"),
        "box": sg.State(unit="m"),
        "landing": sg.State(unit="m"),
    },
    start="holds ball",
)
graph.choose("holds ball", "how", {"throw": ("thrown", landing), "walk": ("dropped", None)})
graph.reward("thrown", lambda landing, box: 1 - ((landing - box) / 0.25) ** 2)  # the box is half a metre wide
graph.reward("dropped", lambda box: 1 - 0.2 * box)  # walking takes its time

objective = sg.Objective(sg.unroll(graph))
boxes = np.linspace(0.5, 4.0, 15)


def plans():
    return [sg.solve(objective, {"box": box}) for box in boxes]


before = plans()
print(before[2], before[-1], sep="\n")

# %%
# Near boxes are thrown at, the farthest walked to: a throw that goes so far is faster than any that the networks have
# seen, they disagree about it, and the expected reward counts their spread.
#
# More data
# ---------
# The robot tries sixty fast throws, and the networks are trained on. **Nothing is exported or compiled anew:** weights
# are read from the modules whenever a plan is made.

naive = copy.deepcopy(ensemble)  # for the picture
more, farther = throws(60, 4.0, 7.0, rng)
inputs, distances = np.vstack([inputs, more]), np.vstack([distances, farther])
for seed, module in enumerate(ensemble):
    torch.manual_seed(seed)
    train(module, inputs, distances, 600)

after = plans()
print(after[-1])

# %%
# What the networks say of throws at 0.7 rad, and what the planner makes of it.

figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
speeds = np.linspace(1, 7, 100)
rows = np.column_stack([speeds, np.full_like(speeds, 0.7)])
for members, colour, label in ((naive, "C1", "200 gentle throws"), (ensemble, "C0", "and 60 fast ones")):
    mean, covariance = sg.learned.from_torch(members, {"speed": 1, "angle": 1}, {"landing": 1}).predict(rows)
    sd = np.sqrt(covariance[:, 0, 0])
    left.fill_between(speeds, mean[:, 0] - 2 * sd, mean[:, 0] + 2 * sd, color=colour, alpha=0.3, lw=0)
    left.plot(speeds, mean[:, 0], color=colour, label=label)
left.plot(speeds, flight(speeds, rows[:, 1]), "k--", lw=1, label="true")
left.set(xlabel="speed [m/s]", ylabel="landing [m]", title="mean and two deviations of the ensemble")
left.legend()

for made, colour, label in ((before, "C1", "before"), (after, "C0", "after")):
    thrown = [plan.selections["how"] == "throw" for plan in made]
    values = np.array([plan.value for plan in made])
    right.plot(boxes, values, color=colour, label=label)
    right.plot(boxes[thrown], values[thrown], "o", color=colour)
right.plot([], [], "ko", label="thrown")
right.set(xlabel="distance of the box [m]", ylabel="expected reward", title="plans")
right.legend()
plt.show()

# %%
# And does it hit? The plans' throws in the simulation:

throwing = [plan for plan in after if plan.selections["how"] == "throw"]
speed, angle = (np.array([float(plan.actions[label]) for plan in throwing]) for label in ("speed", "angle"))
missed = np.abs(flight(speed, angle) - [plan.nodes[0].states["box"].mean for plan in throwing])
print(f"{len(throwing)} of {len(after)} are thrown; they miss the middle by {missed.max():.2f} m at most")
