"""Measure how well error models know a network's errors, and how long a fit takes.

Writes calibration/results.csv, one row per task, error model and data set, and table.csv from that file alone. A run
that was stopped goes on where it was.
"""

import csv
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT)]

from symgraph.learned import StochasticNetwork

FOLDER = Path(__file__).with_suffix("")
RESULTS = FOLDER / "results.csv"
COLUMNS = ["task", "error_model", "seed", "log_likelihood", "rmse", "within_68", "within_95", "cold_s", "warm_s"]
SAMPLES, FRESH, SEEDS = 200, 5000, range(8)
HIDDEN = (200, 200, 200)


def step(x):
    return np.where(x[:, :1] < 1.0, 0.0, 4.0)


def sine(x):
    return 1.2 + np.sin(3.0 * x[:, :1])


def pouring(x):
    """Amount received over tilt, mouth, offset and viscosity, each in [0, 1]; it jams and it saturates."""
    tilt, mouth, offset, viscosity = x.T
    flow = np.clip((tilt - 0.4 - 0.3 * viscosity) / 0.25, 0.0, 1.0) * (mouth > 0.15 + 0.35 * viscosity) * (0.3 + mouth)
    return (flow * np.exp(-(((offset - 0.5) / 0.18) ** 2)))[:, None]


# name: (function, noise as a function of x, inputs, low, high)
TASKS = {
    "step": (step, lambda x: np.full((len(x), 1), 0.1), 1, -3.0, 5.0),
    "sine": (sine, lambda x: np.full((len(x), 1), 0.2), 1, -3.0, 3.0),
    "sine, noise grows": (sine, lambda x: 0.05 + 0.1 * np.abs(x), 1, -3.0, 3.0),
    "pouring, 4-D": (pouring, lambda x: np.full((len(x), 1), 0.02), 4, 0.0, 1.0),
}


class InSample(StochasticNetwork):
    """As `StochasticNetwork`, but its error model learns from errors on the training samples."""

    def _errors(self, seen, held_out):
        return np.arange(len(seen)), seen


ERROR_MODELS = {
    "out of fold": lambda n: StochasticNetwork({"x": n}, {"y": 1}, HIDDEN),
    "in sample": lambda n: InSample({"x": n}, {"y": 1}, HIDDEN),
    "paper": lambda n: StochasticNetwork({"x": n}, {"y": 1}, HIDDEN, error="paper"),
}


def draw(task, count, rng):
    function, noise, n, low, high = TASKS[task]
    x = rng.uniform(low, high, (count, n))
    return x, function(x) + noise(x) * rng.standard_normal((count, 1))


def measure(task, error_model, seed):
    """Fit on 200 samples, judge on 5000 fresh ones, then fit once more with one further sample."""
    rng = np.random.default_rng(seed)
    x, y = draw(task, SAMPLES + 1, rng)
    network = ERROR_MODELS[error_model](x.shape[1])
    cold = network.fit(x[:-1], y[:-1], seed=seed).seconds
    xt, yt = draw(task, FRESH, rng)
    mean, covariance = network.predict(xt)
    errors, variance = (yt - mean)[:, 0], np.maximum(covariance[:, 0, 0], 1e-12)
    ratio = np.abs(errors) / np.sqrt(variance)
    warm = network.fit(x, y, seed=seed)
    return {
        "task": task,
        "error_model": error_model,
        "seed": seed,
        "log_likelihood": np.mean(-0.5 * np.log(2 * np.pi * variance) - 0.5 * ratio**2),
        "rmse": np.sqrt(np.mean(errors**2)),
        "within_68": np.mean(ratio < 0.99446),  # quantiles of the normal distribution's central 68 and 95%
        "within_95": np.mean(ratio < 1.95996),
        "cold_s": cold,
        "warm_s": warm.seconds if warm.warm else "",
    }


def tabulate():
    """Write table.csv: means over the data sets, with the standard error of the mean for the log-likelihood."""
    groups = defaultdict(list)
    for row in csv.DictReader(RESULTS.open()):
        groups[row["task"], row["error_model"]].append(row)
    with (FOLDER / "table.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["task", "error model", "log-likelihood", "RMSE", "within 68%", "within 95%"])
        for (task, error_model), rows in groups.items():
            columns = {c: np.array([float(r[c]) for r in rows]) for c in COLUMNS[3:7]}
            likelihood = columns["log_likelihood"]
            spread = likelihood.std(ddof=1) / np.sqrt(len(rows))
            cells = [f"{likelihood.mean():.3g} ± {spread:.2g}", f"{columns['rmse'].mean():.3f}"]
            cells += [f"{100 * columns[c].mean():.1f}" for c in ("within_68", "within_95")]
            writer.writerow([task, error_model, *cells])
    times = {c: sorted(float(r[c]) for rows in groups.values() for r in rows if r[c]) for c in ("cold_s", "warm_s")}
    for name, seconds in times.items():
        print(f"{name}: median {np.median(seconds):.2f}, least {seconds[0]:.2f}, most {seconds[-1]:.2f}")


def main():
    FOLDER.mkdir(exist_ok=True)
    if not RESULTS.exists():
        RESULTS.write_text(",".join(COLUMNS) + "\n")
    done = {(r["task"], r["error_model"], int(r["seed"])) for r in csv.DictReader(RESULTS.open())}
    for task in TASKS:
        for seed in SEEDS:
            for error_model in ERROR_MODELS:
                if (task, error_model, seed) not in done:
                    row = measure(task, error_model, seed)
                    with RESULTS.open("a", newline="") as file:
                        csv.DictWriter(file, COLUMNS).writerow(row)
                    print(" ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in row.values()), flush=True)
    tabulate()


if __name__ == "__main__":
    main()
