"""The library of a generated planner: its files, compiled and loaded, and planners for as many threads as call it."""

from __future__ import annotations

import ctypes
import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from symgraph.codegen.description import FORMAT, Description
from symgraph.codegen.header import STATUSES
from symgraph.compile import toolchain
from symgraph.errors import CompileError, InputError, StorageError
from symgraph.slots import Array

FLAGS = ("-fPIC", "-std=c99", "-O3", "-march=native", "-ffp-contract=off", "-fno-math-errno")
# It calls functions of its own with the upper halves of vector registers in use unless it is told not to, and what they
# call of the C library takes twice as long.
GCC_FLAGS = ("-fno-ipa-ra",)

_CODES = {name: code for name, code, _ in STATUSES}
_MESSAGES = {code: told for _, code, told in STATUSES}
_OF_WEIGHTS = tuple(_CODES[name] for name in ("WEIGHTS_LENGTH", "WEIGHTS_DAMAGED", "WEIGHTS_OTHER"))

# A clock, and a way to end a search from another thread: in C, since both are asked before each evaluation.
_SHIM = """
#include <time.h>
double symgraph_clock(void *user) {
  struct timespec now;
  (void) user;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return (double) now.tv_sec + 1e-9 * (double) now.tv_nsec;
}
int symgraph_progress(void *user, const planner_plan *best) {
  (void) best;
  return *(const volatile int *) user;
}
"""


class Library:
    """A planner that `export_c` wrote, compiled for this machine.

    Raises:
        StorageError: no planner is there, several are, or a file of it is damaged.
        CompileError: there is no C compiler, or it refused.
    """

    def __init__(self, folder: Path, name: str | None = None) -> None:
        self._folder = folder
        self.description = _read(folder, name)
        self._name = self.description.name
        self._code = _compiled(folder, self.description)
        self._weights = self._read_weights()
        self._spare: list[tuple[Array, ctypes.c_void_p]] = []
        with self.planner():  # what is wrong with the weights is told here
            pass

    def call(self, name: str, planner: ctypes.c_void_p, *arguments: Any) -> int:
        """Call a function; return its status, unless something is wrong with what it was given.

        Raises:
            InputError: something is.
        """
        status = int(getattr(self._code, f"{self._name}_{name}")(planner, *arguments))
        if status < _CODES["NO_PLAN"]:
            self._refuse(status)
        return status

    def address(self, name: str) -> ctypes.c_void_p:
        """Return where a function is that the search calls: "clock" or "progress"."""
        return ctypes.cast(getattr(self._code, f"symgraph_{name}"), ctypes.c_void_p)

    @contextmanager
    def planner(self) -> Iterator[ctypes.c_void_p]:
        """Yield a planner that no other thread uses."""
        try:
            memory, planner = self._spare.pop()
        except IndexError:
            memory, planner = np.zeros(-(-self.description.memory // 8)), ctypes.c_void_p()
            weights = [] if self._weights is None else [self._weights[0].ctypes.data, self._weights[1]]
            begin = getattr(self._code, f"{self._name}_begin")
            status = begin(memory.ctypes.data, memory.nbytes, *weights, ctypes.byref(planner))
            if status < 0:
                self._refuse(status)
        try:
            yield planner
        finally:
            self._spare.append((memory, planner))

    def _read_weights(self) -> tuple[Array, int] | None:
        """Return the file of weights, where a double may begin, and its length."""
        if self.description.weights_in != "file":
            return None
        try:
            content = (self._folder / f"{self._name}.weights").read_bytes()
        except OSError as error:
            raise StorageError(f"CPlanner: the weights cannot be read: {error}; export the planner again") from error
        room = np.zeros(-(-len(content) // 8) + 1)
        room.view(np.uint8)[: len(content)] = np.frombuffer(content, np.uint8)
        return room, len(content)

    def _refuse(self, status: int) -> NoReturn:
        told = _MESSAGES[status].replace("PLANNER", self._name.upper()).replace("planner_", f"{self._name}_")
        if status in _OF_WEIGHTS:
            path = self._folder / f"{self._name}.weights"
            raise StorageError(f"CPlanner: {str(path)!r}: {told}; export the planner again")
        raise InputError(f"{self._name}: {told}")


def _read(folder: Path, name: str | None) -> Description:
    try:
        found = sorted(folder.glob("*.json" if name is None else f"{name}.json"))
        described = [json.loads(path.read_text(encoding="utf-8")) for path in found]
        planners = [one for one in described if isinstance(one, dict) and {"format", "task", "writes"} <= set(one)]
    except (OSError, ValueError) as error:
        raise StorageError(f"CPlanner: {str(folder)!r} cannot be read: {error}; export the planner again") from error
    if len(planners) != 1:
        held = (
            f"{len(planners)} planners; say which one by name="
            if planners
            else "no planner; give a folder of export_c's"
        )
        raise StorageError(f"CPlanner: {str(folder)!r} holds {held}")
    if planners[0]["format"] != FORMAT:
        raise StorageError(f"CPlanner: {str(folder)!r} was written by another version of symgraph; export it again")
    try:
        return Description.from_dict(planners[0])
    except (TypeError, KeyError, AttributeError) as error:
        raise StorageError(
            f"CPlanner: the description in {str(folder)!r} is damaged: {error}; export it again"
        ) from error


def _compiled(folder: Path, description: Description) -> Any:
    compiler = toolchain.find_compiler()
    if compiler is None:
        raise CompileError("CPlanner needs a C compiler: install one, e.g.  apt install gcc, or set CC")
    name = description.name
    try:
        header, source = ((folder / f"{name}{end}").read_text(encoding="utf-8") for end in (".h", ".c"))
    except OSError as error:
        raise StorageError(f"CPlanner: {error}; export the planner again") from error
    text = "#define _POSIX_C_SOURCE 199309L\n" + source.replace(f'#include "{name}.h"', header)
    text += _SHIM.replace("planner_plan", f"{name}_plan")
    key = hashlib.sha256(text.encode()).hexdigest()
    code: Any = toolchain.load(key, lambda: [text], compiler, FLAGS + GCC_FLAGS * toolchain.is_gcc(compiler))
    pointer: Any = ctypes.c_void_p
    weights = [pointer, ctypes.c_size_t] if description.weights_in == "file" else []
    getattr(code, f"{name}_begin").argtypes = [pointer, ctypes.c_size_t, *weights, pointer]
    getattr(code, f"{name}_solve").argtypes = [pointer] * 4
    getattr(code, f"{name}_value").argtypes = [pointer] * 5
    getattr(code, f"{name}_gradient").argtypes = [pointer] * 6
    getattr(code, f"{name}_foresee").argtypes = [pointer] * 5
    if description.demands:
        getattr(code, f"{name}_violation").argtypes = [pointer] * 5
    return code
