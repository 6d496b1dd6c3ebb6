"""What is drawn at random, out of uniform numbers alone: a generated planner repeats it from the same seed."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from symgraph.slots import Array


def generator(seed: int) -> np.random.Generator:
    """Return a source of random numbers: Doty-Humphrey's SFC64, few lines of C too."""
    return np.random.Generator(np.random.SFC64(seed))


def below(rng: np.random.Generator, count: int) -> int:
    """Draw a whole number in [0, count)."""
    return int(rng.random() * count)


def normal(rng: np.random.Generator, count: int) -> Array:
    """Draw standard normal numbers (count,), each from two uniform ones (Box & Muller 1958)."""
    unit = rng.random((count, 2))
    return np.asarray(np.sqrt(-2.0 * np.log1p(-unit[:, 0])) * np.cos(2.0 * np.pi * unit[:, 1]))


def latin_hypercubes(rng: np.random.Generator, blocks: int, count: int, n: int) -> Array:
    """Draw points (blocks, count, n) in [0, 1), each block a Latin hypercube (McKay, Beckman & Conover 1979)."""
    unit = rng.random((blocks, 2, count, n))
    order = np.argsort(unit[:, 1], axis=1, kind="stable")  # random keys in order: a random permutation
    return np.asarray((order + unit[:, 0]) / count)


def distinct(rng: np.random.Generator, total: int, count: int) -> npt.NDArray[np.int64]:
    """Draw different whole numbers (count,) in [0, total) (Floyd's method: Bentley & Floyd 1987)."""
    found: dict[int, None] = {}
    for last, unit in zip(range(total - count, total), rng.random(count), strict=True):
        number = int(unit * (last + 1))
        found[last if number in found else number] = None
    return np.array(list(found), dtype=np.int64)
