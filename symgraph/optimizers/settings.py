"""Checks of optimizers' settings."""

from __future__ import annotations

import numpy as np

from symgraph.errors import InputError


def number(name: str, value: object, owner: str, low: float, high: float = np.inf) -> None:
    """Raise InputError unless the setting is a finite number of at least `low` and below `high`."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not low <= value < high:
        limits = f"of at least {low:g}" if high == np.inf else f"in [{low:g}, {high:g})"
        raise InputError(f"{owner}: {name} = {value!r}; give a number {limits}")


def positive_whole(name: str, value: object, owner: str) -> None:
    """Raise InputError unless the setting is a positive whole number."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise InputError(f"{owner}: {name} = {value!r}; give a positive whole number")
