"""Random functions in compiled kernels, against CasADi in value and gradient."""

from functools import partial

import casadi as ca
import numpy as np
import pytest
from compiled_functions import assert_agrees, bound, compiled, expected, function_of
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from random_functions import SHAPES, random_value

N, CHOICES, TOGETHER = 4, 3, 8
STEEP = 1e3  # gradients beyond which rounding shows


def assert_agree(seed, build):
    """Several functions in one kernel, times weights that pick one, at 1, 8 and 16 points."""
    seeds = [seed * TOGETHER + i for i in range(TOGETHER)]

    def body(u, s, p, q, weights):
        return ca.dot(weights, ca.vertcat(*(random_value(one, u, s, p, q) for one in seeds)))

    kernel = compiled(function_of(body, N, CHOICES, [*SHAPES, (TOGETHER, 1)]), build)
    rng = np.random.default_rng(seed)
    shared = [rng.normal(size=shape) for shape in SHAPES]
    for i, one in enumerate(seeds):
        reference = function_of(partial(random_value, one), N, CHOICES, SHAPES)
        points, selections = rng.uniform(-1, 1, (25, N)), np.eye(CHOICES)[rng.integers(0, CHOICES, 25)]
        wanted = expected(reference, points, selections, shared)
        if np.abs(wanted[1]).max() > STEEP:
            continue
        kernel_of_one = bound(kernel, [*shared, np.eye(TOGETHER)[i]])
        for a, b in ((0, 1), (1, 9), (9, 25)):
            got = kernel_of_one.evaluate(points[a:b], selections[a:b])
            try:
                assert_agrees(got, [numbers[a:b] for numbers in wanted], 1e-10)
            except AssertionError as error:
                raise AssertionError(f"random_value({one}, …) at {b - a} points: {error}") from error


SEEDS = st.integers(0, 2**28)
PHASES = [Phase.explicit, Phase.reuse, Phase.generate]  # to shrink a seed would help nobody
BUILDS = st.sampled_from(["lanes", "narrow"])


@settings(max_examples=3, phases=PHASES, derandomize=True)  # the same ones, found compiled when run again
@given(seed=SEEDS, build=BUILDS)
def test_random_functions(seed, build):
    assert_agree(seed, build)


@pytest.mark.slow
@settings(max_examples=40, phases=PHASES)
@given(seed=SEEDS, build=BUILDS)
def test_more_random_functions(seed, build):
    assert_agree(seed, build)
