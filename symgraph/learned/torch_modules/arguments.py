"""Which labels make up the tensors that a module takes and returns."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from symgraph.errors import InputError, names

Shape = tuple[int, ...]

READS = "give {label: number of elements}, or a list of such dicts for a module that takes several tensors"
WRITES = "give {label: number of elements}, or a list of such dicts for a module that returns several tensors"


@dataclass(frozen=True)
class Tensors:
    """Labels of several tensors, in order.

    Attributes:
        labels: of each tensor, whose numbers are those of its labels one after the other.
        shapes: of each tensor, as far as they were given.
        sizes: {label: number of elements}, each label once.
    """

    labels: tuple[tuple[str, ...], ...]
    shapes: tuple[Shape, ...]
    sizes: dict[str, int]


def tensors_of(given: Any, place: str, usage: str) -> Tensors:
    """Check what `reads` or `writes` says.

    Raises:
        InputError: no mappings of labels to sizes or shapes, or a label with two sizes.
    """
    listed = [given] if isinstance(given, Mapping) else given
    if not isinstance(listed, Sequence) or isinstance(listed, str) or not listed:
        raise InputError(f"{place} = {given!r}; {usage}")
    labels, shapes = [], []
    sizes: dict[str, int] = {}
    for mapping in listed:
        if not isinstance(mapping, Mapping) or not all(isinstance(label, str) and label for label in mapping):
            raise InputError(f"{place} = {given!r}; {usage}")
        parts = {label: _shape(size, f"{place}: size of {label!r}") for label, size in mapping.items()}
        shaped = [label for label, size in mapping.items() if not isinstance(size, (int, np.integer))]
        if shaped and len(parts) > 1:
            raise InputError(
                f"{place}: {shaped[0]!r} has the shape {parts[shaped[0]]} and shares its tensor with "
                f"{names(label for label in parts if label != shaped[0])}; give it one of "
                f"its own, or sizes to all of them"
            )
        for label, shape in parts.items():
            size = math.prod(shape)
            if sizes.setdefault(label, size) != size:
                raise InputError(f"{place}: {label!r} has {sizes[label]} elements in one tensor and {size} in another")
        labels.append(tuple(parts))
        total = sum(math.prod(shape) for shape in parts.values())
        shapes.append(parts[shaped[0]] if shaped else (1, total))
    if not sizes:
        raise InputError(f"{place} = {given!r}; {usage}")
    return Tensors(tuple(labels), tuple(shapes), sizes)


def _shape(given: Any, place: str) -> Shape:
    """Return the shape of a label's numbers; a size is a row, a batch of one."""
    parts = given if isinstance(given, Sequence) and not isinstance(given, str) else (1, given)
    whole = all(isinstance(n, (int, np.integer)) and not isinstance(n, bool) and n > 0 for n in parts)
    if not whole or not parts:
        raise InputError(
            f"{place} is {given!r}; give a positive whole number, or the shape of the tensor, e.g. (1, 5, 3)"
        )
    return tuple(int(n) for n in parts)


def matched(writes: Tensors, shapes: Sequence[Shape], keys: Sequence[str], place: str) -> Tensors:
    """Return the labels of each tensor that a module returns, by the keys of its dict where those are the labels.

    Raises:
        InputError: another number of tensors or of elements, or a label twice.
    """
    if keys and set(keys) == set(writes.sizes):
        writes = Tensors(tuple((key,) for key in keys), (), {key: writes.sizes[key] for key in keys})
    returned = ", ".join(str(shape) for shape in shapes)
    if len(shapes) != len(writes.labels):
        raise InputError(
            f"{place}: the module returns {len(shapes)} tensor{'s' * (len(shapes) != 1)} of shape {returned}, for "
            f"which writes gives labels to {len(writes.labels)}; give a list with a dict for each, "
            f"empty where it is not needed"
        )
    seen: set[str] = set()
    for labels, shape in zip(writes.labels, shapes, strict=True):
        size = sum(writes.sizes[label] for label in labels)
        if labels and size != math.prod(shape):
            raise InputError(
                f"{place}: writes gives {size} elements to {names(labels)}, the module returns {math.prod(shape)} "
                f"there, a tensor of shape {shape}"
            )
        twice = seen & set(labels)
        if twice:
            raise InputError(f"{place}: writes names {names(twice)} twice; give another label to one of them")
        seen |= set(labels)
    return writes
