"""Shapes: frames, what is inside, what went through the mouth, and how far the source has to rise."""

import numpy as np
import pytest

from sims.pouring.geometry import INNER, SOURCE_HEIGHT, Receiver, Source, required_lift

POSE = np.array([0.4, 0.6, 1.2])


def to_world(local, pose):
    """The inverse of Source.to_local, written with a rotation matrix."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[cos, sin], [-sin, cos]])
    x, z = turn @ (local[:, [0, 2]] - (0.15, 0.5)).T
    return np.stack([pose[0] + x, local[:, 1], pose[1] + z], axis=1)


def test_the_source_frame_turns_with_the_source():
    local = np.random.default_rng(0).uniform(-0.3, 0.6, (20, 3))
    assert np.allclose(Source(0.2).to_local(to_world(local, POSE), POSE), local)


def test_inside_is_the_box_and_the_funnel():
    source = Source(0.11)
    height = SOURCE_HEIGHT + source.lip / 2
    inside = [(0, 0, 0.1), (0.14, -0.14, 0.4), (0.0, 0.0, height), (INNER - source.lip / 2, 0, height)]
    outside = [(0.18, 0, 0.1), (0, 0, -0.03), (0, 0, 0.5 + source.lip + 0.01), (0.14, 0, height)]
    assert source.contains(np.array(inside)).all()
    assert not source.contains(np.array(outside)).any()


def test_the_only_way_out_is_the_mouth():
    source = Source(0.13)
    top = SOURCE_HEIGHT + source.lip
    before = np.array([(0.0, 0.0, top - 0.01), (0.05, 0.05, top - 0.01), (0.1, 0, top - 0.01), (0.14, 0, 0.2)])
    after = before + [(0, 0, 0.02), (0.01, 0, 0.03), (0, 0, 0.02), (0.05, 0, 0)]
    assert source.through_mouth(before, after).tolist() == [True, True, False, False]
    assert source.through_mouth(after, before).tolist() == [True, True, False, False]


def test_corners_turn_with_the_receiver():
    corners = Receiver().corners(np.array([0.8, 0.1, np.pi / 2])).reshape(4, 3)
    assert np.allclose(corners[0], [0.8 - 0.2, 0.1 + 0.15, 0.2])
    assert np.allclose(corners.mean(axis=0), [0.8, 0.1, 0.2])


def test_the_mouth_is_where_the_mouth_is():
    source = Source(0.13)
    middle = to_world(np.array([[0.0, 0.0, SOURCE_HEIGHT + source.lip]]), POSE)
    assert source.mouth_centre(POSE) == pytest.approx(middle[0, 0])


def test_the_source_rises_over_rim_heap_and_floor_only_where_it_must():
    source, receiver = Source(0.11), Receiver()
    outline = source.outline()
    upside_down = 0.9 * np.pi
    high, low = np.array([0.6, 0.5, upside_down]), np.array([0.6, 0.2, upside_down])
    assert required_lift(outline, high, receiver, 0.8) == 0.0
    lift = required_lift(outline, low, receiver, 0.8)
    assert lift > 0.0
    assert required_lift(outline, low + [0, lift, 0], receiver, 0.8) == pytest.approx(0.0, abs=1e-12)
    assert required_lift(outline, np.array([0.15, 0.5, 0.0]), receiver, 0.8) == pytest.approx(0.0, abs=1e-12)
    assert required_lift(outline, np.array([0.15, 0.4, 0.0]), receiver, 0.8) == pytest.approx(0.1)


@pytest.mark.parametrize(("rim", "most"), [(0.14, 0.0), (0.2, 0.0), (0.22, 0.013)])
def test_low_pouring_positions_clear_the_rim_of_any_receiver_or_nearly(rim, most):
    """Where tipping pours best, 0.17 to 0.24 before the middle, from the lowest shoulder that may be asked for."""
    lifts = [
        required_lift(Source(mouth).outline(), np.array([x, 0.32, tilt]), Receiver((length, 0.4, rim)), 0.0)
        for mouth in (0.11, 0.18, 0.25)
        for length in (0.22, 0.3, 0.38)
        for x in (-0.24, -0.2, -0.17)
        for tilt in np.linspace(np.pi / 3, 0.9 * np.pi, 20)
    ]
    assert max(lifts) <= most
    assert (max(lifts) > 0.0) == (most > 0.0)


@pytest.mark.parametrize("mouth", [0.1, 0.26])
def test_a_wrong_mouth_is_named(mouth):
    with pytest.raises(ValueError, match=r"give a number from 0.11 to 0.25"):
        Source(mouth)


def test_a_wrong_receiver_is_named():
    with pytest.raises(ValueError, match=r"give length, width, height from 0.1 to 1"):
        Receiver((0.3, 0.4, 0.0))
