"""How much stack generated code takes at most: what its functions declare, along the deepest chain of calls."""

from __future__ import annotations

import re
from functools import cache

from symgraph.codegen.items import functions_in

FRAME = 320  # bytes of a call besides arrays: single numbers, saved registers, arguments, spills
NUMBER = 16  # bytes of a variable: a compiler that does not optimize keeps it, and another one of its value
_NUMBERS = re.compile(r"\bconst real v\d+\b")
_POINTERS = re.compile(r"\breal \*const [xy]\[\] = \{([^}]*)\}")
_ARRAY = re.compile(r"\b(?:double|int|real|const real \*|real \*)\s*(?:\w+(?:\[[^\]]*\])?, )*\w+\[([A-Z_0-9 +]+)\]")
_MEMBER_ARRAY = re.compile(r"\w+\[([A-Z_0-9 +]+)\]")
_COPY = re.compile(r"\bstruct (\w+) \w+(?:, \w+)*(?: = [^;]*)?;")
_STRUCTURE = re.compile(r"^struct (\w+) \{\n(.*?)^\};", re.MULTILINE | re.DOTALL)
_MACRO = re.compile(r"^#define ([A-Z_]+) (\d+)$", re.MULTILINE)
_WORD = re.compile(r"\b[a-z_]\w*(?=\()")
LIBRARY = 4096  # bytes for the C library's functions


def stack_of(text: str) -> int:
    """Return a bound in bytes, for processors with addresses of 64 bits."""
    macros = {name: int(number) for name, number in _MACRO.findall(text)}
    structures = {name: _members(body, macros) for name, body in _STRUCTURE.findall(text)}
    bodies = functions_in(text)

    def frame(body: str) -> int:
        pointers: int = sum(found.count(",") + 1 for found in _POINTERS.findall(body))
        arrays = sum(8 * _count(length, macros) for length in _ARRAY.findall(body))
        copies = sum(structures.get(name, 0) for name in _COPY.findall(body))
        return FRAME + NUMBER * len(_NUMBERS.findall(body)) + 8 * pointers + arrays + copies

    @cache
    def deepest(name: str) -> int:
        called = {word for word in _WORD.findall(bodies[name]) if word in bodies and word != name}
        below: int = max(map(deepest, called), default=0)
        return frame(bodies[name]) + below

    return LIBRARY + max(map(deepest, bodies), default=0)


def _members(body: str, macros: dict[str, int]) -> int:
    """Return the size of a structure at most: each member as large as a double."""
    arrays = sum(8 * _count(length, macros) for length in _MEMBER_ARRAY.findall(body))
    return arrays + 8 * (body.count(",") + body.count(";"))


def _count(length: str, macros: dict[str, int]) -> int:
    """Return what `N + 1` or `3` comes to."""
    return sum(macros.get(part.strip(), 0) if not part.strip().isdigit() else int(part) for part in length.split("+"))
