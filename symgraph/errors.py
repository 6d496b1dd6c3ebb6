"""The errors symgraph raises: each names the place, the value and the remedy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class SymgraphError(Exception):
    """Base of all errors that symgraph raises on purpose; catch this one to catch them all."""


class SlotError(SymgraphError, ValueError):
    """A slot or a Gaussian that cannot be: bounds, sizes, choices, covariances."""


class GraphError(SymgraphError, ValueError):
    """A graph, a model in it or its tree that does not fit together."""


class InputError(SymgraphError, ValueError):
    """What was handed to an objective, an optimizer or to solve: states, actions, selections, settings."""


class SolveError(SymgraphError, RuntimeError):
    """No plan could be found: no start point led to a finite value."""


class CompileError(SymgraphError, RuntimeError):
    """The C compiler refused generated code."""


class StorageError(SymgraphError, OSError):
    """A file that cannot be written or read, is damaged, or holds something else.

    Attributes:
        damage: which file is damaged, and in what way; empty if that is not what is wrong.
    """

    damage: str = ""


class MissingExtraError(SymgraphError, ImportError):
    """An optional dependency is not installed."""

    def __init__(self, module: str, extra: str, purpose: str) -> None:
        super().__init__(f"{purpose} needs the package '{module}': install it with  pip install 'symgraph[{extra}]'")


def names(labels: Iterable[str]) -> str:
    """List labels for a message, each once: 'a', 'b', 'c'."""
    return ", ".join(repr(label) for label in dict.fromkeys(labels)) or "(none)"


def did_you_mean(name: object, options: Iterable[str]) -> str:
    """End a message's first sentence: "; did you mean 'x'?" for the option closest to a misspelt name, or "."."""

    def likeness(option: str) -> float:
        # A label such as lower_muzzle is also meant by a misspelling of one of its words.
        words = [option, *option.split("_")]
        given = str(name).lower()
        return max(difflib.SequenceMatcher(None, given, word.lower()).ratio() for word in words if word)

    ranked = sorted(((likeness(option), -i, option) for i, option in enumerate(options) if option), reverse=True)
    return f"; did you mean {ranked[0][2]!r}?" if ranked and ranked[0][0] > 0.6 else "."
