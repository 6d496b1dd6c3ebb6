"""C source to a shared library in the user's cache: compiled once per source, compiler, flags and processor."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import stat
import subprocess
import tempfile
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import platformdirs

from symgraph.errors import CompileError

# What -O2 does for generated code in less time: the short functions inlined; and, as one of the "expensive"
# optimizations, the upper halves of vector registers cleared before the C library is called, whose scalar functions
# take ten times as long on many processors where they are not.
_OPTIMIZATIONS = (
    "-O1",
    "-fexpensive-optimizations",
    "-ftree-vectorize",
    "-finline-small-functions",
    "-fno-semantic-interposition",
)
# Strict IEEE arithmetic: NaN and infinity must survive to be noticed. errno and floating-point traps are what C has
# to keep up for nobody here.
_ARITHMETIC = "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast"
FLAGS = ("-fPIC", "-std=c99", "-march=native", *_OPTIMIZATIONS, *_ARITHMETIC)
VECTOR_LIBRARY = 2, 35  # of glibc, from which on libmvec has all that lanes.c calls


@cache
def find_compiler() -> str | None:
    """Return the path of the C compiler (CC, cc, gcc or clang), or None after one warning."""
    wanted = os.environ.get("CC", "")
    for name in (wanted, "cc", "gcc", "clang"):
        path = shutil.which(name) if name else None
        if path:
            if wanted not in ("", name):
                text = f"CC={wanted} is no program on the PATH (options are not possible): {path} is used"
                warnings.warn(text, stacklevel=2)
            return path
    warnings.warn(
        "no C compiler found (CC, cc, gcc, clang): plans are computed in CasADi's interpreter, several times slower; "
        "install one, e.g.  apt install gcc  or  xcode-select --install",
        stacklevel=2,
    )
    return None


def load(key: str, source: Callable[[], list[str]], compiler: str, flags: tuple[str, ...] | None = None) -> ctypes.CDLL:
    """Compile C source, or find it compiled, and load it.

    Args:
        key: what the source follows from.
        source: makes it, one translation unit or several, where it is not found compiled.
        compiler: the path of the compiler.
        flags: for it, those of kernels if left out.

    Raises:
        CompileError: the compiler, the disk or the loader refused.
    """
    try:
        folder = private_folder("kernels")
        flags = FLAGS if flags is None else flags
        joined = "\0".join([key, *_identity(compiler), *flags, *vector_library()[0]])
        key = hashlib.sha256(joined.encode()).hexdigest()[:32]
        for path in folder.glob(f"{key}-*.so"):
            if path.name == _name(key, path):
                return ctypes.CDLL(str(path))
            path.unlink(missing_ok=True)  # cut short by a crash or a full disk: make it anew
        return ctypes.CDLL(str(_compile(source(), compiler, folder, key, flags)))
    except OSError as error:
        raise CompileError(f"compiling with {compiler} failed: {error}") from error


@cache
def vector_library() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return macros and libraries for the C library's functions of vectors, where it has them."""
    name, version = platform.libc_ver()
    numbers = tuple(int(part) for part in version.split(".") if part.isdigit())
    if name == "glibc" and numbers >= VECTOR_LIBRARY and platform.machine() in ("x86_64", "AMD64"):
        return ("-DLIBMVEC",), ("-lmvec", "-lm")
    return (), ("-lm",)


def _compile(units: list[str], compiler: str, cache_folder: Path, key: str, flags: tuple[str, ...]) -> Path:
    # Compiled in a folder of its own and moved into place at once, so that processes may race for it.
    with tempfile.TemporaryDirectory(dir=cache_folder) as folder, ThreadPoolExecutor(os.cpu_count()) as pool:
        made = Path(folder, "kernel.so")
        macros, libraries = vector_library()

        def compiled(i: int) -> str:
            source, result = Path(folder, f"unit{i}.c"), Path(folder, f"unit{i}.o")
            source.write_text(units[i])
            _run([compiler, "-c", *flags, *macros, str(source), "-o", str(result)])
            return str(result)

        objects = list(pool.map(compiled, range(len(units))))
        _run([compiler, "-shared", *objects, "-o", str(made), *libraries])
        ctypes.CDLL(str(made))  # what cannot be loaded must not stay in the cache
        return made.replace(cache_folder / _name(key, made))


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise CompileError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")


def _name(key: str, path: Path) -> str:
    """Name a library by its content too: loading one that a crash or a full disk damaged can kill the process."""
    return f"{key}-{hashlib.sha256(path.read_bytes()).hexdigest()[:16]}.so"


def private_folder(name: str) -> Path:
    """Return a folder of the user's cache if nobody else can write to it, else a new one for this process."""
    folder = Path(platformdirs.user_cache_dir("symgraph")) / name
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        info = folder.stat()
        ours = not hasattr(os, "getuid") or info.st_uid == os.getuid()
        if ours and not info.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and os.access(folder, os.W_OK):
            return folder
    except OSError:
        pass
    return _process_folder()


def _process_folder() -> Path:
    return Path(_temporary().name)


@cache
def _temporary() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="symgraph-")  # goes when the process ends


def is_gcc(compiler: str) -> bool:
    """Whether a compiler is GNU's, or says that it is none other."""
    return "clang" not in _identity(compiler)[1].lower()


@cache
def _identity(compiler: str) -> tuple[str, ...]:
    """What besides the source decides whether a library runs here: -march=native code crashes on another processor."""
    version = subprocess.run([compiler, "--version"], capture_output=True, text=True, check=False).stdout
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = "\n".join(sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))}))
    except OSError:
        processor = platform.processor()
    return compiler, version, platform.machine(), processor
