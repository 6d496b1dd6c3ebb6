import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import ndtr

from sims import push as sim

seeds = st.integers(0, 2**32 - 1)


def random_case(seed):
    """A situation, and one push that has a fair chance: gripper (2,) [m], theta [rad], advance [m]."""
    rng = np.random.default_rng(seed)
    seen = sim.Situation.draw(rng)
    theta = rng.uniform(-np.pi, np.pi)
    back = rng.uniform(0.1, 0.4)
    gripper = (seen.first + seen.second) / 2 - back * np.array([np.cos(theta), np.sin(theta)])
    return seen, (gripper, theta, rng.uniform(0.05, 0.8))


def moved(seen, place):
    return sim.Situation(place(seen.first), seen.first_sd, place(seen.second), seen.second_sd)


# The push


def push_step_by_step(local, advance, steps=20_000):
    """Move the gripper in small steps: an arm that reaches the object moves it sideways, the centre takes it along."""
    x, y = local
    may_touch = abs(y) <= sim.ARM
    for _ in range(steps):
        in_front = x >= abs(y)
        x -= advance / steps
        if may_touch and in_front and x < abs(y):
            y = np.sign(y) * max(x, 0.0)
            x = max(x, 0.0)
    return np.array([x, y])


def test_push_agrees_with_one_of_small_steps():
    rng = np.random.default_rng(0)
    for _ in range(40):
        local, advance = rng.uniform([-0.2, -0.5], [0.9, 0.5]), rng.uniform(0.05, 0.8)
        np.testing.assert_allclose(sim.pushed(local, advance), push_step_by_step(local, advance), atol=1e-4)


@pytest.mark.parametrize(
    ("local", "advance", "offset"),
    [
        ((0.1, 0.2), 0.5, (-0.4, 0.2)),  # behind an arm
        ((0.4, 0.31), 0.5, (-0.1, 0.31)),  # beyond its end
        ((0.9, 0.1), 0.5, (0.4, 0.1)),  # too far ahead
        ((0.6, 0.2), 0.5, (0.1, 0.1)),  # on its way along the left arm
        ((0.6, -0.2), 0.5, (0.1, -0.1)),  # and along the right one
        ((0.3, -0.2), 0.5, (0.0, 0.0)),  # taken by the centre
    ],
)
def test_each_case_of_the_paper(local, advance, offset):
    np.testing.assert_allclose(sim.pushed(local, advance), offset, atol=1e-15)
    assert sim.captured(local, advance) == (offset == (0.0, 0.0))


def test_captured_objects_are_those_at_the_centre():
    rng = np.random.default_rng(1)
    local, advance = rng.uniform([-0.2, -0.5], [0.9, 0.5], (5000, 2)), rng.uniform(0.05, 0.8, 5000)
    at_centre = (sim.pushed(local, advance) == 0).all(axis=1)
    np.testing.assert_array_equal(sim.captured(local, advance), at_centre)
    assert 0.1 < at_centre.mean() < 0.5


def test_the_gripper_sees_what_is_ahead_and_to_its_left():
    local = sim.in_gripper([1.0, 3.0], [1.0, 1.0], np.pi / 2)
    np.testing.assert_allclose(local, [2.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(sim.in_gripper([0.0, 1.0], [1.0, 1.0], np.pi / 2), [0.0, 1.0], atol=1e-15)


# The probability of success


def test_success_probability_agrees_with_draws():
    draws = 100_000
    for seed in range(8):
        seen, (gripper, theta, advance) = random_case(seed)
        objects = seen.objects(np.random.default_rng(seed), draws)
        share = sim.captured(sim.in_gripper(objects, gripper, theta), advance).mean()
        probability = sim.success_probability(seen, gripper, theta, advance)
        five_sd = 5 * np.sqrt(probability * (1 - probability) / draws)
        assert share == pytest.approx(probability, abs=five_sd + 1e-9)


def capture_probability_by_rows(local, sd, advance):
    """Integrate over x instead of y: ∫₀^m φ(x) P(|y| ≤ min(x, ARM)) dx."""
    x0, y0 = local

    def integrand(x):
        reach = min(x, sim.ARM)
        density = np.exp(-(((x - x0) / sd) ** 2) / 2) / sd / np.sqrt(2 * np.pi)
        return density * (ndtr((reach - y0) / sd) - ndtr((-reach - y0) / sd))

    kinks = [point for point in (x0 - 6 * sd, x0, x0 + 6 * sd, abs(y0), sim.ARM) if 0 < point < advance]
    return quad(integrand, 0.0, advance, points=kinks or None, epsabs=1e-12, limit=400)[0]


def test_success_probability_is_accurate_to_1e_9():
    for seed in range(40):
        seen, (gripper, theta, advance) = random_case(seed)
        each = [
            capture_probability_by_rows(sim.in_gripper(mean, gripper, theta), sd, advance)
            for mean, sd in ((seen.first, seen.first_sd), (seen.second, seen.second_sd))
        ]
        assert sim.success_probability(seen, gripper, theta, advance) == pytest.approx(np.mean(each), abs=1e-9)


def test_success_probability_takes_many_actions_at_once():
    seen, _ = random_case(0)
    rng = np.random.default_rng(0)
    gripper, theta, advance = rng.uniform(size=(6, 2)), rng.uniform(-3, 3, 6), rng.uniform(0.05, 0.8, 6)
    one_by_one = [sim.success_probability(seen, *push) for push in zip(gripper, theta, advance, strict=True)]
    np.testing.assert_allclose(sim.success_probability(seen, gripper, theta, advance), one_by_one, rtol=1e-12)


def test_success_is_certain_or_impossible_without_uncertainty():
    seen = sim.Situation(np.array([0.5, 0.5]), 0.0, np.array([0.6, 0.5]), 0.0)
    assert sim.success_probability(seen, [0.4, 0.5], 0.0, 0.15) == 0.5  # the first alone is within
    assert sim.success_probability(seen, [0.4, 0.5], 0.0, 0.25) == 1.0
    assert sim.success_probability(seen, [0.4, 0.5], np.pi, 0.25) == 0.0


@given(seeds, st.floats(-3, 3), st.floats(-1, 1), st.floats(-1, 1))
@settings(max_examples=50)
def test_success_does_not_depend_on_where_the_table_stands(seed, angle, dx, dy):
    seen, (gripper, theta, advance) = random_case(seed)
    c, s = np.cos(angle), np.sin(angle)

    def place(point):
        return np.array([[c, -s], [s, c]]) @ point + [dx, dy]

    elsewhere = sim.success_probability(moved(seen, place), place(gripper), theta + angle, advance)
    assert elsewhere == pytest.approx(float(sim.success_probability(seen, gripper, theta, advance)), abs=1e-9)


@given(seeds)
@settings(max_examples=50)
def test_success_is_the_same_in_a_mirror_and_with_the_beliefs_exchanged(seed):
    seen, (gripper, theta, advance) = random_case(seed)
    mirror = np.array([1.0, -1.0])
    mirrored = moved(seen, lambda point: mirror * point)
    exchanged = sim.Situation(mirrored.second, mirrored.second_sd, mirrored.first, mirrored.first_sd)
    expected = pytest.approx(float(sim.success_probability(seen, gripper, theta, advance)), abs=1e-9)
    assert sim.success_probability(exchanged, mirror * gripper, -theta, advance) == expected


@pytest.mark.parametrize("sd", [-0.01, np.nan, np.inf])
def test_a_standard_deviation_that_is_none_is_refused(sd):
    seen = sim.Situation(np.zeros(2), sd, np.zeros(2), 0.1)
    with pytest.raises(ValueError, match="at least 0"):
        sim.success_probability(seen, [0.0, 0.0], 0.0, 0.5)


# Situations and samples


def test_situations_and_samples_fill_their_ranges():
    drawn = [sim.Situation.draw(np.random.default_rng(seed)) for seed in range(500)]
    places = np.array([[seen.first, seen.second] for seen in drawn])
    sds = np.array([[seen.first_sd, seen.second_sd] for seen in drawn])
    assert np.quantile(places, [0, 0.5, 1]) == pytest.approx([0.3, 0.5, 0.7], abs=0.02)
    assert np.quantile(sds, [0, 0.5, 1]) == pytest.approx([0.0, 0.05, 0.1], abs=0.005)

    x, y = sim.samples(np.random.default_rng(0), 2000)
    assert (x.shape, y.shape) == ((2000, 3), (2000, 2))
    assert np.quantile(x[:, 2], [0, 0.5, 1]) == pytest.approx([0.01, 1.0, 2.0], abs=0.07)
    np.testing.assert_array_equal(y, sim.pushed(x[:, :2], x[:, 2]))


def test_objects_are_drawn_from_the_mixture():
    seen = sim.Situation(np.array([0.0, 0.0]), 0.1, np.array([5.0, 0.0]), 0.02)
    objects = seen.objects(np.random.default_rng(0), 20_000)
    near = objects[:, 0] < 2.5
    assert near.mean() == pytest.approx(0.5, abs=0.02)
    assert objects[near].std(axis=0) == pytest.approx([0.1, 0.1], rel=0.05)
    assert objects[~near].std(axis=0) == pytest.approx([0.02, 0.02], rel=0.05)


# The world


def test_an_episode_goes_from_aiming_to_the_pushed_object():
    seen = sim.Situation(np.array([0.5, 0.5]), 0.0, np.array([0.5, 0.5]), 0.0)
    world = sim.World(seen)
    observed = world.reset(0)
    assert observed.keys() == {"first", "first_sd", "second", "second_sd"}
    actions = {"gripper": [0.3, 0.5], "theta": 0.0, "advance": 0.3}
    np.testing.assert_allclose(world.execute("aim", actions, {})["approached"]["local"], [0.2, 0.0])
    np.testing.assert_array_equal(world.execute("approached", actions, {})["pushed"]["offset"], [0.0, 0.0])
    world.close()


def test_equal_seeds_give_equal_episodes():
    def episode(seed):
        world = sim.World()
        observed = world.reset(seed)
        actions = {"gripper": [0.3, 0.5], "theta": 0.0, "advance": 0.3}
        return [*observed["first"], *world.execute("aim", actions, {})["approached"]["local"]]

    assert episode(1) == episode(1)
    assert episode(1) != episode(2)


def test_only_the_nodes_of_the_task_can_be_executed_and_in_their_order():
    world = sim.World()
    with pytest.raises(ValueError, match=r"'pushed'.*'aim' and 'approached'"):
        world.execute("pushed", {}, {})
    with pytest.raises(ValueError, match="execute 'aim' first"):
        world.execute("approached", {"advance": 0.3}, {})
