"""Time per plan of the cannon task: symgraph's default beside JAX by hand (`pip install jax`), on one core.

CPU time, and in turns, target by target, so that whatever else the machine does hits all planners alike. All
plans must be right and within 1e-9 of the optimum, or the times would not compare. Each planner's first plan,
which compiles, does not count.
"""

import os
import statistics
import time

import cannon_oracle as oracle
import numpy as np
import pytest

import symgraph as sg
from models import cannon

TARGETS = 0.05 * np.arange(1, 31)  # [m]
ROUNDS = 10  # each with its own seed


@pytest.fixture
def one_core():
    """Hold this process, and the threads that it starts from now on, on one core."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cores)})
    yield
    os.sched_setaffinity(0, cores)


@pytest.fixture
def planners(one_core):
    """{name: plan(state, seed) -> (theta, cannon, value)}, warm."""
    from benchmarks import jax_cannon

    objective = sg.Objective(sg.unroll(cannon.graph()))

    def symgraph(state, seed):
        plan = sg.solve(objective, state, seed=seed)
        return plan.actions["theta"], plan.selections["cannon"], plan.value

    planners = {"symgraph": symgraph, **jax_cannon.PLANNERS}
    for plan in planners.values():
        plan(cannon.state(0.5), 0)
    return planners


def test_time_per_plan(planners, benchmark, capsys):
    seconds = {name: [] for name in planners}
    seeds = iter(range(ROUNDS))

    def take_turns():
        seed = next(seeds)
        for x in TARGETS:
            state = cannon.state(x)
            best = oracle.best(x)
            for name, plan in planners.items():
                begin = time.process_time()
                theta, choice, _value = plan(state, seed)
                seconds[name].append(time.process_time() - begin)
                assert choice == best.cannon, name
                assert best.value - oracle.reward(choice, theta, x) <= 1e-9, name

    benchmark.pedantic(take_turns, rounds=ROUNDS)
    median = {name: statistics.median(times) for name, times in seconds.items()}
    benchmark.extra_info.update({f"{name} [s/plan]": time for name, time in median.items()})
    with capsys.disabled():
        print()
        for name, time_per_plan in median.items():
            ratio = median["symgraph"] / time_per_plan
            print(f"{name:15} {1e6 * time_per_plan:7.0f} µs/plan   symgraph takes {ratio:.2f} times as long")
