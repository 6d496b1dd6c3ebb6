"""place: where the boxes, arrows and labels of a picture go; Graphviz finds it, from sizes alone.

A label is a box in the middle of its arrow, so that no other arrow, label or box comes near it. Arrows of one
group leave their box at one place, those of its other groups side by side with them.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

Point = tuple[float, float]  # x to the right, y down [px]
Size = tuple[int, int]  # width, height [px]

PAGE = 1000  # [px] what is wider does not fit a notebook


class Arrow(NamedTuple):
    """An arrow from one box to another, by their numbers."""

    tail: int
    head: int
    group: int  # of the arrows that leave the tail at the same place
    label: Size | None


class Box(NamedTuple):
    """A box where it was placed [px]."""

    x: float  # centre
    y: float
    width: float  # at least as large as wanted
    height: float


class Curve(NamedTuple):
    """A piece of an arrow."""

    points: list[Point]  # of a cubic Bézier spline, from tail to head
    tip: Point | None  # of the arrow's head, beyond the last point; None on the piece before a label


@dataclass
class Layout:
    """A picture's size [px], and by number its boxes, its arrows and the centres of their labels."""

    width: float
    height: float
    boxes: dict[int, Box] = field(default_factory=dict)
    arrows: dict[int, list[Curve]] = field(default_factory=dict)  # tail to label, label to head
    labels: dict[int, Point] = field(default_factory=dict)


def place(boxes: Sequence[Size], arrows: Sequence[Arrow]) -> Layout:
    """Place boxes in ranks along their arrows, from top to bottom.

    A page scrolls downwards, so what is too wide for it runs from left to right if that is narrower.

    Args:
        boxes: their sizes; where arrows form loops, these are cut open as seen from the first box.
        arrows: may form loops, lead from a box to itself, or run side by side.

    Returns:
        the layout, the same for the same input.
    """
    layout = _read(_dot(boxes, arrows, down=True))
    if layout.width <= PAGE:
        return layout
    return min(layout, _read(_dot(boxes, arrows, down=False)), key=lambda layout: layout.width)


def _read(dot: str) -> Layout:
    import pygraphviz

    # What it says on sys.stderr, that more than 1000 boxes may take long, does not hold for trees.
    with contextlib.redirect_stderr(io.StringIO()):
        placed = json.loads(pygraphviz.AGraph(string=dot).draw(format="json0", prog="dot"))
    _, _, width, height = map(float, placed["bb"].split(","))
    layout = Layout(width, height)

    def point(text: str) -> Point:
        x, y = map(float, text.split(","))
        return x, height - y  # Graphviz's y points up

    for box in placed.get("objects", ()):
        if box["is"] == "label":
            layout.labels[int(box["number"])] = point(box["pos"])
        else:
            size = 72 * float(box["width"]), 72 * float(box["height"])
            layout.boxes[int(box["number"])] = Box(*point(box["pos"]), *size)
    for piece in sorted(placed.get("edges", ()), key=lambda piece: int(piece["part"])):
        words = piece["pos"].split()
        points = [point(word) for word in words if word[0] not in "se"]
        tips = [point(word[2:]) for word in words if word[0] in "se"]
        if piece["dir"] == "back":
            points.reverse()
        layout.arrows.setdefault(int(piece["number"]), []).append(Curve(points, tips[0] if tips else None))
        if "lp" in piece:
            layout.labels[int(piece["number"])] = point(piece["lp"])
    return layout


def _dot(boxes: Sequence[Size], arrows: Sequence[Arrow], down: bool) -> str:
    """Return what is to be placed in Graphviz's language, for which a pixel is 1/72 inch."""
    entry, leave = ("n", "s") if down else ("w", "e")
    upward = _upward(len(boxes), arrows)
    # What meets a box at its lower side: each group at one place, apart from the arrows that close loops.
    exits: list[list[int | None]] = [[] for _ in boxes]
    for i, arrow in enumerate(arrows):
        box, place = (arrow.head, None) if i in upward else (arrow.tail, arrow.group)
        if arrow.tail != arrow.head and place not in exits[box]:
            exits[box].append(place)
    tree = len({arrow.head for arrow in arrows}) == len(arrows) == len(boxes) - 1

    lines = [
        f"digraph {{ rankdir={'TB' if down else 'LR'}; nodesep={0.3 if down else 0.15}; ranksep=0.3;",
        "ordering=out;" if tree else "",  # branches as declared; elsewhere so that few arrows cross
        'node [shape=box, label="", margin=0, is=box]; edge [arrowsize=0.75, part=0, dir=forward];',
    ]
    for i, size in enumerate(boxes):
        lines.append(f"box{i} [number={i}, {_shape(size, len(exits[i]), down)}];")
    for i, arrow in enumerate(arrows):
        tail, head, label = f"box{arrow.tail}", f"box{arrow.head}", f"label{i}"
        if arrow.tail == arrow.head:
            lines.append(f"{tail} -> {head} [number={i}, label={_table([arrow.label or (0, 0)], down)}];")
            continue
        # An arrow that closes a loop goes against the ranks: it is laid out as if it ran the other way.
        if i in upward:
            first, last, way = _port(head, exits[arrow.head], None, leave), tail, "dir=back"
        else:
            first, last, way = _port(tail, exits[arrow.tail], arrow.group, leave), head, "dir=forward"
            last += f":{entry}" if tree else ""
        if arrow.label is None:
            lines.append(f"{first} -> {last} [number={i}, {way}];")
        else:
            pieces = ["part=0, arrowhead=none, arrowtail=none", "part=1"]
            if i in upward:
                pieces.reverse()
            lines.append(f"{label} [number={i}, is=label, {_shape(arrow.label, 0, down)}];")
            lines.append(f"{first} -> {label}:{entry} [number={i}, {way}, {pieces[0]}];")
            lines.append(f"{label}:{leave} -> {last} [number={i}, {way}, {pieces[1]}];")
    return "\n".join([*lines, "}"])


def _port(box: str, exits: list[int | None], place: int | None, side: str) -> str:
    return f"{box}:exit{exits.index(place)}:{side}" if len(exits) > 1 else f"{box}:{side}"


def _shape(size: Size, exits: int, down: bool) -> str:
    """Return a box's attributes; with two exits or more it is a table, whose cells arrows can start at."""
    width, height = size
    if exits < 2:
        return f"width={width / 72:.5f}, height={height / 72:.5f}"
    cell = (math.ceil(width / exits), height) if down else (width, math.ceil(height / exits))
    return f"shape=plain, label={_table([cell] * exits, down)}"


def _table(cells: Sequence[Size], across: bool) -> str:
    """Return blank cells, side by side or on top of each other."""
    drawn = [
        f'<TD PORT="exit{i}" FIXEDSIZE="TRUE" WIDTH="{width}" HEIGHT="{height}"></TD>'
        for i, (width, height) in enumerate(cells)
    ]
    rows = "".join(drawn) if across else "</TR><TR>".join(drawn)
    return f'<<TABLE BORDER="0" CELLBORDER="0" CELLSPACING="0" CELLPADDING="0"><TR>{rows}</TR></TABLE>>'


def _upward(boxes: int, arrows: Sequence[Arrow]) -> set[int]:
    """Return the arrows that close a loop of several boxes, as a depth-first search meets them."""
    leaving: list[list[int]] = [[] for _ in range(boxes)]
    for i, arrow in enumerate(arrows):
        if arrow.tail != arrow.head:
            leaving[arrow.tail].append(i)
    seen, on_path, upward = [False] * boxes, [False] * boxes, set()
    for root in range(boxes):
        if seen[root]:
            continue
        seen[root] = on_path[root] = True
        path = [(root, iter(leaving[root]))]
        while path:
            box, rest = path[-1]
            for i in rest:
                head = arrows[i].head
                if on_path[head]:
                    upward.add(i)
                elif not seen[head]:
                    seen[head] = on_path[head] = True
                    path.append((head, iter(leaving[head])))
                    break
            else:
                path.pop()
                on_path[box] = False
    return upward
