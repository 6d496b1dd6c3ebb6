"""Push an object into a gripper's funnel, with two beliefs about where it is (the paper's second toy example).

Source: Yamaguchi & Atkeson, Differential Dynamic Programming for Graph-Structured Dynamical Systems,
Humanoids 2016, section VI. The paper names no numbers but those of the reward and the weights.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from typing import Any

import casadi as ca

import symgraph as sg

ARM = 0.3  # how far each of the gripper's two arms reaches, forwards and sideways alike [m]
TABLE = (0.0, 1.0)  # the gripper is put down in this range, along x and along y [m]
ADVANCE = (0.05, 0.8)  # of one push [m]
WEIGHT = 0.5  # of each belief, fixed
OFFSET_WEIGHT = 1000.0  # of the object's squared distance from the gripper's centre [1/m^2]
ADVANCE_WEIGHT = 0.001  # of the squared advance: small, because pushing far is merely untidy [1/m^2]


def approach(place: ca.MX, gripper: ca.MX, theta: ca.MX) -> dict[str, ca.MX]:
    """Tell where an object is for the gripper that was put down: local = R(-theta) (place - gripper).

    For given actions this is linear, so that "linear", its default, has the exact moments.

    Args:
        place: (2,) position of the object [m].
        gripper: (2,) position of the gripper's centre, p_m [m].
        theta: () direction that it points to, and advances in [rad].

    Returns:
        local: (2,) position of the object in the gripper's frame: ahead, to the left [m].
    """
    x, y = place[0] - gripper[0], place[1] - gripper[1]
    c, s = ca.cos(theta), ca.sin(theta)
    return {"local": ca.vertcat(c * x + s * y, c * y - s * x)}


def push(local: ca.MX, advance: ca.MX) -> dict[str, ca.MX]:
    """Tell where the object is in the gripper's frame after the push.

    The arms run from (0, 0) to (r, ±r). They touch an object at (x, y) when 0 ≤ x - |y| < m and |y| ≤ r. Then it
    slides along its arm: to the centre, offset = (0, 0), when x < m, else to offset = (x - m, sign(y) (x - m)).
    An object that they do not touch stays where it is, offset = (x - m, y).

    Args:
        local: (2,) position of the object in the gripper's frame, before [m].
        advance: () how far the gripper moves, m [m].

    Returns:
        offset: (2,) position of the object in the gripper's frame, afterwards [m].

    Source: Yamaguchi & Atkeson 2016, figure 5 (a) to (d).
    """
    ahead, side = local[0] - advance, local[1]
    gap = local[0] - ca.fabs(side)  # to the arm, along the motion
    touched = ca.logic_and(ca.logic_and(gap >= 0, gap < advance), ca.fabs(side) <= ARM)
    captured = ca.logic_and(touched, ahead < 0)
    pushed = ca.if_else(touched, ahead * ca.sign(side), side)
    return {"offset": ca.vertcat(ca.if_else(captured, 0, ahead), ca.if_else(captured, 0, pushed))}


def score(offset: ca.MX, advance: ca.MX) -> ca.MX:
    """Reward of a push: R = -1000 ‖offset‖² - 0.001 m².

    Args:
        offset: (2,) position of the object in the gripper's frame, afterwards [m].
        advance: () how far the gripper moved, m [m].

    Returns:
        () reward.

    Source: Yamaguchi & Atkeson 2016, section VI.
    """
    return -OFFSET_WEIGHT * ca.sumsqr(offset) - ADVANCE_WEIGHT * advance**2


class CentralDifferences:
    """A function's local linear model over steps that are not small: E[y] = f(μ), cov[y] = J Σ Jᵀ.

    Column i of J is (f(μ + h eᵢ) - f(μ - h eᵢ)) / 2h, for the elements of uncertain inputs. Where a jump lies within
    h of the mean, J sees it; the exact derivative does not.

    Args:
        function: a model as a plain function that writes one slot.
        step: h [unit of the uncertain inputs].

    Source: Yamaguchi & Atkeson 2016, section VI ("we use a Taylor series expansion"), which leaves out the step.
    """

    def __init__(self, function: Callable[..., dict[str, ca.MX]], writes: str, step: float) -> None:
        if not (math.isfinite(step) and step > 0):
            raise ValueError(f"step = {step!r}; give a positive number")
        self.function = function
        self.name = function.__name__
        self.reads = tuple(signature(function).parameters)
        self.writes = (writes,)
        self.step = step

    def propagate(self, inputs: Mapping[str, sg.Gaussian]) -> dict[str, sg.Gaussian]:
        """Return {label: Gaussian} of what the function writes."""
        (label,) = self.writes
        means = {name: gaussian.mean for name, gaussian in inputs.items()}
        y = self.function(**means)[label]
        covariance = ca.MX(y.numel(), y.numel())
        for name, gaussian in inputs.items():
            if not gaussian.covariance.nnz():
                continue
            n = gaussian.mean.numel()
            columns = []
            for i in range(n):
                step = ca.DM.zeros(n)
                step[i] = self.step
                ahead, behind = (self.function(**{**means, name: gaussian.mean + h})[label] for h in (step, -step))
                columns.append((ahead - behind) / (2 * self.step))
            jacobian = ca.horzcat(*columns)
            covariance += ca.mtimes([jacobian, gaussian.covariance, jacobian.T])
        return {label: sg.Gaussian(y, covariance)}


def graph(model: Any = push) -> sg.Graph:
    """The task: put the gripper down, push, be scored; where the object is, is a matter of chance.

    Args:
        model: reads `local` and `advance`, writes `offset`; both beliefs share it. Another propagation rule is
            given as `sg.Model(push, propagation="quadrature")`, a learned model as itself.

    Source: Yamaguchi & Atkeson 2016, figure 5.
    """
    graph = sg.Graph(
        {
            "gripper": sg.Action(2, low=TABLE[0], high=TABLE[1], unit="m"),
            "theta": sg.Action(low=-math.pi, high=math.pi, unit="rad"),
            "advance": sg.Action(low=ADVANCE[0], high=ADVANCE[1], unit="m"),
            "first": sg.State(2, unit="m"),
            "second": sg.State(2, unit="m"),
            "local": sg.State(2, unit="m"),
            "offset": sg.State(2, unit="m"),
        },
        start="aim",
    )
    graph.chance(
        "aim",
        {place: ("approached", sg.Model(approach, rename={"place": place})) for place in ("first", "second")},
        {"first": WEIGHT, "second": 1 - WEIGHT},
    )
    graph.edge("approached", "pushed", model)
    graph.reward("pushed", score)
    return graph


def state(first: Sequence[float], first_sd: float, second: Sequence[float], second_sd: float) -> dict[str, sg.Gaussian]:
    """What is known before the push: a mixture of two Gaussians, one of them the truth.

    Args:
        first: (2,) where the object may be [m].
        first_sd: () standard deviation of that, the same in every direction [m].
        second: (2,) where it may be just as well [m].
        second_sd: () likewise [m].

    Returns:
        first, second: (2,) positions [m].

    Raises:
        ValueError: a standard deviation that is negative or not finite.
    """
    for name, sd in (("first_sd", first_sd), ("second_sd", second_sd)):
        if not (math.isfinite(sd) and sd >= 0):
            raise ValueError(f"{name} = {sd!r}; give a number of at least 0")
    return {"first": sg.Gaussian(first, sd=(first_sd,) * 2), "second": sg.Gaussian(second, sd=(second_sd,) * 2)}
