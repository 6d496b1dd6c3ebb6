"""Diagram: nodes and edges as a picture, in a notebook or in a file; Graphviz places them, the rest is drawn here.

The look follows decision trees: a square where the planner chooses, a circle where chance decides. Branches that
exclude each other leave through one such mark; what leaves a node elsewhere happens side by side with them.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import re
import unicodedata
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from symgraph.errors import GraphError, InputError, MissingExtraError, names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NodeKind = Literal["start", "node", "terminal", "reward", "cut"]
EdgeKind = Literal["edge", "choose", "chance", "reward"]
Point = tuple[float, float]  # x to the right, y down [px]


@dataclass(frozen=True)
class DiagramNode:
    """A box of a diagram: its unique key, and the lines of text in it, of which the first is its name."""

    key: str
    lines: tuple[str, ...]
    kind: NodeKind = "node"
    muted: bool = False
    tooltip: str = ""


@dataclass(frozen=True)
class DiagramEdge:
    """An arrow of a diagram; edges of one source and one group exclude each other."""

    source: str
    target: str
    label: str = ""
    group: int = 0
    kind: EdgeKind = "edge"
    muted: bool = False  # not taken: pale
    weight: float | None = None  # probability: joins the label and widens the line
    tooltip: str = ""

    @property
    def text(self) -> str:
        """The label with the probability, as drawn."""
        return " ".join([self.label] * bool(self.label) + [f"{self.weight:.3g}"] * (self.weight is not None))


@dataclass(frozen=True)
class Diagram:
    """A picture of boxes and arrows; notebooks show it by themselves.

    It runs from top to bottom, or from left to right where it would not fit a page else: pages scroll downwards.

    Args:
        nodes: the boxes, each with its own key; loops are cut open at the start, else at the first node.
        edges: the arrows between them, loops and parallel ones included.
        title: a line above the picture.

    Raises:
        GraphError: two nodes have the same key, or an edge has no node at one of its ends.
    """

    nodes: tuple[DiagramNode, ...]
    edges: tuple[DiagramEdge, ...] = ()
    title: str = ""

    def __post_init__(self) -> None:
        keys: set[str] = set()
        for node in self.nodes:
            if node.key in keys:
                raise GraphError(f"diagram: two nodes have the key {node.key!r}; give each its own")
            keys.add(node.key)
        for edge in self.edges:
            if missing := {edge.source, edge.target} - keys:
                raise GraphError(f"diagram: edge {edge.source!r} → {edge.target!r} wants a node {names(missing)}; add it to nodes")

    def svg(self) -> str:
        """Return the picture as SVG, the same text for equal diagrams."""
        return ET.tostring(_drawn(self), encoding="unicode")

    def save(self, path: str | PathLike[str]) -> None:
        """Write the picture to a file.

        Args:
            path: ends in .svg, or in .png or .pdf, which take matplotlib.

        Raises:
            InputError: another ending.
            MissingExtraError: .png or .pdf without matplotlib.
        """
        path = Path(path)
        suffix = path.suffix.lower()
        if suffix == ".svg":
            path.write_text(self.svg(), encoding="utf-8")
        elif suffix in (".png", ".pdf"):
            _figure(_drawn(self), f"saving a diagram as {suffix}").savefig(path, dpi=192)  # 2 dots a pixel
        else:
            raise InputError(f"save({str(path)!r}): unknown suffix {suffix!r}; a diagram is saved as .svg, .png or .pdf")

    def _repr_svg_(self) -> str:
        return self.svg()


# Text: its size must be the same on every machine, so it is estimated, not measured with the fonts found there.

FONT = "Helvetica Neue, Helvetica, Arial, Liberation Sans, Arimo, sans-serif"  # all as wide as Arial
NAME, SMALL = 13, 11  # [px] font sizes: a node's first line; every other text
EMS = {  # width of a letter of Arial / font size
    0.22: "ijl'|", 0.28: " .,:;!/\\tfI[]", 0.35: "r-()*\"`{}^", 0.5: "cksvxyzJ", 0.61: "TZF+<=>~",
    0.67: "ABEKPSVXY&", 0.72: "CDHNRUw", 0.78: "GOQ", 0.87: "mM%", 0.98: "W@…—",
}  # fmt: skip
EM = {letter: width for width, letters in EMS.items() for letter in letters}
NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def _width(text: str, size: float) -> float:
    """Return how wide a text is at most [px], for fonts as wide as Arial."""

    def ems(letter: str) -> float:
        if unicodedata.east_asian_width(letter) in "WF":
            return 1.0
        return 0.0 if unicodedata.combining(letter) else EM.get(letter, 0.56 if letter.isascii() else 0.64)

    return 1.05 * size * sum(map(ems, text))


def _box_size(node: DiagramNode) -> tuple[int, int]:
    """Return width and height [px] of a node's box; Graphviz wants them whole."""
    widths = [_width(line, SMALL if i else 1.06 * NAME) for i, line in enumerate(node.lines)]  # a name is bold
    return math.ceil(max([*widths, 24]) + 24), 14 + 17 + 15 * max(0, len(node.lines) - 1)


def _label_size(edge: DiagramEdge) -> tuple[int, int]:
    return math.ceil(_width(edge.text, SMALL)) + 8, SMALL + 5


# Layout: Graphviz knows boxes by number and gets no text. A label is a box in the middle of its edge: no other
# edge or label can then come near it.

PAGE = 1000  # [px] what is wider does not fit a notebook


class _Box(NamedTuple):
    x: float  # centre
    y: float
    width: float
    height: float


class _Curve(NamedTuple):
    points: list[Point]  # of a cubic Bézier spline, from tail to head
    tip: Point | None  # of the arrow


@dataclass
class _Layout:
    width: float
    height: float
    nodes: list[_Box]
    labels: dict[int, Point]  # edge → centre of its label
    curves: list[list[_Curve]]  # edge → its pieces, from tail to head


def _layout(diagram: Diagram) -> _Layout:
    layout = _placed(diagram, down=True)
    return layout if layout.width <= PAGE else min(layout, _placed(diagram, down=False), key=lambda l: l.width)


def _placed(diagram: Diagram, down: bool) -> _Layout:
    import pygraphviz

    # Its warning that more than 1000 nodes take long, on sys.stderr, is wrong for trees: those take about a second.
    with contextlib.redirect_stderr(io.StringIO()):
        drawn = pygraphviz.AGraph(string=_dot(diagram, down)).draw(format="json0", prog="dot")
    placed = json.loads(drawn)
    _, _, width, height = map(float, placed["bb"].split(","))

    def point(text: str) -> Point:
        x, y = map(float, text.split(","))
        return x, height - y

    layout = _Layout(width, height, [], {}, [[] for _ in diagram.edges])
    for box in placed.get("objects", ()):
        if box["name"].startswith("label"):
            layout.labels[int(box["name"][5:])] = point(box["pos"])
        else:
            layout.nodes.append(_Box(*point(box["pos"]), 72 * float(box["width"]), 72 * float(box["height"])))
    for piece in sorted(placed.get("edges", ()), key=lambda piece: int(piece["part"])):
        tips = [point(word[2:]) for word in piece["pos"].split() if word[0] in "se"]
        points = [point(word) for word in piece["pos"].split() if word[0] not in "se"]
        if piece["reversed"] == "1":
            points.reverse()
        layout.curves[int(piece["edge"])].append(_Curve(points, tips[0] if tips else None))
        if "lp" in piece:
            layout.labels[int(piece["edge"])] = point(piece["lp"])
    return layout


def _dot(diagram: Diagram, down: bool) -> str:
    """Return the diagram in Graphviz's language, without its texts."""
    entry, leave = ("n", "s") if down else ("w", "e")
    number = {node.key: i for i, node in enumerate(diagram.nodes)}
    upward = _upward(diagram)
    tree = len({edge.target for edge in diagram.edges}) == len(diagram.edges) == len(diagram.nodes) - 1
    exits: dict[str, dict[int, int]] = {}  # node → group → place along its lower side
    for i, edge in enumerate(diagram.edges):
        if i not in upward:
            groups = exits.setdefault(edge.source, {})
            groups.setdefault(edge.group, len(groups))

    lines = [
        f"digraph {{ rankdir={'TB' if down else 'LR'}; nodesep={0.3 if down else 0.15}; ranksep=0.3;",
        'node [shape=box, label="", margin=0]; edge [arrowsize=0.75, part=0, reversed=0];',
        "ordering=out;" if tree else "",  # branches as declared; elsewhere as they cross least
    ]
    for i, node in enumerate(diagram.nodes):
        width, height = _box_size(node)
        ports = len(exits.get(node.key, ()))
        lines.append(f"node{i} [{_table(width, height, ports, down) if ports > 1 else _sized(width, height)}];")
    for i, edge in enumerate(diagram.edges):
        tail, head = f"node{number[edge.source]}", f"node{number[edge.target]}"
        if edge.source == edge.target:
            label = f"label={_blank(*_label_size(edge))}" if edge.text else ""
            lines.append(f"{tail} -> {tail} [edge={i}, {label}];")
            continue
        if i not in upward:
            groups = exits[edge.source]
            tail += f":port{groups[edge.group]}:{leave}" if len(groups) > 1 else f":{leave}"
            head += f":{entry}" if tree else ""
        # Ranks follow the arrows; an arrow that closes a loop goes against them and is laid out the other way round.
        first, last, arrow = (head, tail, "back") if i in upward else (tail, head, "forward")
        ahead = f"edge={i}, reversed={int(i in upward)}"
        if edge.text:
            lines.append(f"label{i} [{_sized(*_label_size(edge))}];")
            parts = (1, 0) if i in upward else (0, 1)
            arrows = (arrow, "none") if i in upward else ("none", arrow)
            lines.append(f"{first} -> label{i}:{entry} [{ahead}, part={parts[0]}, dir={arrows[0]}];")
            lines.append(f"label{i}:{leave} -> {last} [{ahead}, part={parts[1]}, dir={arrows[1]}];")
        else:
            lines.append(f"{first} -> {last} [{ahead}, dir={arrow}];")
    return "\n".join([*lines, "}"])
