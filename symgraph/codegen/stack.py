"""How much stack generated code takes at most: what its functions declare, along the deepest chain of calls."""

from __future__ import annotations

import re
from functools import cache

from symgraph.codegen.items import functions_in

FRAME = 192  # bytes of a call besides what it declares: saved registers, arguments, spills of address arithmetic
NUMBER = 16  # bytes of a variable: a compiler that does not optimize keeps it, and another one of its value
_NUMBERS = re.compile(r"\bconst real v\d+\b")
_POINTERS = re.compile(r"\breal \*const [xy]\[\] = \{([^}]*)\}")
_WORD = re.compile(r"\b[a-z_]\w*(?=\()")
LIBRARY = 4096  # bytes for the C library's functions


def stack_of(text: str, own: int) -> int:
    """Return a bound in bytes.

    Args:
        text: C source.
        own: bytes that a function written by hand declares at most.
    """
    bodies = functions_in(text)

    def frame(name: str) -> int:
        body = bodies[name]
        pointers = sum(found.count(",") + 1 for found in _POINTERS.findall(body))
        declared = NUMBER * len(_NUMBERS.findall(body)) + 8 * pointers
        return FRAME + (declared if re.fullmatch(r"f\d+(_\d+)?", name) else own)

    @cache
    def deepest(name: str) -> int:
        called = {word for word in _WORD.findall(bodies[name]) if word in bodies and word != name}
        return frame(name) + max(map(deepest, called), default=0)

    return LIBRARY + max(map(deepest, bodies), default=0)
