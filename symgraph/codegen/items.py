"""C text as items: what is not used is left out, so that strict compilers have nothing to say."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

_CONDITION = re.compile(r"^#(if|elif|else|endif|ifdef)\b *(!?)(\w*)")
_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
_STRING = re.compile(r'"(?:\\.|[^"\\])*"')
_MADE_BY_MACRO = re.compile(r"^[A-Z_]+\((\w+), \w+\)")
_DEFINED = re.compile(r"^static [^;={]*?(\w+)(?:\(|(?:\[\w*\])* =)", re.DOTALL)
_WORD = re.compile(r"\b[A-Za-z_]\w*\b")


def resolved(text: str, flags: Mapping[str, bool]) -> str:
    """Return C text without the lines that `#if FLAG`, `#if !FLAG`, `#elif FLAG` and `#else` leave out.

    Conditions on other names stay as they are.
    """
    kept: list[str] = []
    stack: list[list[bool] | None] = []  # of each open condition whether it holds now, and has held; None: it stays
    for line in text.splitlines():
        match = _CONDITION.match(line)
        if match and (own := _step(match, flags, stack)):
            continue
        if match and not own and match[1] == "endif":
            stack.pop()
        if all(state is None or state[0] for state in stack):
            kept.append(line)
        if match and match[1] in ("if", "ifdef") and not own:
            stack.append(None)
    return "\n".join(kept) + "\n"


def _step(match: re.Match[str], flags: Mapping[str, bool], stack: list[list[bool] | None]) -> bool:
    """Take in a line with a condition; return whether it is one on a flag."""
    word, negated, name = match.groups()
    if word == "if" and name in flags:
        holds = flags[name] != bool(negated)
        stack.append([holds, holds])
        return True
    if word in ("if", "ifdef") or not stack or stack[-1] is None:
        return False
    state = stack[-1]
    if word == "endif":
        stack.pop()
    elif word == "else":
        stack[-1] = [not state[1], True]
    else:
        holds = not state[1] and flags[name] != bool(negated)
        stack[-1] = [holds, state[1] or holds]
    return True


def trimmed(text: str) -> str:
    """Return C text without static functions and constants that nothing calls or reads."""
    items = list(_items(text))
    names = [_name(item) for item in items]
    words = [set(_WORD.findall(_STRING.sub("", _COMMENT.sub("", item)))) for item in items]
    by_name: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        if name:
            by_name.setdefault(name, []).append(i)
    kept = {i for i, name in enumerate(names) if not name}
    waiting = list(kept)
    while waiting:
        for word in words[waiting.pop()]:
            for i in by_name.get(word, ()):
                if i not in kept:
                    kept.add(i)
                    waiting.append(i)
    return "".join(item for i, item in enumerate(items) if i in kept)


def _name(item: str) -> str | None:
    """Return the name of a static function, constant or short macro, None of what always stays."""
    code = _COMMENT.sub("", item).strip()
    macro = re.match(r"#define (\w+)", code)
    if macro:
        return macro[1]
    match = _MADE_BY_MACRO.match(code) or _DEFINED.match(code)
    return match[1] if match else None


def _items(text: str) -> Iterator[str]:
    """Split text at the ends of definitions and directives outside braces; comments stand with what follows them."""
    depth = 0
    item: list[str] = []
    comment = directive = False
    for line in text.splitlines(keepends=True):
        item.append(line)
        bare = _COMMENT.sub("", line)
        if comment or ("/*" in bare and "*/" not in bare):
            comment = "*/" not in line
            continue
        bare = bare.rstrip()
        if directive or (depth == 0 and bare.startswith("#")):
            directive = bare.endswith("\\")
            if not directive:
                yield "".join(item)
                item = []
            continue
        depth += bare.count("{") + bare.count("(") - bare.count("}") - bare.count(")")
        ends = bare.endswith((";", "}")) or (_MADE_BY_MACRO.match(bare) is not None)
        if depth == 0 and ends:
            yield "".join(item)
            item = []
    if item:
        yield "".join(item)


def functions_in(text: str) -> dict[str, str]:
    """Return {name: body} of the functions that C text defines."""
    found = {}
    for item in _items(text):
        code = _COMMENT.sub("", item).strip()
        match = re.match(r"(?:static )?(?:inline )?[\w *]*?(\w+)\([^;]*?\)\s*\{(.*)\}\s*$", code, re.DOTALL)
        if match:
            found[match[1]] = match[2]
    return found
