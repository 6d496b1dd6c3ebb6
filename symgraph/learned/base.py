"""What learned models have in common: labels, options, and how many samples they have seen."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

from symgraph.learned.gaussians import RULES
from symgraph.learned.inputs import checked_count, checked_hidden, checked_option, checked_sizes
from symgraph.model import Parameter
from symgraph.slots import Gaussian


@dataclass
class Experience:
    """What a learned model keeps between fits; shared by its views under other propagation rules."""

    samples: int = 0


class LearnedModel(ABC):
    """A model whose weights come from samples; a `Propagator`."""

    writes: Any
    _experience: Experience

    def __init__(
        self,
        reads: Mapping[str, int],
        hidden: Sequence[int],
        propagation: str,
        samples_needed: int,
        name: str,
    ) -> None:
        self.name = str(name)
        self.reads = checked_sizes(reads, f"{self.name}: reads")
        self.hidden = checked_hidden(hidden, f"{self.name}: hidden")
        self.propagation = checked_option(propagation, RULES, f"{self.name}: propagation")
        self.samples_needed = checked_count(samples_needed, f"{self.name}: samples_needed")

    @property
    @abstractmethod
    def parameters(self) -> tuple[Parameter, ...]:
        """The weights, which enter an objective as its parameters: a fit changes them, and nothing is rebuilt."""

    @abstractmethod
    def propagate(self, inputs: Mapping[str, Gaussian]) -> dict[str, Gaussian]:
        """Return {label: Gaussian} of what it writes, as expressions of its parameters; see `Propagator`."""

    @property
    def samples(self) -> int:
        """How many samples the last fit had."""
        return self._experience.samples

    @property
    def lacking(self) -> str | None:
        """What is missing before it can be used, e.g. "2 of 3 samples"; None when nothing is."""
        return None if self.samples >= self.samples_needed else f"{self.samples} of {self.samples_needed} samples"

    def with_propagation(self, rule: str) -> Self:
        """Return a view under another rule: the same weights, now and after further fits.

        Raises:
            InputError: no such rule.
        """
        view = copy.copy(self)
        view.propagation = checked_option(rule, RULES, f"{self.name}: propagation")
        return view

    def __repr__(self) -> str:
        reads, writes = ", ".join(self.reads), ", ".join(self.writes)
        return f"{type(self).__name__}({self.name}: {reads} → {writes}, hidden {self.hidden}, {self.samples} samples)"
