"""The two ways to make material flow, and the move between places, as small state machines.

Each yields one command per control step and sees only whether material flows and whether everything rests, so
that it can be tested without physics.
"""

from __future__ import annotations

import enum
import math

import numpy as np

from sims.pouring.scene import CONTROL_STEP

END_TILT = 0.9 * math.pi  # 162 degrees: further tilting changes nothing
TIP_PATIENCE = 5.0  # time without flow after which tipping gives up
SHAKE_PATIENCE = 3.0  # the same for shaking
PAUSE = 0.1  # time between two pairs of strokes


class Move:
    """Go to a place at constant speeds; position and tilt arrive together.

    Args:
        start: (3,) shoulder x, z [length] and tilt [rad].
        goal: (3,) the same.
        speed: Of the shoulder [length / time].
        tilt_speed: [rad / time].
    """

    def __init__(self, start: np.ndarray, goal: np.ndarray, speed: float, tilt_speed: float) -> None:
        self._start, self._goal = np.array(start), np.array(goal)
        way = self._goal - self._start
        time = max(math.hypot(way[0], way[1]) / speed, abs(way[2]) / tilt_speed)
        self._steps = max(1, math.ceil(time / CONTROL_STEP))
        self._step = 0

    @property
    def ended(self) -> bool:
        """Whether the last command was the goal."""
        return self._step >= self._steps

    def next(self) -> np.ndarray:
        """Return the next (3,) command."""
        self._step = min(self._step + 1, self._steps)
        return self._start + (self._goal - self._start) * (self._step / self._steps)


class TipPhase(enum.Enum):
    """What tipping is about."""

    APPROACH = "tilt fast until the source lies on its side"
    SEARCH = "tilt slowly until something flows"
    HOLD = "stay while it flows"
    WAIT = "stay at the end of the tilt until flow can no longer be hoped for"


class Tip:
    """Tilt the source, hold it while material flows, tilt on when the flow has stopped.

    It ends after 5 time units without flow, counted from the last flow or from the end of the tilt; at the
    end of the tilt it ends as soon as everything rests, because then nothing can happen any more.

    Args:
        start: (3,) shoulder x, z [length] and tilt [rad].
        tilt_rate: Tilt before the source lies on its side [rad / control step].
        search_rate: Tilt afterwards [rad / control step].
    """

    def __init__(self, start: np.ndarray, tilt_rate: float, search_rate: float) -> None:
        self.phase = TipPhase.APPROACH
        self._command = np.array(start, dtype=float)
        self._tilt_rate, self._search_rate = tilt_rate, search_rate
        self._patience: float | None = None  # starts to run down at the first flow or at the end of the tilt
        self._stuck = False

    @property
    def ended(self) -> bool:
        """Whether no flow is to be expected any more."""
        return self._stuck or (self._patience is not None and self._patience <= 0.0)

    def next(self, flowing: bool, resting: bool) -> np.ndarray:
        """Return the next (3,) command, given whether material flows and whether everything rests."""
        tilt = self._command[2]
        if flowing:
            self.phase = TipPhase.HOLD
        elif tilt >= END_TILT:
            self.phase = TipPhase.WAIT
        elif tilt >= math.pi / 2 or self.phase is not TipPhase.APPROACH:
            self.phase = TipPhase.SEARCH

        if self.phase is TipPhase.HOLD or (self.phase is TipPhase.WAIT and self._patience is None):
            self._patience = TIP_PATIENCE
        elif self._patience is not None:
            self._patience -= CONTROL_STEP
        self._stuck = self.phase is TipPhase.WAIT and resting

        if self.phase is TipPhase.APPROACH:
            self._command[2] += self._tilt_rate
        elif self.phase is TipPhase.SEARCH:
            self._command[2] += self._search_rate
        return self._command.copy()


class ShakePhase(enum.Enum):
    """What shaking is about."""

    APPROACH = "tilt until the source is upside down"
    STROKE = "go back and forth twice"
    PAUSE = "stay for a moment between pairs of strokes"


class Shake:
    """Turn the source upside down and shake it in pairs of strokes; it ends after 3 time units without flow.

    Args:
        start: (3,) shoulder x, z [length] and tilt [rad].
        tilt_rate: Tilt on the way [rad / control step].
        speed: Of the shoulder during a stroke [length / time].
        length: Of a stroke [length].
        angle: Direction of a stroke, 0 towards the receiver, pi/2 upwards [rad].
    """

    def __init__(self, start: np.ndarray, tilt_rate: float, speed: float, length: float, angle: float) -> None:
        self.phase = ShakePhase.APPROACH
        self._start = np.array(start, dtype=float)
        self._tilt = float(start[2])
        self._tilt_rate = tilt_rate
        self._direction = np.array([math.cos(angle), math.sin(angle), 0.0])
        self._length, self._speed = length, speed
        self._time = 0.0  # since the present pair of strokes began
        self._patience = SHAKE_PATIENCE

    @property
    def ended(self) -> bool:
        """Whether no flow is to be expected any more."""
        return self._patience <= 0.0

    def next(self, flowing: bool, resting: bool) -> np.ndarray:
        """Return the next (3,) command, given whether material flows and whether everything rests."""
        del resting  # the strokes move everything
        if self.phase is ShakePhase.APPROACH:
            self._tilt += self._tilt_rate
            if self._tilt > END_TILT:
                self.phase = ShakePhase.STROKE
            return self._place(0.0)

        self._patience = SHAKE_PATIENCE if flowing else self._patience - CONTROL_STEP
        # Times are not rounded to control steps, so that what flows depends smoothly on speed and length.
        pair = 4.0 * self._length / self._speed
        self._time = (self._time + CONTROL_STEP) % (pair + PAUSE)
        self.phase = ShakePhase.STROKE if self._time < pair else ShakePhase.PAUSE
        if self.phase is ShakePhase.PAUSE:
            return self._place(0.0)
        way = (self._speed * self._time) % (2.0 * self._length)
        return self._place(min(way, 2.0 * self._length - way))

    def _place(self, distance: float) -> np.ndarray:
        command = self._start + distance * self._direction
        command[2] = self._tilt
        return command
