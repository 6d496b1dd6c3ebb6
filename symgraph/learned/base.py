"""What learned models have in common: labels, options, and how many samples they have seen."""

from __future__ import annotations

import copy
import inspect
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import casadi as ca
import numpy as np

from symgraph.errors import InputError, StorageError
from symgraph.learned import snapshot, storage
from symgraph.learned.gaussians import RULES
from symgraph.learned.inputs import (
    checked_count,
    checked_hidden,
    checked_option,
    checked_resolution,
    checked_sizes,
    mean_and_root,
)
from symgraph.learned.learner import Learner, Memory
from symgraph.model import Parameter
from symgraph.slots import Array, Gaussian


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
        resolution: Mapping[str, Any] | None,
        name: str,
    ) -> None:
        self.name = str(name)
        self.reads = checked_sizes(reads, f"{self.name}: reads")
        self.hidden = checked_hidden(hidden, f"{self.name}: hidden")
        self.propagation = checked_option(propagation, RULES, f"{self.name}: propagation")
        self.samples_needed = checked_count(samples_needed, f"{self.name}: samples_needed")
        self.resolution = checked_resolution(resolution, self.reads, f"{self.name}: resolution")

    @property
    @abstractmethod
    def parameters(self) -> tuple[Parameter, ...]:
        """The weights, which enter an objective as its parameters: a fit changes them, and nothing is rebuilt."""

    @abstractmethod
    def propagate(self, inputs: Mapping[str, Gaussian]) -> dict[str, Gaussian]:
        """Return {label: Gaussian} of what it writes, as expressions of its parameters; see `Propagator`."""

    @property
    def _resolutions(self) -> Array:
        """(n,) smallest deviation that counts, for each input; 0 where none was given."""
        return np.concatenate([self.resolution.get(label, [0.0] * size) for label, size in self.reads.items()])

    def _stacked(self, inputs: Mapping[str, Gaussian]) -> tuple[ca.MX, ca.MX | None]:
        """Stack what it reads to a mean (n, 1) and a root (n, d)."""
        for label, size in self.reads.items():
            found = inputs[label].mean.numel()
            if found != size:
                raise InputError(
                    f"{self.name} reads {label!r} with size {size}, the slot has size {found}; make them the same "
                    f"(a selection has as many as it has choices)"
                )
        return mean_and_root([inputs[label] for label in self.reads])

    @property
    def samples(self) -> int:
        """How many samples the last fit had."""
        return self._experience.samples

    @property
    def lacking(self) -> str | None:
        """What is missing before it can be used, e.g. "2 of 3 samples"; None when nothing is."""
        return None if self.samples >= self.samples_needed else f"{self.samples} of {self.samples_needed} samples"

    @property
    def spreads(self) -> tuple[Parameter, ...]:
        """Parameters that make it certain where they are 0, so that only the spread of its inputs is passed on."""
        return ()

    def with_propagation(self, rule: str) -> Self:
        """Return a view under another rule: the same weights, now and after further fits.

        Raises:
            InputError: no such rule.
        """
        view = copy.copy(self)
        view.propagation = checked_option(rule, RULES, f"{self.name}: propagation")
        return view

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write all that predictions and further fits need to one file; a file that is there is replaced as a whole.

        Args:
            path: of the file, a safetensors file with a JSON document in its metadata; no code is ever loaded from it.

        Raises:
            StorageError: the file cannot be written.
            MissingExtraError: safetensors is not installed.
        """
        stored = snapshot.Stored(self.settings, self.samples, [p.value for p in self.parameters], self._networks)
        document, arrays = snapshot.pack(stored, self._layout(self.settings))
        storage.write(path, type(self).__name__, document, arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Return the model that `save` wrote: it predicts the same, and a fit goes on as if nothing had happened.

        Raises:
            StorageError: the file cannot be read, is damaged, or holds something else.
            MissingExtraError: safetensors is not installed.
        """
        document, arrays = storage.read(path, cls.__name__, lambda said: snapshot.expected(said, cls._layout_of(said)))
        try:
            stored = snapshot.unpack(document, arrays, cls._layout_of(document))
            model = cls(**stored.settings)
        except InputError as error:
            raise storage.damaged(path, str(error)) from None
        for parameter, value in zip(model.parameters, stored.parameters, strict=True):
            parameter.value = np.asfortranarray(value)  # the layout that a fit gives them
        model._resume(stored.samples, stored.networks)
        return model

    def restore(self, path: str | os.PathLike[str]) -> None:
        """Take over, in place, what a model with the same settings has saved: graphs that hold this one plan with it.

        Raises:
            StorageError: as `load`; or the file's model has other settings.
            MissingExtraError: safetensors is not installed.
        """
        saved = type(self).load(path)
        here, there = self.settings, saved.settings
        other = [name for name in here if _in_order(here[name]) != _in_order(there[name])]
        if other:
            raise StorageError(
                f"{os.fspath(path)} holds a model with {other[0]} = {there[other[0]]!r}, {self.name!r} has "
                f"{here[other[0]]!r}; make it with the same settings, or load the file as a new model"
            )
        for mine, value in zip(self.parameters, saved.parameters, strict=True):
            mine.value = value.value
        self._resume(saved.samples, saved._networks)

    @classmethod
    def _layout_of(cls, document: storage.Document) -> snapshot.Layout:
        """Return what the model of a document consists of, without making anything of that size."""
        settings = snapshot.checked_keys(
            document.get("settings"), dict(inspect.signature(cls).parameters), "'settings'"
        )
        if not isinstance(settings["name"], str):
            raise InputError(f"name is {settings['name']!r}, and no string")
        return cls._layout(settings)

    @property
    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """All arguments that make such a model."""

    @classmethod
    @abstractmethod
    def _layout(cls, settings: Mapping[str, Any]) -> snapshot.Layout:
        """Return what a model of these settings consists of; raise InputError where their sizes make no sense."""

    @property
    @abstractmethod
    def _networks(self) -> dict[str, tuple[Learner, Memory | None]]:
        """What the next fit of each network goes on from."""

    @abstractmethod
    def _resume(self, samples: int, networks: Mapping[str, tuple[Learner, Memory | None]]) -> None:
        """Take over what `_networks` was, after a fit to so many samples."""

    def __repr__(self) -> str:
        reads, writes = ", ".join(self.reads), ", ".join(self.writes)
        return f"{type(self).__name__}({self.name}: {reads} → {writes}, hidden {self.hidden}, {self.samples} samples)"


def _in_order(setting: Any) -> Any:
    """Return a setting that equals another only if its labels come in the same order, as the columns of samples do."""
    return list(setting.items()) if isinstance(setting, Mapping) else setting


def layer_sizes(settings: Mapping[str, Any], outputs: int) -> tuple[int, ...]:
    """Return the sizes of a network's layers, from settings that nobody has checked."""
    inputs = sum(checked_sizes(settings["reads"], "reads").values())
    return (inputs, *checked_hidden(settings["hidden"], "hidden"), outputs)
