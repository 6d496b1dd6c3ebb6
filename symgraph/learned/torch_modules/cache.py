"""What was exported once is kept on the disk, under a key of all that it follows from.

No key sees everything that a forward method may use. So what is found is compared with the module in numbers before
it is used, as what is new is too.
"""

from __future__ import annotations

import hashlib
import json
import sys
import tempfile
import types
from collections.abc import Iterator, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import casadi as ca
import torch

from symgraph.compile.toolchain import private_folder
from symgraph.learned.torch_modules.lowering import Lowered, Weight
from symgraph.learned.torch_modules.tape import Tape

_known: dict[str, Lowered] = {}


def find(key: str) -> Lowered | None:
    """Return what was kept under a key, if it is there and whole."""
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
                document["halved"],
            )
        except (OSError, ValueError, KeyError, TypeError, RuntimeError, NotImplementedError):
            return None
    return _known[key]


def keep(key: str, lowered: Lowered) -> None:
    """Keep it for this process, and for others where the disk allows."""
    _known[key] = lowered
    document = {
        "function": lowered.function.serialize(),
        "shapes": lowered.shapes,
        "steps": lowered.tape.steps,
        "weights": [(w.sources, w.step, *w.shape) for w in lowered.weights],
        "kept": lowered.kept,
        "halved": lowered.halved,
    }
    path = _file(key)
    try:
        with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".part", delete=False) as part:
            json.dump(document, part)
        Path(part.name).replace(path)  # at once, so that processes may race for it
    except OSError:
        return


def forget(key: str) -> None:
    """Drop what turned out to be another module's."""
    _known.pop(key, None)
    _file(key).unlink(missing_ok=True)


def _file(key: str) -> Path:
    return private_folder("modules") / f"{key}.json"


def fingerprint(module: torch.nn.Module, shapes: Sequence[tuple[int, ...]]) -> str:
    """Return a key of the code of a module's classes, its settings and its shapes, but not of its weights."""
    digest = hashlib.sha256(repr((*_versions(), tuple(shapes))).encode())
    for part in _described_module(module):
        digest.update(part.encode() + b"\0")
    return digest.hexdigest()[:32]


@cache
def _versions() -> tuple[str, ...]:
    files = sorted(Path(__file__).parent.glob("*.py"))
    own = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    return str(torch.__version__), version("casadi"), sys.version, own


def _described_module(module: torch.nn.Module) -> Iterator[str]:
    seen: set[int] = set()
    for path, part in module.named_modules(remove_duplicate=False):
        yield f"{path}:{_id_of(type(part))}"
        for kind in type(part).__mro__:
            if not _is_torch(kind):
                yield from _described(dict(vars(kind)), seen)
        own = {name: value for name, value in vars(part).items() if name not in ("_parameters", "_buffers", "_modules")}
        yield from _described(own, seen)
    state = {
        **dict(module.named_parameters(remove_duplicate=False)),
        **dict(module.named_buffers(remove_duplicate=False)),
    }
    for name, tensor in state.items():
        fixed = not tensor.is_floating_point() or not bool(tensor.isfinite().all())
        yield f"{name}:{tuple(tensor.shape)}{tensor.dtype}{tensor.requires_grad}{_numbers(tensor) if fixed else ''}"
    places: dict[int, str] = {}  # weights that are one and the same
    for name, tensor in state.items():
        yield f"{name}={places.setdefault(id(tensor), name)}"


def _id_of(kind: Any) -> str:
    return f"{getattr(kind, '__module__', '')}.{getattr(kind, '__qualname__', '')}"


def _is_torch(kind: Any) -> bool:
    return str(getattr(kind, "__module__", "")).partition(".")[0] in ("torch", "builtins")


def _numbers(tensor: torch.Tensor) -> str:
    return hashlib.sha256(repr(tensor.tolist()).encode()).hexdigest()


def _described(value: Any, seen: set[int]) -> Iterator[str]:
    """Describe settings and code, what they contain and what they call, but for libraries' insides."""
    if isinstance(value, types.MethodType):
        value = value.__func__
    if isinstance(value, types.FunctionType):
        yield _id_of(value)
        if _is_torch(value) or id(value.__code__) in seen:
            return
        seen.add(id(value.__code__))
        yield from _described_code(value.__code__)
        yield from _described(value.__defaults__, seen)
        yield from _described(value.__kwdefaults__, seen)
        for cell in value.__closure__ or ():
            yield from _described(getattr(cell, "cell_contents", None), seen)
        for name in _names_in(value.__code__):
            if name in value.__globals__:
                yield name
                yield from _described(value.__globals__[name], seen)
    elif isinstance(value, (list, tuple, set, frozenset)):
        for part in value if isinstance(value, (list, tuple)) else sorted(value, key=repr):
            yield from _described(part, seen)
    elif isinstance(value, dict):
        for key, part in value.items():
            yield repr(key)
            yield from _described(part, seen)
    elif isinstance(value, torch.Tensor):
        yield f"{tuple(value.shape)}{value.dtype}{_numbers(value)}"
    elif isinstance(value, (staticmethod, classmethod)):
        yield from _described(value.__func__, seen)
    elif isinstance(value, property):
        yield from _described([value.fget], seen)
    elif isinstance(value, (bool, int, float, complex, str, bytes, type(None), torch.dtype, torch.device)):
        yield repr(value)
    else:  # objects by their kind alone: their looks may change from run to run
        yield _id_of(value if isinstance(value, type) else type(value))


def _described_code(code: types.CodeType) -> Iterator[str]:
    yield code.co_code.hex()
    yield repr((code.co_names, code.co_varnames))
    for part in code.co_consts:
        if isinstance(part, types.CodeType):
            yield from _described_code(part)
        else:
            yield repr(sorted(part, key=repr) if isinstance(part, frozenset) else part)


def _names_in(code: types.CodeType) -> Iterator[str]:
    yield from code.co_names
    for part in code.co_consts:
        if isinstance(part, types.CodeType):
            yield from _names_in(part)
