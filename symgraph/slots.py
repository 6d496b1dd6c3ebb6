"""Slots, the labelled entries of a super-state-action dictionary, and the Gaussians they hold."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from symgraph.errors import SlotError, names

Array = npt.NDArray[np.float64]
Choices = npt.NDArray[np.int64]  # (P, number of selections): which choice of each selection, a row per point


@dataclass(frozen=True)
class State:
    """A quantity that models read and write.

    Args:
        size: number of elements; a state is a column of them.
        unit: shown wherever the value is, e.g. "m/s".

    Raises:
        SlotError: size is not a positive whole number.
    """

    size: int = 1
    unit: str = ""

    def __post_init__(self) -> None:
        _check_size(self.size, "State")


@dataclass(frozen=True)
class Action:
    """A continuous quantity that the planner chooses within bounds.

    Args:
        size: number of elements.
        low: lower bound, a number for all elements or one per element [unit].
        high: upper bound, likewise [unit].
        unit: shown wherever the value is.

    Raises:
        SlotError: bounds are missing, not finite, of the wrong size, or low > high.
    """

    size: int = 1
    low: float | Sequence[float] | None = None
    high: float | Sequence[float] | None = None
    unit: str = ""

    def __post_init__(self) -> None:
        _check_size(self.size, "Action")
        for side in ("low", "high"):
            object.__setattr__(self, side, self._bound(side))
        below = np.flatnonzero(self.lower > self.upper)
        if below.size:
            i = below[0]
            raise SlotError(
                f"Action: low = {self.lower[i]:g} is above high = {self.upper[i]:g} (element {i}); swap them"
            )

        if not all(
            math.isfinite(high - low) for low, high in zip(self.lower.tolist(), self.upper.tolist(), strict=True)
        ):
            raise SlotError(f"Action: the range from low = {self.low} to high = {self.high} is not finite; narrow it")

    @property
    def lower(self) -> Array:
        """Lower bounds, one per element, (size,) [unit]."""
        return np.asarray(self.low, dtype=float)

    @property
    def upper(self) -> Array:
        """Upper bounds, one per element, (size,) [unit]."""
        return np.asarray(self.high, dtype=float)

    def _bound(self, side: str) -> tuple[float, ...]:
        given = getattr(self, side)
        if given is None:
            raise SlotError(f"Action: {side} is missing; an action needs finite bounds, e.g. Action(low=0.0, high=1.0)")
        bound = as_numbers(given, f"Action: {side}").ravel()
        if bound.size not in (1, self.size):
            raise SlotError(f"Action: {side} has {bound.size} elements, size is {self.size}; give 1 or {self.size}")
        if not np.isfinite(bound).all():
            raise SlotError(f"Action: {side} = {given!r} is not finite; start points are drawn between the bounds")
        return tuple(float(b) for b in np.broadcast_to(bound, (self.size,)))


@dataclass(frozen=True)
class Selection:
    """A discrete choice that the planner makes; models that read it see a one-hot column.

    Args:
        choices: the names of the choices, in the order of the one-hot column.

    Raises:
        SlotError: no choices, doubled ones, or choices that are not strings.
    """

    choices: Sequence[str]

    def __post_init__(self) -> None:
        if isinstance(self.choices, str):
            raise SlotError(f"Selection: choices = {self.choices!r} is one string; give a list, e.g. ['tip', 'shake']")
        if not isinstance(self.choices, Iterable):
            raise SlotError(f"Selection: choices = {self.choices!r}; give a list, e.g. ['tip', 'shake']")
        choices = tuple(self.choices)
        wrong = [choice for choice in choices if not isinstance(choice, str) or not choice]
        if wrong:
            raise SlotError(f"Selection: choice {wrong[0]!r} is not a name; choices are non-empty strings")
        if not choices:
            raise SlotError("Selection: no choices; give at least one, e.g. Selection(['tip', 'shake'])")
        doubled = [choice for i, choice in enumerate(choices) if choice in choices[:i]]
        if doubled:
            raise SlotError(f"Selection: choice {doubled[0]!r} is listed twice in {names(choices)}")
        object.__setattr__(self, "choices", choices)

    @property
    def size(self) -> int:
        """Number of choices: the length of the one-hot column."""
        return len(self.choices)


Slot = State | Action | Selection


def _check_size(size: object, kind: str) -> None:
    if isinstance(size, bool) or not isinstance(size, (int, np.integer)) or size < 1:
        raise SlotError(f"{kind}: size = {size!r}; give a positive whole number")


class Gaussian:
    """A normal distribution N(mean, covariance) of one slot; numbers, or CasADi expressions inside a model.

    Args:
        mean: number, (n,) array, or (n, 1) CasADi column [unit].
        covariance: variance for a scalar, (n, n) matrix otherwise [unit²]; left out: exact.
        sd: standard deviation instead, one number or one per element [unit].

    A scalar's mean and covariance read back as floats, a vector's as (n,) and (n, n) arrays. An exact CasADi
    Gaussian has a covariance without non-zeros, which CasADi then leaves out of every formula.

    Raises:
        SlotError: not finite, wrong sizes, asymmetric, or indefinite.
    """

    __slots__ = ("covariance", "mean")

    mean: Any
    covariance: Any

    def __init__(self, mean: Any, covariance: Any = None, *, sd: Any = None) -> None:
        if covariance is not None and sd is not None:
            raise SlotError("Gaussian: both covariance and sd are given; give one of them")
        if any(isinstance(x, (ca.SX, ca.MX)) for x in (mean, covariance, sd)):
            mean, covariance = _symbolic(mean, covariance, sd)
        else:
            mean, covariance = _numeric(mean, covariance, sd)
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "covariance", covariance)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"Gaussian is immutable; make a new one instead of setting {name!r}")

    def __reduce__(self) -> tuple[Any, ...]:
        # Unchecked: what a plan computed may be NaN in a branch that is not selected.
        return (unchecked_gaussian, (np.atleast_1d(self.mean), np.atleast_2d(self.covariance)))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Gaussian):
            return NotImplemented
        return np.array_equal(self.mean, other.mean) and np.array_equal(self.covariance, other.covariance)

    __hash__ = None  # type: ignore[assignment]  # it holds arrays

    def __repr__(self) -> str:
        return f"Gaussian({self.mean!r}, {self.covariance!r})"

    @property
    def sd(self) -> Any:
        """Standard deviation of each element [unit]: a float for a scalar, else (n,)."""
        if np.isscalar(self.covariance):
            return float(np.sqrt(self.covariance))
        if isinstance(self.covariance, np.ndarray):
            return np.sqrt(np.diag(self.covariance))
        return ca.sqrt(ca.diag(self.covariance))


def _symbolic(mean: Any, covariance: Any, sd: Any) -> tuple[Any, Any]:
    kind = ca.SX if any(isinstance(x, ca.SX) for x in (mean, covariance, sd)) else ca.MX
    try:
        mean, covariance, sd = (None if x is None else kind(x) for x in (mean, covariance, sd))
    except NotImplementedError:
        raise SlotError("Gaussian: SX and MX, or symbols and other things, are mixed; give all as one kind") from None
    n = mean.numel()
    if mean.shape != (n, 1):
        raise SlotError(f"Gaussian: mean is {mean.shape[0]}×{mean.shape[1]}; give a column")
    if sd is not None:
        if sd.numel() not in (1, n):
            raise SlotError(f"Gaussian: sd has {sd.numel()} elements, the mean {n}; give 1 or {n}")
        covariance = ca.diag(sd if sd.numel() == n else ca.repmat(sd, n, 1)) ** 2
    covariance = kind(n, n) if covariance is None else covariance
    if covariance.shape != (n, n):
        raise SlotError(f"Gaussian: covariance is {covariance.shape[0]}×{covariance.shape[1]}, the mean needs {n}×{n}")
    return mean, covariance


def _numeric(mean: Any, covariance: Any, sd: Any) -> tuple[Any, Any]:
    column = as_column(mean, "Gaussian: mean").copy()
    n = column.size
    if sd is not None:
        deviations = as_column(sd, "Gaussian: sd")
        if deviations.size not in (1, n):
            raise SlotError(f"Gaussian: sd has {deviations.size} elements, the mean {n}; give 1 or {n}")
        if (deviations < 0).any():
            raise SlotError(f"Gaussian: sd = {sd!r} is negative")
        matrix = np.diag(np.broadcast_to(deviations, (n,)) ** 2)
    else:
        matrix = as_covariance(0.0 if covariance is None and n == 1 else covariance, n, "Gaussian")
    return (float(column[0]), float(matrix[0, 0])) if n == 1 else (column, matrix)


def unchecked_gaussian(mean: Array, covariance: Array) -> Gaussian:
    """Make a Gaussian of computed numbers, which may be NaN or indefinite by rounding."""
    gaussian = Gaussian.__new__(Gaussian)
    scalar = mean.size == 1
    object.__setattr__(gaussian, "mean", float(mean[0]) if scalar else mean.copy())
    object.__setattr__(gaussian, "covariance", float(covariance[0, 0]) if scalar else covariance.copy())
    return gaussian


def as_numbers(value: Any, place: str) -> Array:
    """Turn a number, a sequence or an array into an array of floats; raise SlotError naming the place otherwise."""
    try:
        numbers = np.asarray(value)
        if numbers.dtype.kind not in "buif":  # a string of digits is not a number
            raise TypeError
        return numbers.astype(float)
    except (TypeError, ValueError):
        raise SlotError(f"{place} = {value!r} is not a number or an array of numbers") from None


def as_column(value: Any, place: str) -> Array:
    """Turn a number or a sequence into a finite (n,) array; raise SlotError naming the place otherwise."""
    column = as_numbers(value, place)
    if column.ndim > 1 and column.size != max(column.shape):
        raise SlotError(f"{place} has shape {column.shape}; give a number or a 1-D array")
    if column.size == 0:
        raise SlotError(f"{place} is empty; give at least one number")
    column = column.ravel()
    if not np.isfinite(column).all():
        raise SlotError(f"{place} = {value!r} is not finite")
    return column


def as_covariance(value: Any, size: int, place: str) -> Array:
    """Turn a variance or a matrix into a checked (size, size) covariance; None is zero."""
    if value is None:
        return np.zeros((size, size))
    matrix = as_numbers(value, f"{place}: covariance")
    if matrix.size == 1 and size == 1:
        matrix = matrix.reshape(1, 1)
    if matrix.shape != (size, size):
        raise SlotError(
            f"{place}: covariance has shape {matrix.shape}, the mean needs ({size}, {size}); "
            f"for independent elements give sd= or numpy.diag of the variances"
        )
    if not np.isfinite(matrix).all():
        raise SlotError(f"{place}: covariance {matrix.tolist()} is not finite")
    scale = float(np.abs(matrix).max())
    asymmetry = np.abs(matrix - matrix.T)
    if asymmetry.max() > 1e-9 * scale:
        i, j = np.unravel_index(int(asymmetry.argmax()), matrix.shape)
        raise SlotError(
            f"{place}: covariance is not symmetric: [{i}, {j}] = {matrix[i, j]:g}, [{j}, {i}] = {matrix[j, i]:g}"
        )
    smallest = matrix[0, 0] if size == 1 else float(np.linalg.eigvalsh(matrix)[0])
    if smallest < -1e-9 * scale:
        raise SlotError(
            f"{place}: covariance has the negative {'variance' if size == 1 else 'eigenvalue'} {smallest:g}; "
            f"it must be positive semi-definite"
        )
    symmetric: Array = (matrix + matrix.T) / 2
    return symmetric
