"""Time per value and gradient of a task with networks: symgraph beside JAX, torch and numpy by hand, on one core.

CPU time, in turns, so that whatever else the machine does hits all alike. All must agree with symgraph, or the times
would not compare. Calls that compile do not count. "products alone" are the matrix products that no order of the sums
avoids, by numpy's BLAS, which is far from the machine's best for few points and small matrices. Run by `make bench`,
which holds BLAS to one thread.
"""

import os
import statistics
import time
from functools import cache, partial

import numpy as np
import pytest
from benchmarks import pouring_like as task

LARGE, SMALL = (200, 200, 200), (32, 32)  # hidden units
ROUNDS = 9
SHORTEST = 0.02  # of a measurement [s]
AGREEMENT = 1e-9  # with symgraph, relative to the largest magnitude: far above rounding, which stays below 1e-13
SINGLE = 1e-5  # likewise of single precision
PASSES = {"flow_tip": 1, "flow_shake": 1, "amount": 2}  # of the networks, in each point


@pytest.fixture
def one_core():
    """Hold this process, and the threads that it starts from now on, on one core."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cores)})
    yield
    os.sched_setaffinity(0, cores)


@cache
def symgraph(hidden, precision="double"):
    """As a search has it: state and weights are bound once, like JAX's arrays."""
    objective = task.objective(hidden, precision=precision)
    kernel = objective.situation(task.state).bind(*objective.bounds)
    return lambda actions: kernel.evaluate(actions, np.zeros((len(actions), 0)))


def evaluators(hidden, count):
    """Return {name: (tolerance, function)}, symgraph first."""
    from benchmarks import gradients_jax, gradients_numpy, gradients_torch

    given = task.weights(hidden), task.state
    made = {
        "symgraph": (AGREEMENT, symgraph(hidden)),
        "JAX": (AGREEMENT, gradients_jax.evaluator(*given)),
        "torch": (AGREEMENT, gradients_torch.evaluator(*given)),
        "torch.func": (AGREEMENT, gradients_torch.evaluator(*given, way=gradients_torch.functional)),
        "torch.compile": (AGREEMENT, gradients_torch.evaluator(*given, way=gradients_torch.compiled())),
        "numpy": (AGREEMENT, gradients_numpy.evaluator(*given)),
    }
    if (hidden, count) == (LARGE, 256):
        made["symgraph, float32"] = (SINGLE, symgraph(hidden, "single"))
        made["JAX, float32"] = (SINGLE, gradients_jax.evaluator(*given, dtype=np.float32))
    return made


def products(hidden, count):
    """Return the function that does all matrix products of value and gradient, and their operations in a point.

    For each pass of a network: W X forward and Wᵀ Y backward, of means and variances, of mean and error network.
    """
    matrices = [
        matrix
        for name, network in task.prepared(task.weights(hidden)).items()
        for layer in PASSES[name] * (network["mean"] + network["error"])
        for matrix in layer[:2]
    ]
    columns = {size: np.ones((size, count)) for matrix in matrices for size in matrix.shape}
    results = {size: np.empty((size, count)) for size in columns}
    factors = [factor for matrix in matrices for factor in (matrix, matrix.T)]
    calls = [(factor, columns[factor.shape[1]], results[factor.shape[0]]) for factor in factors]

    def multiply():
        for factor, column, result in calls:
            np.matmul(factor, column, out=result)

    return multiply, sum(2 * factor.size for factor in factors)


def seconds_per_call(function):
    calls = 0
    begin = time.process_time()
    while (spent := time.process_time() - begin) < SHORTEST:
        function()
        calls += 1
    return spent / calls


class Turns:
    """All ways to the same numbers, each of which is timed in every round.

    Attributes:
        seconds: {name: [s/point]} so far.
        operations: of the products alone, in a point.
    """

    def __init__(self, hidden, count):
        actions = task.points(count)
        expected = symgraph(hidden)(actions)
        self._count = count
        self._functions = {}
        for name, (tolerance, evaluate) in evaluators(hidden, count).items():
            for one, other in zip(evaluate(actions), expected, strict=True):
                np.testing.assert_allclose(one, other, rtol=0, atol=tolerance * np.abs(other).max(), err_msg=name)
            self._functions[name] = partial(evaluate, actions)
        self._functions["products alone"], self.operations = products(hidden, count)
        self.seconds = {name: [] for name in self._functions}

    def take(self):
        for name, function in self._functions.items():
            self.seconds[name].append(seconds_per_call(function) / self._count)

    def medians(self):
        return {name: statistics.median(times[1:]) for name, times in self.seconds.items()}


# torch.compile reads parts of torch that torch itself has deprecated.
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("count", [1, 16, 256])
@pytest.mark.parametrize("hidden", [LARGE, SMALL], ids=["3 x 200", "2 x 32"])
def test_time_per_point(hidden, count, one_core, benchmark, capsys):
    turns = Turns(hidden, count)
    benchmark.pedantic(turns.take, rounds=ROUNDS, warmup_rounds=1)
    median = turns.medians()
    benchmark.extra_info.update({f"{name} [s/point]": time for name, time in median.items()})
    with capsys.disabled():
        print(f"\n{len(hidden)} x {hidden[0]}, {count} points")
        for name, time_per_point in median.items():
            ratio = time_per_point / median["symgraph"]
            print(f"  {name:18} {1e6 * time_per_point:8.1f} µs/point, {ratio:6.2f} times symgraph's")
        rate = 1e-9 * turns.operations / median["products alone"]
        print(f"  products: {1e-6 * turns.operations:.2f} MFLOP a point, {rate:.0f} GFLOP a second")
