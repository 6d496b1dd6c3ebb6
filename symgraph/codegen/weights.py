"""The numbers that models' parameters come to in a generated planner, and the file that holds them.

The file: "SGWEIGHT", then six words of 32 bits, lowest byte first: version 1, bits of a number, count of numbers, the
task's number, the CRC-32 of the numbers, the CRC-32 of all before; then the numbers.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence

from symgraph.codegen.programs import Programs, flattened
from symgraph.slots import Array

MAGIC = b"SGWEIGHT"
VERSION = 1
HEAD = 32  # bytes


def numbers_of(programs: Programs, values: Sequence[Array]) -> Array:
    """Return the numbers that a planner reads: parameters that it reads as they are, then those that follow from them.

    Args:
        programs: what the planner computes.
        values: of the parameters, each flat in column-major order.
    """
    read = [value for value, is_read in zip(values, programs.reads(), strict=True) if is_read]
    return flattened([*read, *programs.derived(values)])


def packed(numbers: Array, precision: str, task: int) -> bytes:
    """Return the contents of a file of weights."""
    kind, bits = ("<f4", 32) if precision == "single" else ("<f8", 64)
    body = numbers.astype(kind).tobytes()
    head = MAGIC + struct.pack("<5I", VERSION, bits, numbers.size, task, zlib.crc32(body))
    return head + struct.pack("<I", zlib.crc32(head)) + body
