"""Modules of torch as models: how exactly, what is refused, and how fast, against torch itself.

From the repository's root: `python docs/reproduction/torch_modules.py`, or with the names of some parts. Each part
writes a table to torch_modules/. All modules of the part "agreement" take half an hour.
"""

import csv
import os
import sys
import tempfile
import time
from pathlib import Path

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):  # before numpy
    os.environ[variable] = "1"

import numpy as np
import torch
from torch import nn

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from torch_oracles import Subject
from torch_zoo import MODULES, REFUSED

import symgraph as sg
from symgraph.compile import toolchain
from symgraph.learned.torch_modules import cache

FOLDER = Path(__file__).with_suffix("")
SEEDS = (5, 6)
GOAL = 0.3
ITERATIONS = 200  # of each climb
REPEATS = 7
torch.set_num_threads(1)


def write(name, rows):
    FOLDER.mkdir(exist_ok=True)
    with (FOLDER / f"{name}.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, rows[0], lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


def told(number):
    return "0" if number == 0 else f"{number:.0e}"


# Agreement


def agreement():
    """Value, Jacobian and Hessian of every module of the tests at two random points, three ways."""
    rows = []
    for entry in MODULES:
        subject = Subject(entry)
        worst = np.zeros((3, 3))
        for seed in SEEDS:
            x = subject.point(seed)
            expected = subject.by_torch(x)
            with tempfile.TemporaryDirectory() as folder:
                value, jacobian = subject.generated(x, folder)
            found = [expected.errors(subject.interpreted(x)), expected.errors(subject.compiled(x))]
            found.append((np.abs(value - expected.value).max(), np.abs(jacobian - expected.jacobian).max(), 0.0))
            worst = np.maximum(worst, found)
        numbers = [told(error) for error in worst.ravel()[:-1]]
        names = [
            f"{part}, {way}" for way in ("interpreter", "machine code") for part in ("value", "Jacobian", "Hessian")
        ]
        rows.append(
            {"module": entry.name, "inputs": subject.n, "outputs": subject.m}
            | dict(zip([*names, "value, C", "Jacobian, C"], numbers, strict=True))
        )
        print(*rows[-1].values(), flush=True)
    write("agreement", rows)
    largest = {name: max(float(row[name]) for row in rows) for name in rows[0] if ", " in name}
    write("largest", [{"what": name, "largest error": told(error)} for name, error in largest.items()])


def refusals():
    """What is said of modules that have no expression."""
    rows = []
    for entry in REFUSED:
        reads = [{f"x{i}": shape} for i, shape in enumerate(entry.shapes)]
        try:
            sg.learned.from_torch(entry.make(), reads, {"y": 2}, name="net")
        except sg.InputError as error:
            rows.append({"module": entry.name, "message": str(error)})
    write("refusals", rows)


# Times


def mlp(width):
    layers, size = [], 4
    for _ in range(3):
        layers += [nn.Linear(size, width), nn.Tanh()]
        size = width
    return nn.Sequential(*layers, nn.Linear(width, 2))


class Recurrent(nn.Module):
    """A GRU cell of 64 units, from no memory to two numbers."""

    def __init__(self):
        super().__init__()
        self.cell, self.out = nn.GRUCell(4, 64), nn.Linear(64, 2)

    def forward(self, x):
        return self.out(self.cell(x))


class Encoder(nn.Module):
    """Four tokens of 32 numbers through an encoder layer with four heads."""

    def __init__(self):
        super().__init__()
        self.embed, self.layer = nn.Linear(1, 32), nn.TransformerEncoderLayer(32, 4, 64, batch_first=True)
        self.out = nn.Linear(32, 2)

    def forward(self, x):
        return self.out(self.layer(self.embed(x.unsqueeze(-1)))[:, -1])


CASES = {"3 × 64": lambda: mlp(64), "3 × 200": lambda: mlp(200), "GRU cell": Recurrent, "encoder layer": Encoder}


def case(name):
    torch.manual_seed(0)
    return CASES[name]().eval()


def task(net, precision="double"):
    graph = sg.Graph({"x": sg.Action(4, low=-2.0, high=2.0), "y": sg.State(2)}, start="before")
    graph.edge("before", "after", sg.learned.from_torch(net, {"x": 4}, {"y": 2}))
    graph.reward("after", lambda y: -((y[0] - GOAL) ** 2) - (y[1] + GOAL) ** 2)
    return sg.Objective(sg.unroll(graph), precision=precision)


def reward(net, x):
    y = net(x)
    return -((y[:, 0] - GOAL) ** 2) - (y[:, 1] + GOAL) ** 2


def seconds(call, repeats=REPEATS):
    """The shortest time: others are disturbed."""
    best = np.inf
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        best = min(best, time.perf_counter() - begin)
    return best


def compared(precision, ours, torchs, unit):
    """Columns of a table."""
    return {
        f"symgraph, {precision} [{unit}]": f"{ours:.1f}",
        f"torch, {precision} [{unit}]": f"{torchs:.1f}",
        f"torch / symgraph, {precision}": f"{torchs / ours:.1f}",
    }


def building():
    """Seconds until a module can be planned with: the first time, and when caches know it."""
    sg.learned.from_torch(nn.Linear(1, 1), {"x": 1}, {"y": 1})  # imports torch's exporter
    rows = []
    for name in CASES:
        row = {"module": name}
        with tempfile.TemporaryDirectory() as folder:
            original, toolchain.platformdirs.user_cache_dir = toolchain.platformdirs.user_cache_dir, lambda _: folder
            for when in ("first", "again"):
                cache._known.clear()
                net = case(name)
                row[f"export, {when} [s]"] = f"{seconds(lambda net=net: task(net), 1):.3f}"
                objective = task(net)
                kernel = lambda o=objective: o.situation({}).bind(*o.bounds)  # noqa: E731
                row[f"machine code, {when} [s]"] = f"{seconds(kernel, 1):.3f}"
            toolchain.platformdirs.user_cache_dir = original
        rows.append(row)
        print(*row.values(), flush=True)
    write("building", rows)


def evaluation():
    """Microseconds for values and gradients of so many points side by side, on one core."""
    rows = []
    for name in CASES:
        for count in (1, 16, 128):
            points = np.random.default_rng(0).uniform(-2, 2, (count, 4))
            row = {"module": name, "points": count}
            for precision, dtype in (("double", torch.float64), ("single", torch.float32)):
                net = case(name)
                objective = task(net, precision)
                bound = objective.situation({}).bind(*objective.bounds)
                hot = np.zeros((count, 0))
                ours = seconds(lambda b=bound, p=points, h=hot: b.evaluate(p, h), 200)
                net = net.to(dtype).requires_grad_(False)
                x = torch.tensor(points, dtype=dtype, requires_grad=True)
                torchs = seconds(lambda n=net, x=x: torch.autograd.grad(reward(n, x).sum(), x), 200)
                row |= compared(precision, ours * 1e6, torchs * 1e6, "µs")
            rows.append(row)
            print(*row.values(), flush=True)
    write("evaluation", rows)


def multi_start(net, starts, dtype):
    """The search that symgraph is compared with: as many climbs by ADADELTA, all in one batch."""
    x = (4 * torch.rand(starts, 4, dtype=dtype) - 2).requires_grad_()
    optimizer = torch.optim.Adadelta([x], lr=0.1)
    best = torch.full((starts,), -torch.inf, dtype=dtype)
    for _ in range(ITERATIONS):
        values = reward(net, x)
        (x.grad,) = torch.autograd.grad(-values.sum(), x)
        best = torch.maximum(best, values.detach())
        optimizer.step()
        with torch.no_grad():
            x.clamp_(-2, 2)
    return float(best.max())


def planning():
    """Milliseconds for multi-starts of the same work: climbs by ADADELTA, 200 gradients each; and solve as it comes."""
    rows = []
    for name in CASES:
        for starts in (16, 128):
            row = {"module": name, "starts": starts}
            for precision, dtype in (("double", torch.float64), ("single", torch.float32)):
                net = case(name)
                objective = task(net, precision)
                settings = {"run_iterations": ITERATIONS, "oscillation": ITERATIONS, "tolerance": 0.0, "polish": False}
                optimizer = sg.Adadelta(starts=starts, sampling="uniform", **settings)
                plan = sg.solve(objective, {}, optimizer, progress=False)
                work = sum(run.gradients for run in plan.runs)
                ours = seconds(lambda o=objective, p=optimizer: sg.solve(o, {}, p, progress=False))
                net = net.to(dtype).requires_grad_(False)
                torchs = seconds(lambda n=net, s=starts, d=dtype: multi_start(n, s, d), 3)
                row |= {"gradients": work} | compared(precision, ours * 1e3, torchs * 1e3, "ms")
            objective = task(case(name))
            sg.solve(objective, {}, progress=False)
            row["solve as it comes [ms]"] = f"{seconds(lambda o=objective: sg.solve(o, {}, progress=False)) * 1e3:.1f}"
            rows.append(row)
            print(*row.values(), flush=True)
    write("planning", rows)


PARTS = (agreement, refusals, building, evaluation, planning)

if __name__ == "__main__":
    wanted = sys.argv[1:]
    for part in PARTS:
        if not wanted or part.__name__ in wanted:
            part()
