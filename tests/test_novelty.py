"""Which choice is known least in a situation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from online_worlds import kick_graph

from symgraph.learned.novelty import least_known, situation_of

SKILLS = ("tip", "shake")


def tries_of(*pairs):
    return [(np.array(where, dtype=float), {"skill": skill}) for where, skill in pairs]


def least(here, *pairs):
    return least_known("skill", SKILLS, np.array(here, dtype=float), tries_of(*pairs))


def test_without_tries_no_choice_is_known():
    assert least([0.0]) == ["tip", "shake"]


def test_a_choice_that_was_never_made_is_known_least():
    assert least([0.0], ([0.0], "tip")) == ["shake"]
    assert least([5.0], ([0.0], "tip"), ([0.1], "tip")) == ["shake"]


def test_what_is_known_elsewhere_is_not_known_here():
    paste = [([1.0, 0.1 * k], "tip") for k in range(9)]
    water = [([0.0, 0.5], "shake")]
    assert least([0.0, 0.5], *paste, *water) == ["tip"]  # for all that it was made nine times as often
    assert least([1.0, 0.5], *paste, *water) == ["shake"]


def test_where_all_situations_are_the_same_choices_take_turns():
    tries = []
    for _ in range(10):
        found = least([0.3], *tries)
        tries.append(([0.3], found[0]))
    assert [skill for _, skill in tries].count("tip") == 5
    assert len(least([0.3], *tries)) == 2


@pytest.mark.filterwarnings("error")
def test_situations_that_are_far_beyond_all_tries():
    assert least([1e300], ([1.0], "tip"), ([1.0 + 1e-5], "tip")) == ["shake"]
    assert len(least([1e300], ([1.0], "tip"), ([1.0 + 1e-5], "shake"))) == 2
    assert len(least([1e308], ([-1e308], "tip"), ([-1e308 + 1e300], "shake"))) == 2


def test_many_tries_nearby_outweigh_one_that_is_nearer():
    tips = [([0.1 * k], "tip") for k in range(10)]
    assert least([0.45], *tips, ([0.44], "shake"), ([2.0], "shake")) == ["shake"]


def test_an_element_that_a_try_does_not_know_counts_as_two_independent_draws():
    # The first elements known are 0, 2, 0, 2, so that their deviation is 1; the second is the same everywhere.
    known = [([2.0 * (k % 2), 7.0], "tip") for k in range(4)]
    assert least([1.4, 7.0], *known, ([np.nan, 7.0], "shake")) == ["shake"]
    assert least([3.8, 7.0], *known, ([np.nan, 7.0], "shake")) == ["shake"]  # 2 exp(-1.8² / 2) > exp(-2 / 2)
    assert least([3.9, 7.0], *known, ([np.nan, 7.0], "shake")) == ["tip"]  # 2 exp(-1.9² / 2) < exp(-2 / 2)


def test_an_element_that_is_not_known_here_says_nothing():
    pairs = ([np.nan, 0.0], "tip"), ([3.0, 1.0], "shake"), ([9.0, 1.0], "shake")
    assert least([np.nan, 0.9], *pairs) == ["tip"]
    assert least([np.nan, 0.1], *pairs) == ["shake"]
    assert least([np.nan, np.nan], *pairs) == ["tip"]  # made less often


def test_what_varies_by_rounding_alone_says_nothing():
    same = np.array([0.3, 0.1 + 0.2, 0.3])
    assert same.std() > 0.0
    pairs = ([same[0], 0.0], "tip"), ([same[1], 1.0], "shake"), ([same[2], 5.0], "shake")
    assert least([0.3, 0.1], *pairs) == ["shake"]
    assert least([0.3, 0.9], *pairs) == ["tip"]
    assert least([0.1 + 0.2, 0.1], *pairs) == ["shake"]
    assert least([0.1 + 0.2, 0.9], *pairs) == ["tip"]


@pytest.mark.parametrize("size", [1e-200, 1e200])
def test_sizes_do_not_matter(size):
    pairs = ([-size, 0.0], "tip"), ([size, 0.0], "shake")
    assert least([0.5 * size, 0.0], *pairs) == ["tip"]
    assert least([-0.5 * size, 0.0], *pairs) == ["shake"]
    assert least([-0.5 * size, 1e200], *pairs) == ["shake"]


numbers = st.integers(-8, 8).map(float)
situations = st.lists(numbers, min_size=2, max_size=2)


@given(
    situations,
    st.lists(st.tuples(situations, st.sampled_from(SKILLS)), min_size=1, max_size=12),
    st.sampled_from([0.25, 2.0, 64.0]),
    st.integers(-4, 4),
)
def test_the_density_of_tries_decides_in_any_units(here, pairs, scale, offset):
    def in_other_units(where):
        return [where[0] * scale + offset, where[1]]

    sd = np.std([where for where, _ in pairs], axis=0)
    counted = dict.fromkeys(SKILLS, 0.0)
    for where, skill in pairs:
        offsets = [(x - y) / d for x, y, d in zip(where, here, sd, strict=True) if d > 0.0]
        counted[skill] += np.exp(-(np.linalg.norm(offsets) ** 2) / 2)
    found = least(here, *pairs)
    other = least(in_other_units(here), *[(in_other_units(where), skill) for where, skill in pairs])
    for one in (*found, *other):  # ties may break by rounding
        assert counted[one] <= min(counted.values()) * (1 + 1e-9)


def test_only_what_is_known_at_the_start_tells_situations_apart():
    graph = kick_graph()
    known = {"s": 0.2, "y": 3.0}
    np.testing.assert_array_equal(situation_of(graph, ["s", "y"], known, {"s": 0.1}), [0.2, np.nan])
    assert situation_of(graph, [], known, {}).shape == (0,)
