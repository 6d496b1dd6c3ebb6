"""Records: the visits and episodes of a store, checked as users hand them over, and as the text that stands in it.

Text is JSON. Python writes a float with as many digits as bring it back to the last bit, and infinities and NaN as
`Infinity` and `NaN`, which JSON proper does not know.
"""

from __future__ import annotations

import json
import math
import reprlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from symgraph.errors import InputError, names
from symgraph.slots import Array

Value = float | Array  # a scalar slot is a float, any other a 1-D array

LARGEST = (1 << 63) - 1  # of the whole numbers that SQLite holds
ABSENT = object()  # where one of two mappings has nothing


@dataclass(frozen=True)
class Visit:
    """One node that an episode reached.

    Two visits are equal if all their numbers are, to the last bit; every NaN equals every other.

    Args:
        episode: its number.
        step: 0 at the start of the episode, then 1, 2, … in the order in which nodes were reached.
        parent: the step of the node from which it was reached; None at step 0.
        node: the graph's node.
        observed: {label: value} on the way here, at step 0 at the start: a float for a scalar, else a 1-D array [unit].
        actions: {label: value} with which the parent was left; empty at step 0 [unit].
        selections: {label: choice} with which the parent was left; empty at step 0.
        reward: sum of the graph's rewards that were paid at this node.
    """

    episode: int
    step: int
    parent: int | None
    node: str
    observed: dict[str, Value]
    actions: dict[str, Value]
    selections: dict[str, str]
    reward: float

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Visit):
            return NotImplemented
        return all(_same(getattr(self, field.name), getattr(other, field.name)) for field in fields(Visit))

    __hash__ = None  # type: ignore[assignment]  # it holds arrays


@dataclass(frozen=True)
class Episode:
    """What is known of one episode as a whole.

    Args:
        number: by which it is called.
        setup: the name of the situation it was run in.
        seed: that the world was reset with.
        status: "running", "done", "failed" or "interrupted".
        reason: why it failed or was interrupted, else empty.
        total: the return, the sum of its rewards; None while it runs.
        seconds: {what was done: how long it took} [s]; empty while it runs.
        info: whatever else was noted when it ended.
        begun: when, UTC, ISO 8601.
        ended: likewise; None while it runs.
    """

    number: int
    setup: str
    seed: int
    status: str
    reason: str
    total: float | None
    seconds: dict[str, float]
    info: dict[str, Any]
    begun: str
    ended: str | None


def checked_visit(visit: Any) -> Visit:
    """Return a visit whose values are as they come back from a store; raise InputError naming what is wrong."""
    if not isinstance(visit, Visit):
        raise InputError(f"visits: {shown(visit)} is no Visit; give a list of Visit")
    episode, step = checked_whole(visit.episode, "episode of a visit"), checked_whole(visit.step, "step of a visit")
    place = f"episode {episode}, step {step}"
    parent = None if visit.parent is None else checked_whole(visit.parent, f"{place}: parent")
    if (parent is None) != (step == 0):
        raise InputError(f"{place}: parent = {parent}; give every visit but that of step 0 the step of its parent")
    if parent is not None and parent >= step:
        raise InputError(f"{place}: parent = {parent}; a parent is reached earlier, at a smaller step")
    return Visit(
        episode,
        step,
        parent,
        checked_name(visit.node, f"{place}: node"),
        checked_values(visit.observed, place, "observed"),
        checked_values(visit.actions, place, "action"),
        checked_choices(visit.selections, place),
        checked_number(visit.reward, f"{place}: reward"),
    )


def visit_of(row: tuple[Any, ...]) -> Visit:
    """Return the visit of a row; raise ValueError or TypeError where there is none in it."""
    episode, step, parent, node, observed, actions, selections, reward = row
    return Visit(
        episode, step, parent, node, values_of(observed), values_of(actions), mapping_of(selections), float(reward)
    )


def episode_of(row: tuple[Any, ...]) -> Episode:
    """Return the episode of a row; raise ValueError or TypeError where there is none in it."""
    number, setup, seed, status, reason, total, seconds, info, begun, ended = row
    total = None if total is None else float(total)
    return Episode(number, setup, seed, status, reason, total, mapping_of(seconds), mapping_of(info), begun, ended)


def checked_value(given: Any, place: str) -> Value:
    """Return a float for a number or a 0-d array, a 1-D array of floats for whatever else holds numbers.

    A column or a row is taken for 1-D. Infinities and NaN are numbers: a simulation that failed may say so.

    Raises:
        InputError: no numbers, none at all, ragged, or a matrix.
    """
    if type(given) is float:
        return given
    try:
        # Whole numbers beyond 64 bits are numbers to Python and objects to numpy.
        numbers = np.asarray(float(given) if type(given) is int else given)
        if numbers.dtype.kind not in "buif":
            raise TypeError
        numbers = numbers.astype(np.float64)  # a copy: the caller may write into its own
    except (TypeError, ValueError, OverflowError, RuntimeError):
        raise InputError(
            f"{place} = {shown(given)} is not a number or an array of numbers; give a float or a 1-D array"
        ) from None
    if numbers.ndim == 0:
        return float(numbers)
    if numbers.size == 0:
        raise InputError(f"{place} is empty; give at least one number, or leave the label out")
    if numbers.ndim > 1 and numbers.size != max(numbers.shape):
        raise InputError(f"{place} has shape {numbers.shape}; give a number or a 1-D array")
    return numbers.ravel()


def checked_values(given: Any, place: str, what: str) -> dict[str, Value]:
    """Return {label: value}; raise InputError naming the place and the label otherwise."""
    return {label: checked_value(value, f"{place}: {what} {label!r}") for label, value in _items(given, place, what)}


def checked_choices(given: Any, place: str) -> dict[str, str]:
    """Return {label: choice}; raise InputError naming the place and the label otherwise."""
    return {
        label: checked_name(choice, f"{place}: the choice of selection {label!r}")
        for label, choice in _items(given, place, "selection")
    }


def checked_seconds(given: Any, place: str) -> dict[str, float]:
    """Return {what took them: seconds}; raise InputError naming the place and the label otherwise."""
    return {
        label: checked_number(value, f"{place}: seconds of {label!r}")
        for label, value in _items(given, place, "seconds of")
    }


def checked_number(given: Any, place: str) -> float:
    """Return a float; raise InputError naming the place where it is no number."""
    value = checked_value(given, place)
    if isinstance(value, float):
        return value
    if value.size != 1:
        raise InputError(f"{place} has {value.size} elements; give one number")
    return float(value[0])


def checked_whole(given: Any, place: str) -> int:
    """Return a whole number of at least 0; raise InputError naming the place otherwise."""
    if isinstance(given, bool) or not isinstance(given, (int, np.integer)) or not 0 <= given <= LARGEST:
        raise InputError(f"{place} = {shown(given)}; give a whole number from 0 to 2⁶³ - 1")
    return int(given)


def checked_name(given: Any, place: str) -> str:
    """Return a non-empty string that any file can hold; raise InputError naming the place otherwise."""
    if not isinstance(given, str) or not given:
        raise InputError(f"{place} is {shown(given)}; give a non-empty string")
    return checked_text(given, place)


def checked_text(given: Any, place: str) -> str:
    """Return a string that any file can hold; raise InputError naming the place otherwise."""
    if not isinstance(given, str):
        raise InputError(f"{place} is {shown(given)}; give a string")
    try:
        given.encode()
    except UnicodeEncodeError as error:
        raise InputError(f"{place} holds {error.object[error.start]!r}, which is no character; leave it out") from None
    return str(given)


def checked_names(given: Any, place: str) -> list[str] | None:
    """Return what a query is narrowed to: None for all, or the names of a list or a single one."""
    if given is None:
        return None
    if isinstance(given, str) or not isinstance(given, Iterable):
        given = [given]
    return [checked_name(name, place) for name in given]


def json_of(given: Any, place: str) -> str:
    """Return a mapping as JSON; arrays and tuples become lists, numpy's numbers Python's.

    Raises:
        InputError: it holds what JSON cannot.
    """
    if not isinstance(given, Mapping):
        raise InputError(f"{place} = {shown(given)}; give a mapping of names to what JSON holds")
    try:
        return json.dumps(_plain(given, place))
    except RecursionError:
        raise InputError(f"{place} is nested too deeply, or holds itself; leave that out") from None
    except ValueError as error:  # Python refuses to write numbers of thousands of digits
        if isinstance(error, InputError):
            raise
        raise InputError(f"{place}: {error}; leave it out") from None


def changes(stored: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, str]:
    """Return {name: where it differs first, and what stands there} of two mappings that came from JSON.

    They are compared as text, in which NaN equals NaN and the order of labels counts, as the columns of samples do.
    """
    found = {}
    for name in dict.fromkeys([*stored, *given]):
        told, asked = stored.get(name, ABSENT), given.get(name, ABSENT)
        if _text(told) != _text(asked):
            found[name] = _difference(told, asked, name)
    return found


def _difference(stored: Any, given: Any, place: str) -> str:
    if type(stored) is type(given) and isinstance(stored, (dict, list)):
        left, right = (one if isinstance(one, dict) else dict(enumerate(one)) for one in (stored, given))
        for key in [*left, *right]:
            told, asked = left.get(key, ABSENT), right.get(key, ABSENT)
            if _text(told) != _text(asked):
                return _difference(told, asked, f"{place}[{key!r}]")
        # A mapping: a list would differ at one of its places.
        return f"{place} is stored in the order {names(map(str, left))}, given in the order {names(map(str, right))}"
    told, asked = ("nothing" if one is ABSENT else _cut(repr(one)) for one in (stored, given))
    return f"{place} is stored as {told}, given as {asked}"


def _cut(text: str) -> str:
    return text if len(text) <= 120 else f"{text[:120]} …"


def _text(value: Any) -> str | None:
    return None if value is ABSENT else json.dumps(value)


def _plain(given: Any, place: str) -> Any:
    if given is None or isinstance(given, (str, bool, int, float)):
        # JSON has one kind of each, so of subclasses, enums for one, only the plain value comes back.
        return given
    if isinstance(given, Mapping):
        for name in given:
            if not isinstance(name, str):
                raise InputError(f"{place}: name {shown(name)} is not a string; JSON knows no others")
        return {name: _plain(value, f"{place}[{name!r}]") for name, value in given.items()}
    if isinstance(given, (list, tuple)):
        return [_plain(value, f"{place}[{i}]") for i, value in enumerate(given)]
    if isinstance(given, (np.ndarray, np.generic)) and given.dtype.kind in "buif":
        return given.tolist()
    raise InputError(f"{place} = {shown(given)}, which JSON cannot hold; give numbers, strings, lists or mappings")


def values_text(values: Mapping[str, Value]) -> str:
    """Return checked values as JSON."""
    return json.dumps({label: v if isinstance(v, float) else v.tolist() for label, v in values.items()})


def values_of(text: str) -> dict[str, Value]:
    """Return the values of a text; raise ValueError or TypeError where it holds something else."""
    return {label: value if isinstance(value, float) else _vector(value) for label, value in mapping_of(text).items()}


def _vector(value: Any) -> Array:
    array = np.array(value, dtype=np.float64)
    if not isinstance(value, list) or array.ndim != 1:
        raise ValueError("a value is neither a number nor a list of numbers")
    return array


def mapping_of(text: str) -> dict[str, Any]:
    """Return the mapping of a text; raise ValueError or TypeError where it holds something else."""
    value = json.loads(text)
    if not isinstance(value, dict):
        raise ValueError("a text holds no mapping")
    return value


def number_cell(value: float) -> float | str:
    """Return what SQLite keeps as it is: it makes NULL of NaN."""
    return str(value) if math.isnan(value) else value


def shown(value: Any) -> str:
    """Return the repr of a value, shortened."""
    return reprlib.repr(value)


def _items(given: Any, place: str, what: str) -> Iterable[tuple[str, Any]]:
    if not isinstance(given, Mapping):
        raise InputError(f"{place}: {what} = {shown(given)}; give a mapping of labels")
    for label in given:
        checked_name(label, f"{place}: a label of {what}")
    return given.items()


def _same(a: Any, b: Any) -> bool:
    """Whether two fields of visits hold the same: 0.0 is not -0.0, one element is not a scalar, NaN is NaN."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(_same(a[label], b[label]) for label in a)
    if isinstance(a, (float, np.ndarray)) and isinstance(b, (float, np.ndarray)):
        left, right = np.asarray(a), np.asarray(b)
        equal = np.array_equal(left, right, equal_nan=True)
        return equal and bool(np.all((np.signbit(left) == np.signbit(right)) | np.isnan(left)))
    return bool(a == b)
