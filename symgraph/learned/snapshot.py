"""Snapshot: what of a learned model goes into a file, and what must stand in it for a model to come back.

A file holds the arguments that make such a model, its parameters, and for each of its networks what the next fit goes
on from. The parameters are what predictions are made of; the copies of the networks, the scaling of the data and the
folds of the samples are what `fit` needs to go on as if nothing had happened.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from symgraph.errors import InputError, names
from symgraph.learned.learner import Learner, Memory
from symgraph.learned.perceptron import Scaling
from symgraph.learned.storage import MOST_BYTES, Arrays, Document, Shape, Specs
from symgraph.learned.training import FOLDS, Copies
from symgraph.slots import Array

DIGEST = 8  # [bytes] of a sample


@dataclass(frozen=True)
class Stored:
    """What a file holds.

    Attributes:
        settings: the arguments that make such a model.
        samples: of the last fit.
        parameters: in the order of the model's.
        networks: {name: what its next fit goes on from}.
    """

    settings: dict[str, Any]
    samples: int
    parameters: list[Array]
    networks: dict[str, tuple[Learner, Memory | None]]


@dataclass(frozen=True)
class Layout:
    """What a model of certain settings consists of.

    Attributes:
        parameters: {name: shape}, in the order of the model's.
        networks: {name: (sizes of its layers, whether its targets are scaled)}.
    """

    parameters: dict[str, Shape]
    networks: dict[str, tuple[tuple[int, ...], bool]]

    def __post_init__(self) -> None:
        for sizes, _ in self.networks.values():
            _checked_number(max(sizes), "units of a layer", 1)  # before anything is computed from it


def layer_shapes(network: str, sizes: Sequence[int]) -> dict[str, Shape]:
    """Return {name: shape} of a perceptron's parameters."""
    shapes: dict[str, Shape] = {}
    for i, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
        shapes |= {f"{network}.weights_{i}": (outputs, inputs), f"{network}.biases_{i}": (outputs, 1)}
    return shapes


def pack(stored: Stored, layout: Layout) -> tuple[Document, Arrays]:
    """Return what a file is to hold as a document and arrays."""
    arrays: Arrays = dict(zip(layout.parameters, stored.parameters, strict=True))
    trained = {}
    for network, (learner, memory) in stored.networks.items():
        trained[network] = {
            "begun_with": learner.begun_with,
            "known": len(learner.folds.known),
            "copies": 0 if memory is None else memory.copies.count,
        }
        known = learner.folds.known
        arrays[f"{network}.known"] = np.frombuffer(b"".join(known), dtype=np.uint8).reshape(-1, DIGEST)
        arrays[f"{network}.folds"] = np.array(list(known.values()), dtype=np.uint8)
        if memory is not None:
            for i, (weights, biases) in enumerate(zip(memory.copies.weights, memory.copies.biases, strict=True)):
                arrays |= {f"{network}.copies.weights_{i}": weights, f"{network}.copies.biases_{i}": biases}
            arrays |= {f"{network}.x_mean": memory.x.mean, f"{network}.x_sd": memory.x.sd}
            if memory.y is not None:
                arrays |= {f"{network}.y_mean": memory.y.mean, f"{network}.y_sd": memory.y.sd}
    return {"settings": stored.settings, "samples": stored.samples, "networks": trained}, arrays


def expected(document: Document, layout: Layout) -> Specs:
    """Return the tensors that a file must hold.

    Raises:
        InputError: a document of another form.
    """
    checked_keys(document, ("settings", "samples", "networks", "digest"), "the document")
    _checked_number(document["samples"], "samples", 0)
    trained = checked_keys(document["networks"], layout.networks, "'networks'")
    specs: Specs = {name: ("F64", shape) for name, shape in layout.parameters.items()}
    for network, (sizes, scaled) in layout.networks.items():
        counts = checked_keys(trained[network], ("begun_with", "known", "copies"), f"network {network!r}")
        for name, value in counts.items():
            _checked_number(value, f"{network!r}: {name}", 0)
        copies, known = counts["copies"], counts["known"]
        if copies > 1 + FOLDS:
            raise InputError(f"{network!r}: copies is {copies}; there are at most {1 + FOLDS}")
        specs |= {f"{network}.known": ("U8", (known, DIGEST)), f"{network}.folds": ("U8", (known,))}
        if not copies:
            continue
        for i, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
            specs[f"{network}.copies.weights_{i}"] = "F32", (copies, inputs, outputs)
            specs[f"{network}.copies.biases_{i}"] = "F32", (copies, 1, outputs)
        for axis, size in (("x", sizes[0]), *([("y", sizes[-1])] if scaled else [])):
            specs |= {f"{network}.{axis}_mean": ("F64", (size,)), f"{network}.{axis}_sd": ("F64", (size,))}
    return specs


def unpack(document: Document, arrays: Arrays, layout: Layout) -> Stored:
    """Return what a file holds.

    Args:
        document: as `expected` takes it.
        arrays: as `expected` wants them, finite.
        layout: of its settings.

    Raises:
        InputError: numbers that no fit has left.
    """
    networks: dict[str, tuple[Learner, Memory | None]] = {}
    for network, (sizes, scaled) in layout.networks.items():
        counts = document["networks"][network]
        learner, memory = Learner(), None
        learner.begun_with = counts["begun_with"]
        digests, folds = arrays[f"{network}.known"], arrays[f"{network}.folds"]
        learner.folds.known = {row.tobytes(): int(fold) for row, fold in zip(digests, folds, strict=True)}
        if len(learner.folds.known) < len(digests) or (folds >= FOLDS).any():
            raise InputError(f"{network!r}: a sample stands in it twice, or in a fold that does not exist")
        if counts["copies"]:
            layers = range(len(sizes) - 1)
            copies = Copies(
                [arrays[f"{network}.copies.weights_{i}"] for i in layers],
                [arrays[f"{network}.copies.biases_{i}"] for i in layers],
            )
            memory = Memory(copies, _scaling(arrays, network, "x"), _scaling(arrays, network, "y") if scaled else None)
        networks[network] = learner, memory
    return Stored(document["settings"], document["samples"], [arrays[name] for name in layout.parameters], networks)


def _scaling(arrays: Arrays, network: str, axis: str) -> Scaling:
    mean, sd = arrays[f"{network}.{axis}_mean"], arrays[f"{network}.{axis}_sd"]
    if not (sd >= 0).all():
        raise InputError(f"{network!r}: the scaling of {axis} is {sd.tolist()}; no deviation is below 0")
    return Scaling(mean, sd)


def checked_keys(given: Any, keys: Sequence[str] | dict[str, Any], place: str) -> dict[str, Any]:
    """Return a JSON object; raise InputError naming the place unless it has these keys and no others."""
    if not isinstance(given, dict) or set(given) != set(keys):
        found = names(given) if isinstance(given, dict) else repr(given)
        raise InputError(f"{place} is to have {names(keys)}, but has {found}")
    return given


def _checked_number(value: Any, place: str, least: int) -> None:
    if type(value) is not int or not least <= value <= MOST_BYTES:
        raise InputError(f"{place} is {value!r}, and no number from {least} to {MOST_BYTES}")
