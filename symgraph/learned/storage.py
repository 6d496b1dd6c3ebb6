"""Storage: arrays and what is said about them in one file, which is checked to the last byte before it is believed.

The file is a safetensors file, so that other programs can read the weights, with a JSON document under one key of its
metadata. Nothing in it is ever executed. It is read in the order of trust: the lengths against the file's size, the
table of tensors against what the document calls for, and only then the numbers, whose digest finds what was damaged.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import secrets
import stat
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from symgraph.errors import InputError, MissingExtraError, StorageError, names

FORMAT = "symgraph"  # and the metadata's key
VERSION = 1
MOST_HEADER = 1 << 20  # [bytes]; a network's takes a few thousand
MOST_BYTES = 1 << 31  # [bytes]; a network of 3 × 200 units takes five million
MOST_SHOWN = 400  # characters of a message; a hostile file decides what would stand there
REMEDY = "take another copy of the file, or fit the model anew and save it"

Arrays = dict[str, npt.NDArray[Any]]
Document = dict[str, Any]
Shape = tuple[int, ...]
Specs = dict[str, tuple[str, Shape]]  # {tensor: (one of DTYPES, shape)}

DTYPES: dict[str, np.dtype[Any]] = {"F64": np.dtype(np.float64), "F32": np.dtype(np.float32), "U8": np.dtype(np.uint8)}


def write(path: str | os.PathLike[str], kind: str, document: Mapping[str, Any], arrays: Mapping[str, Any]) -> None:
    """Write a file, or replace one: whatever interrupts it, the old file stays whole.

    What kills the process may leave a .symgraph-….part beside it, which nobody needs.

    Args:
        path: of the file.
        kind: of the model.
        document: what JSON can hold.
        arrays: of the types in `DTYPES`.

    Raises:
        StorageError: the file cannot be written, or not be read again: names that no text can hold, too large.
        MissingExtraError: safetensors is not installed.
    """
    safetensors = _import_safetensors()
    target = checked_path(path)
    tensors = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    head = {"format": FORMAT, "version": VERSION, "kind": kind}
    text = json.dumps({**head, "digest": _digest(document, tensors), **document}, ensure_ascii=False)
    try:
        text.encode()
    except UnicodeEncodeError as error:
        raise StorageError(f"{target}: a name or label holds {error.object[error.start]!r}; leave it out") from None
    data = safetensors.numpy.save(tensors, {FORMAT: text})
    if int.from_bytes(data[:8], "little") > MOST_HEADER or len(data) > MOST_BYTES:
        raise StorageError(
            f"{target}: {len(text)} characters of labels and {len(data)} bytes are more than such a file may hold "
            f"({MOST_HEADER} and {MOST_BYTES}); take shorter labels or fewer units"
        )
    replace_file(target, lambda file: file.write(data))


def replace_file(path: str | os.PathLike[str], fill: Callable[[BinaryIO], object]) -> None:
    """Put a file in the place of another, or of none, once all that `fill` writes is on the disk.

    Raises:
        StorageError: the file cannot be written.
    """
    target = Path(os.path.realpath(checked_path(path)))  # a link stays a link
    part = target.with_name(f".symgraph-{secrets.token_hex(8)}.part")
    try:
        try:
            with part.open("xb") as file:
                fill(file)
                file.flush()
                os.fsync(file.fileno())  # the name must not be there before the bytes are
            part.replace(target)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
    except OSError as error:
        raise StorageError(
            f"{target} cannot be written: {error.strerror or error}; give the path of a file in a folder that is there "
            "and may be written to"
        ) from None


def read(path: str | os.PathLike[str], kind: str, expected: Callable[[Document], Specs]) -> tuple[Document, Arrays]:
    """Return the document and the arrays of a file.

    Args:
        path: of the file.
        kind: of the model that it must hold.
        expected: the tensors that the document calls for; raises InputError where it makes no sense.

    Raises:
        StorageError: the file cannot be read, is damaged, or holds something else.
        MissingExtraError: safetensors is not installed.
    """
    safetensors = _import_safetensors()
    path = checked_path(path)
    try:
        # Opening a pipe would wait for its other end, and a device may have no end.
        if not stat.S_ISREG(path.stat().st_mode):
            raise StorageError(f"{path} is not a file; give the path that `save` was given")
        with path.open("rb") as file:
            data, document = _checked(path, file, kind, expected)
    except OSError as error:
        if isinstance(error, StorageError):
            raise
        raise StorageError(
            f"{path} cannot be read: {error.strerror}; give the path of a file that may be read"
        ) from None
    except MemoryError:
        raise StorageError(f"{path}: too large for this machine's memory") from None
    try:
        arrays = safetensors.numpy.load(data)
    except safetensors.SafetensorError as error:
        raise damaged(path, str(error)) from None
    if document.pop("digest", None) != _digest(document, arrays):
        raise damaged(path, "its contents do not have the digest that they were saved with")
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise damaged(path, f"tensor {name!r} holds numbers that are not finite")
    return document, arrays


def _checked(path: Path, file: BinaryIO, kind: str, expected: Callable[[Document], Specs]) -> tuple[bytes, Document]:
    """Return a file's bytes and its document; nothing large is read before all lengths agree."""
    size = os.fstat(file.fileno()).st_size
    if size > MOST_BYTES:
        raise damaged(path, f"it has {size} bytes, more than the {MOST_BYTES} of any model")
    start = file.read(8)
    header_size = int.from_bytes(start, "little")
    if len(start) < 8 or header_size > size - 8:
        raise damaged(path, "it is no safetensors file, or one that was cut off")
    if header_size > MOST_HEADER:
        raise damaged(path, f"its header has {header_size} bytes, more than the {MOST_HEADER} of any model")
    header = file.read(header_size)
    try:
        table, document = _parsed(path, header, kind)
        _check_table(table, expected(document), size - 8 - header_size)
    except (InputError, RecursionError) as error:  # nested a thousand deep
        raise damaged(path, str(error)) from None
    data = start + header + file.read(size - 8 - header_size)
    if len(data) != size:
        raise damaged(path, "it became shorter while it was read")
    return data, document


def _parsed(path: Path, header: bytes, kind: str) -> tuple[Document, Document]:
    """Return the table of tensors and the document."""
    table = _json(header, "its header")
    metadata = table.pop("__metadata__", None)
    text = metadata.get(FORMAT) if isinstance(metadata, dict) else None
    if not isinstance(text, str):
        raise StorageError(f"{path} is a safetensors file, but none of symgraph's; give the path that `save` was given")
    document = _json(text.encode(), f"what {FORMAT!r} in its metadata says")
    version, held = document.pop("version", None), document.pop("kind", None)
    if document.pop("format", None) != FORMAT or type(version) is not int or version < 1:
        raise InputError(f"what {FORMAT!r} in its metadata says names no format and version")
    if version > VERSION:
        raise StorageError(
            _short(f"{path} has version {version} of the format, this symgraph knows {VERSION}; upgrade it")
        )
    if held != kind:
        raise StorageError(_short(f"{path} holds a {held!r}, not a {kind}; load it with the class of that name"))
    return table, document


def _json(text: bytes, what: str) -> Document:
    """Return a JSON object without repeated keys."""

    def unique(pairs: list[tuple[str, Any]]) -> Document:
        found = dict(pairs)
        if len(found) < len(pairs):
            raise ValueError("a name stands in it twice")
        return found

    def refuse(constant: str) -> None:
        raise ValueError(f"it holds {constant}")

    try:
        value = json.loads(text.decode(), object_pairs_hook=unique, parse_constant=refuse)
        json.dumps(value, ensure_ascii=False).encode()  # an escape can make what is no character
    except ValueError as error:
        raise InputError(f"{what} is no JSON: {error}") from None
    if not isinstance(value, dict):
        raise InputError(f"{what} is no JSON object")
    return value


def _check_table(table: Document, specs: Specs, size: int) -> None:
    """Raise InputError unless the tensors are those expected and fill the file's `size` bytes without gaps."""
    missing, extra = [name for name in specs if name not in table], [name for name in table if name not in specs]
    if missing or extra:
        raise InputError(f"it lacks the tensors {names(missing)} and has too many: {names(extra)}")
    spans = []
    for name, (dtype, shape) in specs.items():
        entry = table[name]
        if not isinstance(entry, dict):
            raise InputError(f"tensor {name!r} is described by {entry!r}")
        found = entry.get("dtype"), entry.get("shape")
        if found != (dtype, list(shape)):
            raise InputError(f"tensor {name!r} is {found[0]} of shape {found[1]}, not {dtype} of shape {list(shape)}")
        span = entry.get("data_offsets")
        if not isinstance(span, list) or [type(at) for at in span] != [int, int]:
            raise InputError(f"tensor {name!r} lies at {span!r}")
        if span[1] - span[0] != math.prod(shape) * DTYPES[dtype].itemsize:
            raise InputError(f"tensor {name!r} of shape {list(shape)} has not as many bytes as that takes")
        spans.append(span)
    end = 0
    for span in sorted(spans):
        if span[0] != end:
            raise InputError("its tensors overlap or leave gaps")
        end = span[1]
    if end != size:
        raise InputError(f"it has {size} bytes of numbers, its header promises {end}: it was cut off or added to")


def _digest(document: Mapping[str, Any], arrays: Mapping[str, npt.NDArray[Any]]) -> str:
    """Return a digest of all that a file says but its format, version and kind."""
    state = hashlib.blake2b(json.dumps(document).encode(), digest_size=16)
    for name, array in sorted(arrays.items()):
        state.update(f"{name} {array.dtype} {array.shape}".encode())
        state.update(array.tobytes())
    return state.hexdigest()


def checked_path(path: Any) -> Path:
    """Return a path; raise StorageError where it is none."""
    try:
        name = os.fspath(path)
        if isinstance(name, str) and os.fsencode(name) and "\0" not in name:
            return Path(name)
    except (TypeError, UnicodeEncodeError):
        pass
    raise StorageError(f"path = {path!r} is no path of a file")


def damaged(path: str | os.PathLike[str], what: str) -> StorageError:
    """Return the error of a file that says what cannot be."""
    damage = f"{path}: {_short(what)}"
    error = StorageError(f"{damage}; {REMEDY}")
    error.damage = damage
    return error


def _short(text: str) -> str:
    return text if len(text) <= MOST_SHOWN else f"{text[:MOST_SHOWN]} …"


def _import_safetensors() -> Any:
    try:
        import safetensors.numpy
    except ImportError as error:
        raise MissingExtraError("safetensors", "learned", "saving and loading a network") from error
    return safetensors
