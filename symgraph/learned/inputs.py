"""Inputs of networks: what users say about labels and samples, checked, and Gaussians stacked to one."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, TypeVar

import casadi as ca
import numpy as np

from symgraph.cubature import square_root
from symgraph.errors import InputError, SlotError, did_you_mean, names
from symgraph.slots import Array, Gaussian, as_numbers

Option = TypeVar("Option", bound=str)

LARGEST = 1e100  # of a sample's numbers: their squares must still be numbers


def checked_sizes(given: Any, place: str) -> dict[str, int]:
    """Return {label: number of elements}.

    Raises:
        InputError: not a mapping of labels to positive whole numbers.
    """
    if not isinstance(given, Mapping) or not given:
        raise InputError(f"{place} = {given!r}; give {{label: number of elements}}, e.g. {{'position': 3}}")
    for label, size in given.items():
        if not isinstance(label, str) or not label:
            raise InputError(f"{place}: label {label!r} is not a name; labels are non-empty strings")
        checked_count(size, f"{place}: size of {label!r}")
    return {label: int(size) for label, size in given.items()}


def checked_count(value: Any, place: str) -> int:
    """Return a positive whole number; raise InputError naming the place otherwise."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise InputError(f"{place} is {value!r}; give a positive whole number")
    return int(value)


def checked_number(value: Any, place: str, most: float) -> float:
    """Return a number from 0 to `most`; raise InputError naming the place otherwise."""
    number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if not number or not 0 <= value <= most:
        wanted = "of at least 0" if math.isinf(most) else f"from 0 to {most:g}"
        raise InputError(f"{place} is {value!r}; give a number {wanted}")
    return float(value)


def checked_resolution(given: Any, reads: Mapping[str, int], place: str) -> dict[str, list[float]]:
    """Return {label: a number of at least 0 for each element}, in the order of the labels that are read.

    Raises:
        InputError: another label, a number or shape that does not fit.
    """
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise InputError(f"{place} = {given!r}; give {{label: smallest deviation that counts}}")
    checked = {}
    for label, value in given.items():
        if label not in reads:
            raise InputError(f"{place}: {label!r} is not read{did_you_mean(label, reads)} Reads: {names(reads)}")
        try:
            numbers = as_numbers(value, f"{place} of {label!r}")
        except SlotError as error:
            raise InputError(str(error)) from None
        if numbers.shape not in ((), (reads[label],)) or not (np.isfinite(numbers) & (numbers >= 0)).all():
            raise InputError(
                f"{place} of {label!r} is {value!r}; give a number of at least 0, or one for each of its "
                f"{reads[label]} elements"
            )
        checked[label] = np.broadcast_to(numbers, reads[label]).tolist()
    return {label: checked[label] for label in reads if label in checked}


def checked_hidden(hidden: Any, place: str) -> tuple[int, ...]:
    """Return the units of the hidden layers; raise InputError naming the place otherwise."""
    if isinstance(hidden, str) or not isinstance(hidden, Sequence):
        raise InputError(f"{place} = {hidden!r}; give the units of each hidden layer, e.g. (200, 200)")
    return tuple(checked_count(units, f"{place}[{i}]") for i, units in enumerate(hidden))


def checked_option(given: Any, options: Collection[Option], place: str) -> Option:
    """Return one of the options; raise InputError naming the place otherwise."""
    for option in options:
        if isinstance(given, str) and given == option:
            return option
    hint = did_you_mean(given, options)
    raise InputError(f"{place} = {given!r} is none of its options{hint} Options: {names(options)}")


def checked_rows(given: Any, size: int, place: str) -> Array:
    """Return samples as a finite array (N, size).

    Raises:
        InputError: of another shape, empty, or not finite.
    """
    try:
        array = as_numbers(given, place)
    except SlotError as error:
        raise InputError(str(error)) from None
    if array.ndim == 1 and size == 1:
        array = array[:, None]
    if array.ndim == 2 and array.shape[1] == size and not len(array):
        raise InputError(f"{place} has no rows; give one per sample")
    if array.ndim != 2 or array.shape[1] != size:
        raise InputError(f"{place} has shape {array.shape}; give (N, {size}), a row per sample")
    for wrong, what in ((~np.isfinite(array), "not finite"), (np.abs(array) > LARGEST, f"beyond ±{LARGEST:g}")):
        if wrong.any():
            row = int(np.flatnonzero(wrong.any(axis=1))[0])
            raise InputError(f"{place}[{row}] = {array[row].tolist()} is {what}; leave such rows out")
    return array


def checked_pair(x: Array, y: Sequence[Any] | Array, place: str) -> None:
    """Raise InputError unless there are as many of one as of the other."""
    if len(x) != len(y):
        raise InputError(f"{place}: x has {len(x)} rows, y {len(y)}; give as many of both")


def checked_seed(seed: Any, place: str) -> np.random.Generator:
    """Return the source of randomness of a seed; raise InputError naming the place where it is none."""
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InputError(f"{place}: seed = {seed!r}; give a whole number of at least 0")
    return np.random.default_rng(int(seed))


def mean_and_root(gaussians: Sequence[Gaussian]) -> tuple[ca.MX, ca.MX | None]:
    """Stack independent Gaussians of MX to a mean (n, 1) and a root (n, d), Σ = root rootᵀ; None if all are exact."""
    mean = ca.vertcat(*[g.mean for g in gaussians])
    uncertain = [bool(g.covariance.nnz()) for g in gaussians]
    if not any(uncertain):
        return mean, None
    directions = sum(g.mean.numel() for g, u in zip(gaussians, uncertain, strict=True) if u)
    rows, at = [], 0
    for g, u in zip(gaussians, uncertain, strict=True):
        n = g.mean.numel()
        if u:
            rows.append(ca.horzcat(ca.MX(n, at), square_root(g.covariance), ca.MX(n, directions - at - n)))
            at += n
        else:
            rows.append(ca.MX(n, directions))
    return mean, ca.vertcat(*rows)
