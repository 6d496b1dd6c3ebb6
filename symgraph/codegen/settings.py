"""An optimizer's settings as macros, and how much room a search with them takes."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from symgraph.errors import InputError
from symgraph.optimizers import Adadelta, Enumerate, Lbfgs, Optimizer
from symgraph.optimizers.enumerate import MOST_COMBINATIONS as MOST_COMBINATIONS_ENUMERATED

MOST = 2**31 - 1  # of what a setting counts
MOST_GUESSES = 16  # start points from the caller
MOST_SAMPLES_OF_ONE = 1024  # of one combination of selections, as in optimizers/starts.py
MOST_TRIED = 1024  # combinations of selections that a search keeps in mind
MOST_KNOWN = 64  # and of which it keeps how large differences of J are there
MOST_DONE = 64  # searches that have ended, of which the best whose value is borne out counts
SCALE_SAMPLES = 32
FINEST_SINGLE = 1e-5  # tolerance, relative to differences of J
SAMPLING = 0.25  # of a budget, after which no more samples are looked at
MOST_COMBINATIONS = 1_000_000_001  # what more are counted as: beyond 10^9 selections are drawn one by one


@dataclass(frozen=True)
class Settings:
    """What the generated search is like.

    Attributes:
        file: that holds it.
        macros: numbers by name.
        flags: what of the C files is left out.
        name: of the optimizer.
        given: its settings as users know them.
    """

    file: str
    macros: dict[str, int | float]
    flags: dict[str, bool]
    name: str
    given: dict[str, Any]


def settings_of(optimizer: Optimizer, n_actions: int, choices: tuple[int, ...], single: bool) -> Settings:
    """Return how an optimizer searches.

    Args:
        optimizer: Lbfgs, Adadelta, or Enumerate with one of them.
        single: whether J is computed in single precision.
        n_actions: numbers of stacked actions.
        choices: numbers of choices of the selections.

    Raises:
        InputError: an optimizer that needs a library.
    """
    enumerates = isinstance(optimizer, Enumerate)
    inner = optimizer.optimizer if isinstance(optimizer, Enumerate) else optimizer
    combinations = math.prod(choices)
    if enumerates and combinations > MOST_COMBINATIONS_ENUMERATED:
        raise InputError(
            f"export_c: the selections have {combinations:,} combinations, more than Enumerate takes "
            f"({MOST_COMBINATIONS_ENUMERATED:,}); give Lbfgs(), which tries the most promising"
        )
    if isinstance(inner, Lbfgs):
        file, macros, flags = _lbfgs(inner)
    elif isinstance(inner, Adadelta):
        file, macros, flags = _adadelta(inner, len(choices))
    else:
        raise InputError(
            f"export_c: optimizer is {optimizer!r}, which needs a library; give Lbfgs(), Adadelta() or Enumerate(…)"
        )
    if single:  # what rounding hides would be looked for to the last iteration
        macros["TOLERANCE"] = max(macros["TOLERANCE"], FINEST_SINGLE)
    starts, samples = int(macros["MOST_STARTS"]), int(macros["SAMPLES"])
    flags["ENUMERATES"] = enumerates
    macros["ENUMERATES"] = int(enumerates)
    flags["IMPROVES"] = isinstance(inner, Lbfgs) and combinations > inner.starts and not enumerates
    macros |= {
        "MOST_GUESSES": MOST_GUESSES,
        "MOST_SAMPLES": max(SCALE_SAMPLES, starts, min(starts * samples, MOST_SAMPLES_OF_ONE) if n_actions else 1),
        "MOST_SAMPLES_OF_ONE": MOST_SAMPLES_OF_ONE,
        "ROWS": max(starts, min(combinations, MOST_SAMPLES_OF_ONE)),
        "KNOWN": min(combinations, MOST_KNOWN, max(starts, MOST_GUESSES)),
        "MOST_TRIED": min(combinations, MOST_TRIED),
        "MOST_POLISHED": 2 * min(combinations, starts + MOST_GUESSES),
        "MOST_DONE": min(MOST_DONE, starts + MOST_GUESSES),
        "MOST_COMBINATIONS": MOST_COMBINATIONS,
        "SCALE_SAMPLES": SCALE_SAMPLES,
        "SAMPLING": SAMPLING,
    }
    name = f"Enumerate({type(inner).__name__})" if enumerates else type(inner).__name__
    given = {key: _plain(value) for key, value in asdict(inner).items()}
    return Settings(file, {key: _plain(value) for key, value in macros.items()}, flags, name, given)


def _plain(value: Any) -> Any:
    """Return a number as C and JSON have it: none of NumPy's, and no longer than a long is anywhere."""
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return min(int(value), MOST)
    return float(value) if isinstance(value, (float, np.floating)) else value


def _lbfgs(one: Lbfgs) -> tuple[str, dict[str, int | float], dict[str, bool]]:
    macros: dict[str, int | float] = {
        "STARTS": one.starts,
        "MOST_STARTS": one.starts,
        "SAMPLES": one.samples,
        "ITERATIONS": one.iterations,
        "TOLERANCE": one.tolerance,
        "DECAY": 0.0,
        "EPSILON": 0.0,
        "OSCILLATIONS": 0,
        "KEEP_BEST": 0,
        "SCALED_STEPS": 0,
    }
    return "lbfgs.c", macros, {"SCALED": False}


def _adadelta(one: Adadelta, selections: int) -> tuple[str, dict[str, int | float], dict[str, bool]]:
    macros: dict[str, int | float] = {
        "STARTS": one.starts,
        "MOST_STARTS": one.starts + (selections if one.start_per_selection else 0),
        "SAMPLES": 8,  # of a combination, as in optimizers/adadelta.py
        "RUN_ITERATIONS": one.run_iterations,
        "TOTAL_ITERATIONS": one.total_iterations or 0,
        "FINISHED": one.finished or 0,
        "TOLERANCE": one.tolerance,
        "DECAY": one.decay,
        "EPSILON": one.epsilon,
        "OSCILLATIONS": one.oscillation,
        "KEEP_BEST": int(one.keep_best),
        "SCALED_STEPS": int(one.scaled),
    }
    flags = {
        "EVENLY": one.evenly,
        "SPREAD": one.sampling == "spread",
        "GAUSSIAN": one.sampling == "gaussian",
        "REQUEUE": one.requeue,
        "SCALED": one.scaled,
        "POLISH": one.polish,
    }
    return "adadelta.c", macros, flags
