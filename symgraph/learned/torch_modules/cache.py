"""What was exported once is kept on the disk, under a key of all that it follows from.

No key sees everything that a forward method may use. So what is found is compared with the module in numbers before
it is used, as what is new is too.
"""

from __future__ import annotations

import hashlib
import json
import sys
import tempfile
from collections.abc import Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path

import casadi as ca
import torch

from symgraph.compile.toolchain import private_folder
from symgraph.learned.torch_modules.description import Description, Unknown
from symgraph.learned.torch_modules.lowered import Lowered, Weight
from symgraph.learned.torch_modules.tape import Tape

_known: dict[str, Lowered] = {}


def find(key: str | None) -> Lowered | None:
    """Return what was kept under a key, if it is there and whole."""
    if key is None:
        return None
    if key not in _known:
        try:
            document = json.loads(_file(key).read_text())
            _known[key] = Lowered(
                ca.Function.deserialize(document["function"]),
                tuple(tuple(shape) for shape in document["shapes"]),
                Tape(document["steps"]),
                tuple(
                    Weight(tuple(sources), step, (rows, columns))
                    for sources, step, rows, columns in document["weights"]
                ),
                tuple(document["kept"]),
                tuple(document["names"]),
                document["coarsest"],
            )
        except (OSError, ValueError, KeyError, TypeError, RuntimeError, NotImplementedError):
            return None
    return _known[key]


def keep(key: str | None, lowered: Lowered) -> None:
    """Keep it for this process, and for others where the disk allows."""
    if key is None:
        return
    _known[key] = lowered
    document = {
        "function": lowered.function.serialize(),
        "shapes": lowered.shapes,
        "steps": lowered.tape.steps,
        "weights": [(w.sources, w.step, *w.shape) for w in lowered.weights],
        "kept": lowered.kept,
        "names": lowered.names,
        "coarsest": lowered.coarsest,
    }
    path = _file(key)
    text = json.dumps(document)
    try:
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            part = Path(folder, path.name)
            part.write_text(text)
            part.replace(path)  # at once, so that processes may race for it
    except OSError:
        return


def forget(key: str | None) -> None:
    """Drop what turned out to be another module's."""
    if key is None:
        return
    _known.pop(key, None)
    _file(key).unlink(missing_ok=True)


def _file(key: str) -> Path:
    return private_folder("modules") / f"{key}.json"


def fingerprint(module: torch.nn.Module, shapes: Sequence[tuple[int, ...]]) -> str | None:
    """Return a key of the code of a module's classes, its settings and its shapes, but not of its weights.

    None if it holds something whose content nobody can tell.
    """
    digest = hashlib.sha256(repr((*_versions(), tuple(shapes))).encode())
    try:
        for part in Description().of_module(module):
            digest.update(part.encode() + b"\0")
    except Unknown:
        return None
    return digest.hexdigest()[:32]


@cache
def _versions() -> tuple[str, ...]:
    files = sorted(Path(__file__).parent.glob("*.py"))
    own = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    return str(torch.__version__), version("casadi"), sys.version, own
