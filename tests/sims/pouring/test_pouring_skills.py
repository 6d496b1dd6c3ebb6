"""Tipping, shaking and moving as state machines, without physics."""

import math

import numpy as np
import pytest

from sims.pouring.scene import CONTROL_STEP
from sims.pouring.skills import END_TILT, PAUSE, Move, Shake, ShakePhase, Tip, TipPhase

START = np.array([0.6, 0.33, math.pi / 3])


def test_a_move_arrives_at_its_speed():
    move = Move(np.zeros(3), np.array([0.3, 0.4, 0.1]), speed=0.5, tilt_speed=1.0)
    commands = []
    while not move.ended:
        commands.append(move.next())
    assert len(commands) == round(1.0 / CONTROL_STEP)
    assert np.allclose(commands[-1], [0.3, 0.4, 0.1])
    assert np.allclose(move.next(), commands[-1])


def test_tipping_is_fast_to_ninety_degrees_and_slow_after():
    tip = Tip(START, 0.02, 0.005)
    tilts = [tip.next(False, False)[2] for _ in range(60)]
    steps = np.diff([START[2], *tilts])
    fast = np.isclose(steps, 0.02)
    assert np.isclose(steps[~fast], 0.005).all()
    assert fast.sum() == math.ceil((math.pi / 2 - START[2]) / 0.02)
    assert tip.phase is TipPhase.SEARCH


def test_tipping_holds_while_it_flows_and_goes_on_slowly():
    tip = Tip(START, 0.02, 0.005)
    tip.next(False, False)
    held = tip.next(True, False)[2]
    assert tip.phase is TipPhase.HOLD
    assert tip.next(True, False)[2] == held
    assert tip.next(False, False)[2] == pytest.approx(held + 0.005)  # even before 90 degrees


def test_tipping_gives_up_five_time_units_after_the_last_flow():
    tip = Tip(START, 0.02, 0.002)
    tip.next(True, False)
    steps = 0
    while not tip.ended:
        tip.next(False, False)
        steps += 1
    assert steps * CONTROL_STEP == pytest.approx(5.0, abs=2 * CONTROL_STEP)


def test_tipping_waits_at_the_end_of_the_tilt_unless_everything_rests():
    for resting in (False, True):
        tip = Tip(START, 0.02, 0.005)
        waited = 0
        while not tip.ended:
            tilt = tip.next(False, resting)[2]
            waited += tip.phase is TipPhase.WAIT
        assert END_TILT <= tilt < END_TILT + 0.006
        assert waited * CONTROL_STEP == pytest.approx(CONTROL_STEP if resting else 5.0, abs=2 * CONTROL_STEP)


def test_flow_at_the_end_of_the_tilt_is_waited_out():
    tip = Tip(START, 0.02, 0.005)
    while tip.phase is not TipPhase.WAIT:
        tip.next(False, False)
    for _ in range(300):
        tip.next(True, False)
    assert not tip.ended
    assert tip.phase is TipPhase.HOLD


def test_shaking_turns_over_then_strokes_in_pairs():
    shake = Shake(START, 0.02, speed=0.8, length=0.06, angle=-math.pi / 2)
    while shake.phase is ShakePhase.APPROACH:
        command = shake.next(False, False)
        assert np.allclose(command[:2], START[:2])
    assert command[2] > END_TILT
    pause = round(PAUSE / CONTROL_STEP)
    cycle = [shake.next(True, False) for _ in range(4 * 3 + pause)]  # 0.06 at 0.8 takes 3 control steps each way
    depth = START[1] - np.array(cycle)[:, 1]
    assert np.allclose(depth, [0.02, 0.04, 0.06, 0.04, 0.02, 0.0] * 2 + [0.0] * pause)
    assert np.allclose(np.array(cycle)[:, 0], START[0])
    assert shake.next(True, False)[1] == pytest.approx(START[1] - 0.02)


def test_shaking_gives_up_three_time_units_after_the_last_flow():
    shake = Shake(START, 0.02, speed=0.8, length=0.06, angle=0.0)
    while shake.phase is ShakePhase.APPROACH:
        shake.next(False, False)
    for _ in range(500):
        shake.next(True, False)
    assert not shake.ended
    steps = 0
    while not shake.ended:
        shake.next(False, False)
        steps += 1
    assert steps * CONTROL_STEP == pytest.approx(3.0, abs=2 * CONTROL_STEP)


def test_shaking_depends_smoothly_on_speed_and_length():
    def ways(speed, length):
        shake = Shake(START, 0.02, speed, length, 0.0)
        while shake.phase is ShakePhase.APPROACH:
            shake.next(False, False)
        return np.array([shake.next(True, False)[0] for _ in range(12)])

    assert 0.0 < np.abs(ways(0.75, 0.06) - ways(0.751, 0.06)).max() < 1e-3
    assert 0.0 < np.abs(ways(0.75, 0.06) - ways(0.75, 0.0601)).max() < 1e-3
