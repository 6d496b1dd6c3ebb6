"""Long sources in several translation units: compilers take them side by side, and none takes gigabytes of memory."""

from __future__ import annotations

import re
from collections.abc import Sequence

LONGEST = 20_000  # lines of a unit

_HIDDEN = '__attribute__((visibility("hidden"))) '
_NAME = re.compile(r"\b(?:f\d+(?:_\d+)?|t\d+)\b")  # of a function or table
_TABLE = re.compile(r"static (const \w+ (t\d+)\[\]) = ")
_FUNCTION = re.compile(r"static (void (f\w+)\(.*\)) \{")


def in_units(head: str, pieces: Sequence[str], tail: str) -> list[str]:
    """Put pieces of C together.

    Args:
        head: what every unit begins with.
        pieces: functions and tables, each beginning with `static`, in an order in which they may stand.
        tail: what the last unit ends with.
    """
    groups: list[list[str]] = [[]]
    lines = 0
    for piece in pieces:
        if lines > LONGEST:
            groups.append([])
            lines = 0
        groups[-1].append(piece)
        lines += piece.count("\n") + 1
    if len(groups) == 1:
        return ["\n".join([head, *pieces, tail])]
    declared = dict(map(_declaration, pieces))
    units = []
    for i, group in enumerate(groups):
        text = "\n".join([*group, tail if i == len(groups) - 1 else ""])
        made = {_declaration(piece)[0] for piece in group}
        used = dict.fromkeys(name for name in _NAME.findall(text) if name in declared and name not in made)
        text = re.sub(r"^static (?=(?:void f\d|const \w+ t\d))", _HIDDEN, text, flags=re.MULTILINE)
        units.append("\n".join([head, *(declared[name] for name in used), text]))
    return units


def _declaration(piece: str) -> tuple[str, str]:
    """Return the name of what a piece defines, and what declares it."""
    table = _TABLE.match(piece)
    if table:
        return table[2], f"extern {_HIDDEN}{table[1]};"
    function = _FUNCTION.match(piece)
    if not function:
        raise AssertionError(piece[:80])
    return function[2], f"{_HIDDEN}{function[1]};"
