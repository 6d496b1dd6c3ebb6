"""What optimizers draw from: combinations of selections and points in the box."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from symgraph.optimizers.problem import Problem, Run, best_of

selections = st.lists(
    st.integers(1, 4).flatmap(
        lambda size: st.tuples(st.just(size), st.sets(st.integers(0, size - 1), min_size=1).map(sorted).map(tuple))
    ),
    max_size=4,
)


def problem_of(sizes=(), allowed=(), low=(0.0,), high=(1.0,), kernel=None, guesses=()):
    box = np.array(low), np.array(high)
    return Problem(kernel, SimpleNamespace(), *box, tuple(sizes), tuple(allowed), None, tuple(guesses))


@given(selections, st.integers(0, 60), st.booleans(), st.integers(0, 99))
def test_choices_are_allowed_and_one_hot(drawn, count, evenly, seed):
    problem = problem_of([size for size, _ in drawn], [allowed for _, allowed in drawn])
    choices = problem.draw_choices(np.random.default_rng(seed), count, evenly)
    assert choices.shape == (count, len(drawn))
    assert choices.dtype == np.int64
    for column, (_, allowed) in zip(choices.T, drawn, strict=True):
        assert set(column) <= set(allowed)
    hot = problem.one_hot(choices)
    assert hot.shape == (count, sum(size for size, _ in drawn))
    assert (hot.sum(axis=1) == len(drawn)).all()


@given(selections, st.integers(0, 200), st.integers(0, 99))
def test_even_draws_differ_by_one_at_most(drawn, count, seed):
    problem = problem_of([size for size, _ in drawn], [allowed for _, allowed in drawn])
    choices = problem.draw_choices(np.random.default_rng(seed), count, evenly=True)
    times = np.zeros(problem.combinations)
    _, found = np.unique(choices, axis=0, return_counts=True) if drawn else (None, [count] if count else [])
    times[: len(found)] = found
    assert times.max() - times.min() <= 1


@settings(max_examples=30)
@given(selections)
def test_every_number_is_another_combination(drawn):
    problem = problem_of([size for size, _ in drawn], [allowed for _, allowed in drawn])
    choices = problem.decode(np.arange(problem.combinations))
    assert len({tuple(row) for row in choices}) == problem.combinations


@pytest.mark.parametrize("sampling", ["spread", "uniform", "gaussian"])
@given(st.integers(0, 40), st.integers(0, 99))
def test_points_lie_in_the_box(sampling, count, seed):
    problem = problem_of(low=[-1, 5, 2], high=[1, 5, 1e6])
    points = problem.draw_points(np.random.default_rng(seed), count, sampling)
    assert points.shape == (count, 3)
    assert (points >= problem.low).all()
    assert (points <= problem.high).all()
    assert (points[:, 1] == 5).all()
    unit = problem.unit(points)
    assert (unit >= 0).all()
    assert (unit <= 1).all()


def test_spread_points_are_a_latin_hypercube():
    problem = problem_of(low=[0, -2], high=[1, 2])
    unit = problem.unit(problem.draw_points(np.random.default_rng(0), 50, "spread"))
    assert (np.sort(np.floor(unit * 50), axis=0) == np.arange(50)[:, None]).all()


def test_actions_that_a_guess_leaves_out_are_drawn_and_selections_are_the_best():
    guesses = [(np.array([0.25, np.nan]), np.array([2, -1])), (np.array([9.0, -9.0]), np.array([-1, 0]))]
    kernel = SimpleNamespace(evaluate=lambda points, hot: (hot @ [1.0, 9.0, 3.0, 5.0, 4.0], np.zeros(points.shape)))
    problem = problem_of([3, 2], [(0, 2), (0, 1)], [0, 0], [1, 1], guesses=guesses, kernel=kernel)
    points, choices = problem.started_from_guesses(np.random.default_rng(0))
    assert points[0, 0] == 0.25
    assert 0 <= points[0, 1] <= 1
    assert points[1].tolist() == [1, 0]  # moved into the box
    assert choices.tolist() == [[2, 0], [2, 0]]  # choice 1 of the first selection is not allowed


def test_values_that_are_not_finite_are_the_worst():
    values = np.array([1.0, np.nan, np.inf, -np.inf])
    kernel = SimpleNamespace(evaluate=lambda points, hot: (values, np.zeros((4, 1))))
    problem = problem_of(kernel=kernel)
    got = problem.values(np.zeros((4, 1)), np.zeros((4, 0), dtype=np.int64))
    assert got.tolist() == [1.0, -np.inf, -np.inf, -np.inf]


def run(value):
    return Run(np.zeros(1), np.zeros(1), np.zeros(0, dtype=np.int64), value, "converged", np.zeros(1))


def test_the_best_run_is_finite_and_the_first_of_equals():
    runs = [run(np.nan), run(1.0), run(3.0), run(3.0), run(np.inf), run(-np.inf)]
    assert best_of(runs) is runs[2]
    assert best_of([run(np.nan), run(-np.inf)]) is None
    assert best_of([]) is None
