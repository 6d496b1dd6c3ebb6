"""Random draws out of uniform numbers: what they are distributed like, and that seeds mean what they meant."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from symgraph.optimizers.draws import below, distinct, generator, latin_hypercubes, normal


def test_seeds_mean_what_they_meant():
    assert generator(0).random(2) == pytest.approx([0.5686892493917326, 0.23483041728695253], rel=1e-15)
    assert generator(2**40 + 7).random(1) == pytest.approx([0.5713885018261538], rel=1e-9)


@given(st.integers(0, 2**64 - 1), st.integers(1, 3), st.integers(1, 40), st.integers(0, 4))
def test_each_interval_of_each_axis_holds_one_point(seed, blocks, count, n):
    points = latin_hypercubes(generator(seed), blocks, count, n)
    assert points.shape == (blocks, count, n)
    assert ((points >= 0.0) & (points < 1.0)).all()
    for block in points:
        for axis in block.T:
            assert sorted(np.floor(axis * count).astype(int)) == list(range(count))


@given(st.integers(0, 100), st.data())
def test_distinct_numbers_are_distinct(total, data):
    count = data.draw(st.integers(0, total))
    numbers = distinct(generator(data.draw(st.integers(0, 99))), total, count)
    assert len(set(numbers.tolist())) == len(numbers) == count
    assert all(0 <= number < total for number in numbers)


def test_every_number_is_as_likely():
    rng = generator(3)
    found = np.bincount(np.concatenate([distinct(rng, 5, 2) for _ in range(4000)]), minlength=5)
    assert found == pytest.approx(np.full(5, 1600), abs=120)  # three standard deviations
    assert np.bincount([below(rng, 3) for _ in range(3000)]) == pytest.approx(np.full(3, 1000), abs=80)


def test_normal_numbers_are_normal():
    drawn = normal(generator(1), 20_000)
    assert drawn.mean() == pytest.approx(0.0, abs=0.03)
    assert drawn.std() == pytest.approx(1.0, abs=0.02)
    assert np.mean(np.abs(drawn) < 1.0) == pytest.approx(0.6827, abs=0.01)
