"""Measure how well and how fast each rule sends Gaussians through trained networks, against Monte Carlo.

Writes propagation/results.csv, one row per network, spread and rule, and table.csv from that file alone. A run that was
stopped goes on where it was; to measure anew, delete rows.
"""

import csv
import sys
import time
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import typer

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT)]

import symgraph as sg
from symgraph.cubature import square_root, unscented
from symgraph.learned import StochasticNetwork

FOLDER = Path(__file__).with_suffix("")
RESULTS = FOLDER / "results.csv"
COLUMNS = [
    "network",  # see NETWORKS
    "spread_percent",
    "rule",
    "mean_error",  # of the mean, averaged over points and outputs [standard deviations of the output's data]
    "sd_error",  # of the standard deviation, likewise
    "gradient_error",  # of the mean's gradient, relative, over all points and outputs
    "sd_ratio",  # median of found by true standard deviation, where the latter is not next to nothing
    "value_ms",  # one value in CasADi's interpreter
    "gradient_ms",  # one value with its gradient, compiled
]
PLAIN_RULES = ["local linear", "unscented"]
RULES = [*PLAIN_RULES, "paper", "diagonal", "low-rank", "full", "full-exact", "quadrature", "split", "auto"]
SPREADS = [3, 10]  # standard deviation of every input [% of its range]
DRAWS = 1_000_000  # antithetic pairs count as two


def step(x):
    return np.where(x[:, :1] < 1.0, 0.0, 4.0)


def sine(x):
    return 1.2 + np.sin(3.0 * x[:, :1])


def pouring(x):
    """Amounts received and spilled over tilt, mouth, offset and viscosity, each in [0, 1]; it jams and it saturates."""
    tilt, mouth, offset, viscosity = x[:, :4].T
    flow = np.clip((tilt - 0.4 - 0.3 * viscosity) / 0.25, 0.0, 1.0) * (mouth > 0.15 + 0.35 * viscosity) * (0.3 + mouth)
    hit = np.exp(-(((offset - 0.5) / 0.18) ** 2))
    return np.stack([flow * hit, flow * (1.0 - hit)], axis=1)


def wide(x):
    """Like `pouring`, with fourteen further inputs that matter a little each."""
    bend = np.tanh(2.0 * (x[:, 4:11] - 0.5).sum(axis=1)) * np.sin(3.0 * x[:, 11] + 2.0 * x[:, 12] * x[:, 13])
    tail = bend + x[:, 14:18] @ np.array([0.5, -0.5, 0.3, 0.2])
    return np.column_stack([pouring(x) + 0.3 * tail[:, None], tail])


# name: (function, inputs, low, high, hidden, points where it is judged)
NETWORKS = {
    "step": (step, 1, -3.0, 5.0, (100, 100), 24),
    "sine": (sine, 1, -3.0, 3.0, (100, 100), 24),
    "pouring": (pouring, 4, 0.0, 1.0, (100, 100), 24),
    "wide": (wide, 18, 0.0, 1.0, (200, 200, 200), 12),
}


@cache
def trained(name):
    """The network, the points (P, n) where it is judged, and the outputs' standard deviations (m,)."""
    function, n, low, high, hidden, points = NETWORKS[name]
    rng = np.random.default_rng(0)
    x = rng.uniform(low, high, (2000, n))
    y = function(x)
    y = y + 0.02 * y.std(axis=0) * rng.standard_normal(y.shape)
    network = StochasticNetwork({"x": n}, {"y": y.shape[1]}, hidden, error="none", name=name)
    print(name, network.fit(x, y))
    margin = 0.1 * (high - low)
    judged = rng.uniform(low + margin, high - margin, (points, n))
    if name == "step":
        judged = np.linspace(-1.0, 3.0, points)[:, None]  # around the jump, where it is hard
    return network, judged, y.std(axis=0)


@cache
def truth(name, spread):
    """Mean (P, m), standard deviation (P, m) and gradient of the mean (P, m, n) by Monte Carlo."""
    network, judged, _ = trained(name)
    _, n, low, high, _, _ = NETWORKS[name]
    sd = spread / 100 * (high - low)
    rng = np.random.default_rng(1)
    moments = []
    for point in judged:
        middle = network.predict(point)[0]
        total, squares, slope = 0.0, 0.0, 0.0
        for _ in range(DRAWS // 50_000):
            z = rng.standard_normal((25_000, n))
            z = np.concatenate([z, -z])
            y = _mean(network, point + sd * z) - middle
            total, squares, slope = total + y.sum(axis=0), squares + (y * y).sum(axis=0), slope + y.T @ z
        mean = total / DRAWS
        # Stein's identity: the gradient of the mean is cov(y, z) / sd.
        moments.append((middle + mean, np.sqrt(np.maximum(squares / DRAWS - mean**2, 0.0)), slope / DRAWS / sd))
    return tuple(np.array(column) for column in zip(*moments, strict=True))


def _mean(network, x):
    """Outputs in single precision, which is fast and exact enough for averages of a million."""
    weights = [p.value.astype(np.float32) for p in network.parameters]
    hidden = x.astype(np.float32)
    for i in range(0, len(weights), 2):
        hidden = hidden @ weights[i].T + weights[i + 1].T
        if i < len(weights) - 2:
            np.maximum(hidden, 0.0, out=hidden)
    return hidden.astype(float)


class PlainRule:
    """What the rules for plain functions would make of the network: for comparison."""

    reads, writes = ("x",), ("y",)

    def __init__(self, network, rule):
        self.rule, self.parameters = rule, network.parameters

    def propagate(self, inputs):
        x = inputs["x"]
        if self.rule == "local linear":
            y = self._outputs(x.mean)
            slope = ca.jacobian(y, x.mean)
            return {"y": sg.Gaussian(y, ca.mtimes([slope, x.covariance, slope.T]))}
        rule = unscented(x.mean.numel())
        root, weights = square_root(x.covariance), ca.DM(rule.weights)
        ys = self._outputs(ca.repmat(x.mean, 1, len(rule.weights)) + ca.mtimes(root, ca.DM(rule.points)))
        mean = ca.mtimes(ys, weights)
        apart = ys - ca.repmat(mean, 1, len(rule.weights))
        return {"y": sg.Gaussian(mean, ca.mtimes(apart * ca.repmat(weights.T, mean.numel(), 1), apart.T))}

    def _outputs(self, x):
        symbols = [p.symbol for p in self.parameters]
        for i in range(0, len(symbols), 2):
            x = ca.mtimes(symbols[i], x) + ca.repmat(symbols[i + 1], 1, x.shape[1])
            x = ca.fmax(x, 0.0) if i < len(symbols) - 2 else x
        return x


def model_of(name, rule):
    """The network under a rule."""
    network = trained(name)[0]
    return PlainRule(network, rule) if rule in PLAIN_RULES else sg.Model(network, propagation=rule)


def measure(name, spread, rule):
    """One row: errors over all points and outputs, and the time of one value and of one value with gradient."""
    _, judged, scale = trained(name)
    _, n, low, high, _, _ = NETWORKS[name]
    sd = spread / 100 * (high - low)
    true_mean, true_sd, true_gradient = truth(name, spread)
    m = len(scale)
    # The expected outputs are expected rewards, so that value, gradient and time come the way a planner has them.
    slots = {"u": sg.Action(n, low=low, high=high), "x": sg.State(n), "y": sg.State(m)}
    means, sds, gradients, seconds = [], [], [], []
    for output in range(m):
        graph = sg.Graph(slots, start="before")
        graph.edge("before", "shifted", lambda x, u: {"x": x + u})
        graph.edge("shifted", "after", model_of(name, rule))
        graph.reward("after", lambda y, output=output: y[output])
        objective = sg.Objective(sg.unroll(graph))
        state = {"x": sg.Gaussian(np.zeros(n), sd=sd)}
        values, slopes = objective.evaluate(state, judged.T)
        means.append(values), gradients.append(slopes.T)
        if output == 0:
            sds = [objective.outcomes(state, {"u": point})[-1].states["y"].sd for point in judged]
            seconds = _clock(objective.evaluate, state, judged.T) / len(judged)
            plain = _clock(objective.value, state, {"u": judged[0]})
    mean, gradient, sd_found = np.array(means).T, np.array(gradients).transpose(1, 0, 2), np.reshape(sds, true_sd.shape)
    visible = true_sd > 0.02 * scale
    weigh = scale[None, :, None]
    return {
        "network": name,
        "spread_percent": spread,
        "rule": rule,
        "mean_error": np.mean(np.abs(mean - true_mean) / scale),
        "sd_error": np.mean(np.abs(sd_found - true_sd) / scale),
        "gradient_error": np.linalg.norm((gradient - true_gradient) / weigh) / np.linalg.norm(true_gradient / weigh),
        "sd_ratio": np.median((sd_found / np.maximum(true_sd, 1e-12))[visible]),
        "value_ms": 1e3 * plain,
        "gradient_ms": 1e3 * seconds,
    }


def _clock(work, *arguments):
    """The shortest of several runs, since others use the machine too [s]."""
    seconds = []
    while len(seconds) < 3 or (sum(seconds) < 0.2 and len(seconds) < 50):
        begin = time.perf_counter()
        work(*arguments)
        seconds.append(time.perf_counter() - begin)
    return min(seconds)


def tabulate():
    """Write table.csv: a row per rule, a column per network and spread."""
    rows = list(csv.DictReader(RESULTS.open()))
    cases = list(dict.fromkeys((r["network"], r["spread_percent"]) for r in rows))
    with (FOLDER / "table.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["rule", *(f"{network} {spread}%" for network, spread in cases), "gradient of wide [ms]"])
        for rule in RULES:
            cells = {}
            for r in rows:
                if r["rule"] == rule:
                    numbers = [float(r[c]) for c in ("mean_error", "sd_error", "gradient_error")]
                    cells[r["network"], r["spread_percent"]] = " / ".join(f"{x:.2g}" for x in numbers)
            times = [r["gradient_ms"] for r in rows if r["rule"] == rule and r["network"] == "wide"]
            cost = f"{float(times[-1]):.3g}" if times else ""
            writer.writerow([rule, *(cells.get(case, "") for case in cases), cost])


def main(networks: list[str] | None = None) -> None:
    """Measure what has not been measured yet, for the networks named or all."""
    FOLDER.mkdir(exist_ok=True)
    if not RESULTS.exists():
        RESULTS.write_text(",".join(COLUMNS) + "\n")
    done = {(r["network"], r["spread_percent"], r["rule"]) for r in csv.DictReader(RESULTS.open())}
    for name in networks or NETWORKS:
        for spread in SPREADS:
            for rule in RULES:
                if (name, str(spread), rule) in done:
                    continue
                row = measure(name, spread, rule)
                with RESULTS.open("a", newline="") as file:
                    csv.DictWriter(file, COLUMNS).writerow(row)
                print(" ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()), flush=True)
    tabulate()


if __name__ == "__main__":
    typer.run(main)
