"""place: where the boxes, arrows and labels of a picture go; Graphviz finds it, from sizes alone.

A label is a box in the middle of its arrow, so that no other arrow, label or box comes near it. Arrows of one
group leave their box at one place, those of its other groups side by side with them.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

Point = tuple[float, float]  # x to the right, y down [px]
Size = tuple[int, int]  # width, height [px]

PAGE = 1000  # [px] what is wider does not fit a notebook
HEAD = 7.5  # [px] length of an arrow's head
REACH = 22  # [px] of an arrow from a box to itself


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
    rightward = _placed(boxes, arrows, down=False)
    enough = max(PAGE, rightward.width)
    ranks: dict[float, float] = {}  # how wide they are, at least, when they run downwards
    for i, (width, _) in enumerate(boxes):
        rank = rightward.boxes[i].x
        ranks[rank] = ranks.get(rank, 0.0) + width
    if max(ranks.values(), default=0.0) > enough:
        return rightward
    downward = _placed(boxes, arrows, down=True)
    return downward if downward.width <= enough else rightward


def _placed(boxes: Sequence[Size], arrows: Sequence[Arrow], down: bool) -> Layout:
    loops: dict[int, dict[int, Size]] = {}  # box → its arrows to itself → their labels
    for i, arrow in enumerate(arrows):
        if arrow.tail == arrow.head:
            loops.setdefault(arrow.tail, {})[i] = arrow.label or (0, 0)
    upward = _upward(len(boxes), arrows)
    forest = not loops and not upward and len({arrow.head for arrow in arrows}) == len(arrows)
    layout = _read(_dot(boxes, arrows, loops, upward, forest, down))
    for box, labels in loops.items():
        _add_loops(layout, layout.boxes[box], labels, down)
    if forest:
        _bend_between_ranks(layout, arrows, down)
    return layout


def _pitch(labels: Iterable[Size], down: bool) -> int:
    """Return the way from one loop to the next, along the side of their box [px]."""
    return max(height if down else width + 6 for width, height in [(12, 16), *labels])


def _add_loops(layout: Layout, box: Box, labels: Mapping[int, Size], down: bool) -> None:
    """Add a box's arrows to itself, one beside the other: Graphviz draws them into each other."""

    def point(out: float, along: float) -> Point:
        if down:
            return box.x + box.width / 2 + out, box.y + along
        return box.x + along, box.y - box.height / 2 - out

    pitch = _pitch(labels.values(), down)
    for i, (number, (width, height)) in enumerate(labels.items()):
        along = (i - (len(labels) - 1) / 2) * pitch
        leave, arrive = point(0, along - 4), point(6.5, along + 4)
        points = [leave, point(REACH, along - 8), point(REACH, along + 8), arrive]
        layout.arrows[number] = [Curve(points, point(0, along + 2))]
        if height:
            layout.labels[number] = point(0.75 * REACH + 2 + (width if down else height) / 2, along)


def _bend_between_ranks(layout: Layout, arrows: Sequence[Arrow], down: bool) -> None:
    """Redraw a forest's arrows, all of which lead to the next rank: straight within ranks, bent between them.

    Graphviz leaves the bends any room there is, and so lets arrows of one group cross each other.
    """
    axis = 1 if down else 0
    sizes = [(box[axis], box[2 + axis]) for box in layout.boxes.values()]
    sizes += [(centre[axis], (arrows[i].label or (0, 0))[axis]) for i, centre in layout.labels.items()]
    depth: dict[float, float] = {}  # rank → its size along the arrows; boxes and labels stand in its middle
    for rank, size in sizes:
        depth[rank] = max(depth.get(rank, 0.0), size)

    def level(point: Point, along: float) -> Point:
        return (point[0], along) if down else (along, point[1])

    for i, arrow in enumerate(arrows):
        label = [layout.labels[i]] if i in layout.labels else []
        stops = [layout.boxes[arrow.tail][:2], *label, layout.boxes[arrow.head][:2]]
        for k, (points, tip) in enumerate(layout.arrows[i]):
            start, goal = points[0], tip or points[-1]
            base = level(goal, goal[axis] - (HEAD if tip else 0))
            rank, next_rank = stops[k][axis], stops[k + 1][axis]
            after, before = rank + depth[rank] / 2, min(next_rank - depth[next_rank] / 2, base[axis])
            middle = (after + before) / 2
            bend = [level(start, after), level(start, middle), level(goal, middle), level(goal, before)]
            layout.arrows[i][k] = Curve([start, start, bend[0], *bend, bend[-1], base, base], tip)


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
        if "number" not in piece:
            continue  # it kept room free
        words = piece["pos"].split()
        points = [point(word) for word in words if word[0] not in "se"]
        tips = [point(word[2:]) for word in words if word[0] in "se"]
        if piece["dir"] == "back":
            points.reverse()
        layout.arrows.setdefault(int(piece["number"]), []).append(Curve(points, tips[0] if tips else None))
    return layout


def _dot(
    boxes: Sequence[Size],
    arrows: Sequence[Arrow],
    loops: Mapping[int, Mapping[int, Size]],
    upward: set[int],
    forest: bool,
    down: bool,
) -> str:
    """Return what is to be placed in Graphviz's language, for which a pixel is 1/72 inch."""
    entry, leave = ("n", "s") if down else ("w", "e")
    # What meets a box where its arrows leave: each group at one place, what closes a loop at another (None).
    exits: list[list[int | None]] = [[] for _ in boxes]
    for i, arrow in enumerate(arrows):
        box, place = (arrow.head, None) if i in upward else (arrow.tail, arrow.group)
        if arrow.tail != arrow.head and place not in exits[box]:
            exits[box].append(place)
    lines = [
        "digraph {",
        "rankdir=TB; nodesep=0.3; ranksep=0.36;" if down else "rankdir=LR; nodesep=0.15; ranksep=0.4;",
        f'node [shape=box, label="", margin=0, is=box]; edge [arrowsize={HEAD / 10}, part=0, dir=forward];',
    ]
    if forest:
        lines.append("ordering=out; splines=line;")  # in the order given; elsewhere so that few arrows cross
    for i, (width, height) in enumerate(boxes):
        size = width, height
        if labels := loops.get(i, {}).values():
            length = len(labels) * _pitch(labels, down)
            size = (width, max(height, length)) if down else (max(width, length), height)
            room = (max(w for w, _ in labels) + REACH, 1) if down else (1, max(h for _, h in labels) + REACH)
            lines.append(f"box{i} -> box{i} [label={_table([room], down)}];")
        lines.append(f"box{i} [number={i}, {_shape(size, len(exits[i]), down)}];")
    for i, arrow in enumerate(arrows):
        tail, head, label = f"box{arrow.tail}", f"box{arrow.head}", f"label{i}"
        if arrow.tail == arrow.head:
            continue
        # An arrow that closes a loop goes against the ranks: it is laid out as if it ran the other way.
        if i in upward:
            first, last, way = _port(head, exits[arrow.head], None, leave), tail, "dir=back"
        else:
            first, last, way = _port(tail, exits[arrow.tail], arrow.group, leave), head, "dir=forward"
            last += f":{entry}" if forest else ""
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
