"""Description: all that decides what a module computes but its weights, as text that is the same in each process."""

from __future__ import annotations

import enum
import functools
import hashlib
import sys
import sysconfig
import types
import weakref
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch

LIBRARIES = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")})
PLAIN = (
    bool,
    int,
    float,
    complex,
    str,
    bytes,
    type(None),
    type(Ellipsis),
    range,
    torch.dtype,
    torch.device,
    torch.Size,
)
IDLE = ("_parameters", "_buffers", "_modules", "training")  # of a module: told by itself, or of no importance here
WITHIN = ("_parameters", "_buffers", "_modules")  # of a module, described by themselves


class Unknown(Exception):
    """Something whose content nobody can tell."""


def settings_of(module: torch.nn.Module) -> str | None:
    """Return a digest of a module's layers, settings, and tensors that are no weights; None if nobody can tell."""
    description, digest = Description(code=False), hashlib.sha256()
    try:
        for path, part in module.named_modules(remove_duplicate=False):
            own = {
                name: v for name, v in vars(part).items() if name not in IDLE and not (isinstance(v, dict) and not v)
            }
            for text in (path, _name(type(part)), *description.of(own)):
                digest.update(text.encode() + b"\0")
    except Unknown:
        return None
    return digest.hexdigest()


class Description:
    """Describes settings and code, what they contain and what they call, but for libraries' insides.

    Args:
        code: False leaves code out, which does not change while a process runs.
    """

    def __init__(self, code: bool = True) -> None:
        self._code = code
        self._seen: dict[int, Any] = {}  # kept, so that no other object takes its place

    def of_module(self, module: torch.nn.Module) -> Iterator[str]:
        for path, part in module.named_modules(remove_duplicate=False):
            yield path
            yield from self._of_class(type(part))
            yield from self.of({name: value for name, value in vars(part).items() if name not in WITHIN})
        named = (module.named_parameters(remove_duplicate=False), module.named_buffers(remove_duplicate=False))
        places: dict[int, str] = {}  # weights that are one and the same
        for name, tensor in (pair for pairs in named for pair in pairs):
            fixed = not tensor.is_floating_point() or not bool(tensor.isfinite().all())
            yield f"{name}={places.setdefault(id(tensor), name)}:{tensor.requires_grad}"
            yield from self.of(tensor) if fixed else [f"{tuple(tensor.shape)}{tensor.dtype}"]

    def of(self, value: Any) -> Iterator[str]:
        """Describe anything; raise Unknown for what cannot be."""
        if isinstance(value, PLAIN):
            yield repr(value)
            return
        if id(value) in self._seen:
            yield "again"
            return
        self._seen[id(value)] = value
        if isinstance(value, torch.nn.Parameter):
            yield f"{tuple(value.shape)}{value.dtype}"
        elif isinstance(value, torch.Tensor):
            yield f"{tuple(value.shape)}{value.dtype}{_digest(value.detach().cpu().contiguous().numpy().tobytes())}"
        elif isinstance(value, (np.ndarray, np.generic)) and value.dtype != object:
            yield f"{value.shape}{value.dtype}{_digest(value.tobytes())}"
        elif isinstance(value, (list, tuple)):
            yield _name(type(value))
            for part in value:
                yield from self.of(part)
        elif isinstance(value, (set, frozenset)):
            yield from sorted("".join(Description().of(part)) for part in value)
        elif isinstance(value, (dict, types.MappingProxyType)):
            for key, part in value.items():
                yield from self.of(key)
                yield from self.of(part)
        else:
            yield from self._of_object(value)

    def _of_object(self, value: Any) -> Iterator[str]:
        if isinstance(value, types.ModuleType):
            if not _is_library(value):
                raise Unknown  # what is used of it is described where it is used
            yield value.__name__
        elif isinstance(value, type):
            yield from self._of_class(value)
        elif isinstance(value, types.FunctionType):
            yield from self._of_function(value)
        elif isinstance(value, types.MethodType):
            yield from self.of((value.__func__, value.__self__))
        elif isinstance(value, (staticmethod, classmethod)):
            yield from self.of(value.__func__)
        elif isinstance(value, property):
            yield from self.of((value.fget, value.fset))
        elif isinstance(value, functools.partial):
            yield from self.of((value.func, value.args, value.keywords))
        elif isinstance(value, weakref.ref):
            yield from self.of(value())
        elif isinstance(value, enum.Enum):
            yield repr(value)
        elif isinstance(value, (types.BuiltinFunctionType, types.GetSetDescriptorType, types.MemberDescriptorType)):
            yield _name(value)
        elif isinstance(value, torch._ops.OpOverload | torch._ops.OpOverloadPacket):
            yield str(value)
        elif hasattr(value, "__dict__"):
            yield from self._of_class(type(value))
            yield from self.of(vars(value))
        else:
            raise Unknown

    def _of_class(self, kind: type) -> Iterator[str]:
        for one in kind.__mro__:
            yield _name(one)
            if self._code and id(one) not in self._seen and not _is_library(one):
                self._seen[id(one)] = one
                yield from self.of({name: part for name, part in vars(one).items() if name not in OF_CLASSES})

    def _of_function(self, function: types.FunctionType) -> Iterator[str]:
        yield _name(function)
        if not self._code:
            yield str(id(function))
        if not self._code or _is_library(function):
            return
        yield from self._of_code(function.__code__)
        yield from self.of((function.__defaults__, function.__kwdefaults__))
        names = list(dict.fromkeys(_names_in(function.__code__)))
        for cell in function.__closure__ or ():
            yield from self._of_global(getattr(cell, "cell_contents", None), names)
        for name in names:
            if name in function.__globals__:
                yield name
                yield from self._of_global(function.__globals__[name], names)

    def _of_global(self, value: Any, names: list[str]) -> Iterator[str]:
        """Describe what code calls by a name; of a file of the user, what else the code holds the names of."""
        if not isinstance(value, types.ModuleType) or _is_library(value):
            yield from self.of(value)
            return
        for name in names:
            if name in vars(value):
                yield name
                yield from self._of_global(vars(value)[name], names)

    def _of_code(self, code: types.CodeType) -> Iterator[str]:
        yield code.co_code.hex()
        yield repr((code.co_names, code.co_varnames))
        for part in code.co_consts:
            yield from self._of_code(part) if isinstance(part, types.CodeType) else self.of(part)


# What classes hold that says nothing of what they do.
OF_CLASSES = ("__dict__", "__weakref__", "__doc__", "__module__", "__annotations__", "__abstractmethods__", "_abc_impl")


def _names_in(code: types.CodeType) -> Iterator[str]:
    yield from code.co_names
    for part in code.co_consts:
        if isinstance(part, types.CodeType):
            yield from _names_in(part)


def _name(value: Any) -> str:
    return f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', '')}"


def _is_library(value: Any) -> bool:
    """Whether it comes with Python or was installed: it changes with its version only."""
    module = value if isinstance(value, types.ModuleType) else sys.modules.get(getattr(value, "__module__", "") or "")
    if module is None:
        return False
    file = getattr(module, "__file__", None)
    return file.startswith(LIBRARIES) if file else module.__name__.partition(".")[0] in sys.stdlib_module_names


def _digest(numbers: bytes) -> str:
    return hashlib.sha256(numbers).hexdigest()
