"""How fast symgraph is: gradients and plans beside what else one would use, large tasks, first calls, two cores.

From the repository's root, after `make bench` has installed what symgraph is compared with:
`python docs/reproduction/speed.py`, or with the names of some parts. Each part writes a table to speed/; the machine
should have nothing else to do.
"""

import csv
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):  # before numpy
    os.environ[variable] = "1"

import numpy as np

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import symgraph as sg

FOLDER = Path(__file__).with_suffix("")
SIZES = (10, 100, 1000, 10_000, 100_000)
NETWORKS = {"2 x 32": (32, 32), "3 x 200": (200, 200, 200)}
ROUNDS = 9
SITUATIONS = 50
STARTS = 16
TOLERANCE = 1e-9  # of a climb, relative to the spread of J
CLOSE = 1e-6  # to the best value


def write(name, rows):
    FOLDER.mkdir(exist_ok=True)
    with (FOLDER / f"{name}.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, rows[0], lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
    print(name)
    for row in rows:
        print("  ", *row.values())


def alone(code, **environment):
    """Run Python code in a process of its own; return what it prints as JSON."""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, env=os.environ | {"PYTHONPATH": "docs/reproduction"} | environment,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


# Gradients


def gradients():
    """Time of a value with its gradient beside JAX, torch and numpy by hand, and the value's share."""
    from benchmarks import test_gradients as bench

    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    rows = []
    for name, hidden in NETWORKS.items():
        for count in (1, 16, 256):
            turns = bench.Turns(hidden, count)
            for _ in range(ROUNDS + 1):
                turns.take()
            median = turns.medians()
            row = {"networks": name, "points": count, "symgraph [µs]": f"{1e6 * median['symgraph']:.3g}"}
            others = ("JAX", "torch.func", "torch", "torch.compile", "numpy")
            row |= {f"{other} / symgraph": f"{median[other] / median['symgraph']:.2f}" for other in others}
            row["products alone / symgraph"] = f"{median['products alone'] / median['symgraph']:.2f}"
            single = [median.get(f"{other}, float32", np.nan) for other in ("JAX", "symgraph")]
            row["float32: JAX / symgraph"] = f"{single[0] / single[1]:.2f}" if np.isfinite(single).all() else ""
            rows.append(row)
            write("gradients", rows)


# Large tasks


def pendulum(visits):
    """A loop: one node, visited again and again."""
    import casadi as ca

    slots = {"x": sg.State(), "v": sg.State(), "k": sg.Action(low=-2, high=2), "d": sg.Action(low=0, high=1)}
    graph = sg.Graph(slots, start="here")
    graph.edge("here", "here", lambda x, v, k, d: {"x": x + 0.01 * v, "v": v - 0.01 * (ca.sin(x) + k * x + d * v)})
    graph.reward("here", lambda x, v: -0.01 * (x**2 + 0.1 * v**2))
    return sg.unroll(graph, max_visits=visits), {"x": 0.5, "v": 0.1}


def forks(nodes):
    """A loop with two branches: at each visit chance decides, and the tree doubles."""
    import casadi as ca

    graph = sg.Graph({"x": sg.State(), "k": sg.Action(low=-2, high=2)}, start="here")
    ways = {"a": ("here", lambda x, k: {"x": ca.sin(x + k)}), "b": ("here", lambda x, k: {"x": 0.9 * x - 0.1 * k * k})}
    graph.chance("here", ways, {"a": 0.4, "b": 0.6})
    graph.reward("here", lambda x: -(x**2))
    return sg.unroll(graph, max_visits=int(np.ceil(np.log2(nodes + 1))) - 1), {"x": 0.5}


def strangers(nodes):
    """A tree in which no two nodes are alike: every fork has a probability of its own."""
    import casadi as ca

    graph = sg.Graph({"x": sg.State(), "k": sg.Action(low=-2, high=2)}, start="n0")

    def left(x, k):
        return {"x": ca.sin(x + k)}

    def right(x, k):
        return {"x": 0.9 * x - 0.1 * k * k}

    def reward(x):
        return -(x**2)

    nodes += 1 - nodes % 2  # every fork has two branches
    for i in range(nodes):
        if 2 * i + 2 < nodes:
            p = 0.2 + 0.6 * (i * 37 % 101) / 101
            graph.chance(f"n{i}", {"a": (f"n{2 * i + 1}", left), "b": (f"n{2 * i + 2}", right)}, {"a": p, "b": 1 - p})
        graph.reward(f"n{i}", reward)
    return sg.unroll(graph), {"x": 0.5}


def measured(kind, size):
    """Build, compile and evaluate one task; print what that took as JSON."""
    import resource

    begin = time.perf_counter()
    tree, state = globals()[kind](size)
    unrolled = time.perf_counter()
    objective = sg.Objective(tree)
    situation = objective.situation(state)
    situation.build.expectation.value_function()
    built = time.perf_counter()
    objective.compile(state, progress=False)
    compiled = time.perf_counter()
    kernel = situation.bind(*objective.bounds)
    points = np.random.default_rng(0).uniform(*objective.bounds, (16, objective.n_actions))
    seconds = []
    while len(seconds) < 3 or sum(seconds) < 0.5:
        at = time.perf_counter()
        kernel.evaluate(points, np.zeros((16, 0)))
        seconds.append(time.perf_counter() - at)
    result = {
        "task": kind,
        "nodes": len(tree.nodes),
        "unroll [s]": unrolled - begin,
        "build [s]": built - unrolled,
        "compile [s]": compiled - built,
        "gradient [s/point]": min(seconds) / 16,
        "memory [MB]": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
    }
    print(json.dumps(result))


def scaling():
    """Tasks of 10 to 100,000 nodes: time and memory, as a table and a picture."""
    rows = []
    for kind in ("pendulum", "forks", "strangers"):
        for size in SIZES:
            with tempfile.TemporaryDirectory() as cold:
                row = alone(f"import speed; speed.measured({kind!r}, {size})", XDG_CACHE_HOME=cold)
            rows.append(
                {key: float(f"{value:.3g}") if isinstance(value, float) else value for key, value in row.items()}
            )
            write("scaling", rows)
    draw(rows)


def draw(rows):
    import matplotlib.pyplot as plt

    columns = ("build [s]", "compile [s]", "gradient [s/point]", "memory [MB]")
    figure, axes = plt.subplots(1, len(columns), figsize=(13, 3.4), layout="constrained")
    for axis, column in zip(axes, columns, strict=True):
        for kind, marker in zip(("pendulum", "forks", "strangers"), "os^", strict=True):
            own = [row for row in rows if row["task"] == kind]
            axis.loglog([row["nodes"] for row in own], [row[column] for row in own], marker=marker, label=kind)
        axis.set(xlabel="nodes of the tree", title=column)
        axis.grid(alpha=0.3)
    axes[0].legend()
    figure.savefig(FOLDER / "scaling.svg")


# First calls


def first(name):
    """Print how long a first plan takes, a second one, and one in the interpreter, as JSON."""
    from benchmarks import pouring_like

    from models import cannon, push

    makers = {
        "cannon": (lambda **o: sg.Objective(sg.unroll(cannon.graph()), **o), cannon.state(0.5)),
        "push": (
            lambda **o: sg.Objective(sg.unroll(push.graph()), **o),
            push.state((0.3, 0.0), 0.02, (0.35, 0.05), 0.02),
        ),
        **{net: (partial(pouring_like.objective, hidden), pouring_like.state) for net, hidden in NETWORKS.items()},
    }
    make, state = makers[name]
    times = {}
    objective = make()
    for call in ("first plan [s]", "second plan [s]"):
        begin = time.perf_counter()
        sg.solve(objective, state, progress=False)
        times[call] = time.perf_counter() - begin
    if not os.environ.get("WARM"):
        begin = time.perf_counter()
        sg.solve(make(compiled=False), state, progress=False)
        times["interpreter [s]"] = time.perf_counter() - begin
    print(json.dumps(times))


def first_calls():
    """What the first plan in a process costs, with nothing in the cache and with machine code there."""
    rows = []
    for name in ("cannon", "push", *NETWORKS):
        with tempfile.TemporaryDirectory() as cache:
            code = f"import speed; speed.first({name!r})"
            cold = alone(code, XDG_CACHE_HOME=cache)
            warm = alone(code, XDG_CACHE_HOME=cache, WARM="1")
        row = {"task": name, "cold [s]": cold["first plan [s]"], "warm [s]": warm["first plan [s]"]}
        row |= {"then [s]": cold["second plan [s]"], "interpreter [s]": cold["interpreter [s]"]}
        rows.append({key: value if isinstance(value, str) else float(f"{value:.3g}") for key, value in row.items()})
    write("first_calls", rows)


# Plans


def situations(count):
    """Return start states near that of pouring_like.py."""
    rng = np.random.default_rng(5)
    from benchmarks import pouring_like

    return [{"x": pouring_like.state["x"] + rng.normal(0.0, 0.3, 16)} for _ in range(count)]


def plans():
    """Climbs from the same starts: symgraph's kernel, and JAX's gradients under SciPy's L-BFGS-B."""
    from benchmarks import gradients_jax, pouring_like
    from scipy.optimize import minimize

    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    rows = []
    for name, hidden in NETWORKS.items():
        objective = pouring_like.objective(hidden)
        weights = pouring_like.weights(hidden)
        low, high = objective.bounds
        times = {"solve": [], "climbs": [], "JAX": []}
        close = dict.fromkeys(times, 0)
        count = SITUATIONS if name == "2 x 32" else SITUATIONS // 5
        for n, state in enumerate(situations(count + 1)):
            kernel = objective.situation(state).bind(low, high)
            points = np.random.default_rng(n).uniform(low, high, (STARTS, len(low)))
            none = np.zeros((STARTS, 0))
            spread = float(np.ptp(kernel.evaluate(points, none)[0]))
            evaluate = gradients_jax.evaluator(weights, state)

            def downhill(x, evaluate=evaluate):
                value, gradient = evaluate(x[None])
                return -float(value[0]), -gradient[0]

            downhill(points[0])
            found = {}
            begin = time.process_time()
            found["solve"] = sg.solve(objective, state, progress=False).value
            solved = time.process_time()
            climbed = list(kernel.climb(points, none, 2000, np.full(STARTS, TOLERANCE * spread)))
            found["climbs"] = max(ended.value for _, ended in climbed)
            ended = time.process_time()
            bounds, options = list(zip(low, high, strict=True)), {"gtol": TOLERANCE * spread, "ftol": 1e-15}
            ends = [minimize(downhill, x, jac=True, method="L-BFGS-B", bounds=bounds, options=options) for x in points]
            found["JAX"] = max(-end.fun for end in ends)
            over = time.process_time()
            if n:  # the first one compiles
                for way, spent in zip(times, (solved - begin, ended - solved, over - ended), strict=True):
                    times[way].append(spent)
                    close[way] += found[way] >= max(found.values()) - CLOSE
        median = {way: statistics.median(spent) for way, spent in times.items()}
        row = {"networks": name, "situations": count}
        for way, label in (("solve", "solve()"), ("climbs", "climbs"), ("JAX", "JAX and SciPy")):
            row |= {f"{label} [ms]": f"{1e3 * median[way]:.3g}", f"{label}, best": f"{close[way] / count:.2f}"}
        rows.append(row)
    write("plans", rows)


def cores():
    """A plan with 32 starts on networks of 3 x 200, by one thread and by two, in turns."""
    from benchmarks import pouring_like

    objective = pouring_like.objective(NETWORKS["3 x 200"])
    seconds = {1: [], 2: []}
    for n, state in enumerate(situations(ROUNDS + 1)):
        values = []
        for threads, spent in seconds.items():
            begin = time.perf_counter()
            values.append(sg.solve(objective, state, sg.Lbfgs(starts=32), threads=threads, progress=False).value)
            if n:
                spent.append(time.perf_counter() - begin)
        if values[0] != values[1]:
            raise SystemExit(f"{values} differ")
    one, two = (statistics.median(spent) for spent in seconds.values())
    ratios = [a / b for a, b in zip(*seconds.values(), strict=True)]
    write("cores", [{"one thread [s]": f"{one:.3f}", "two threads [s]": f"{two:.3f}", "ratio": f"{one / two:.2f}",
                     "median of ratios": f"{statistics.median(ratios):.2f}"}])  # fmt: skip


PARTS = {"gradients": gradients, "scaling": scaling, "first_calls": first_calls, "plans": plans, "cores": cores}

if __name__ == "__main__":
    for part in sys.argv[1:] or PARTS:
        PARTS[part]()
