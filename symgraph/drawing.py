"""Diagram: nodes and edges as a picture, in a notebook or in a file.

The look follows decision trees: a square where the planner chooses, a circle where chance decides. Branches
that exclude each other leave through one such mark; what leaves a node elsewhere happens side by side.
"""

from __future__ import annotations

import math
import re
import unicodedata
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from symgraph.errors import GraphError, InputError, MissingExtraError, names
from symgraph.layout import Arrow, Box, Curve, Layout, Point, Size, place

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NodeKind = Literal["start", "node", "terminal", "reward", "cut"]
EdgeKind = Literal["edge", "choose", "chance", "reward"]


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


@dataclass(frozen=True)
class Diagram:
    """A picture of boxes and arrows; notebooks show it by themselves.

    It runs from top to bottom, or from left to right where it would be too wide for a page.

    Args:
        nodes: the boxes, each with its own key; loops are cut open as seen from the first.
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
                raise GraphError(
                    f"diagram: edge {edge.source!r} → {edge.target!r}: no node {names(sorted(missing))};"
                    f" there are {names(sorted(keys))}"
                )

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
            figure = _figure(_drawn(self), f"saving a diagram as {suffix}")
            inches = max(figure.get_size_inches())
            figure.savefig(path, dpi=min(192, 2**15 / inches))  # 2 dots a pixel, as long as they fit the memory
        else:
            raise InputError(
                f"save({str(path)!r}): unknown suffix {suffix!r}; a diagram is saved as .svg, .png or .pdf"
            )

    def _repr_svg_(self) -> str:
        return self.svg()


# Text: its size shall be the same on every machine, so it is estimated, not measured with that one's fonts.

FONT = "Helvetica Neue, Helvetica, Arial, Liberation Sans, Arimo, sans-serif"  # all as wide as Arial
NAME, SMALL, LEADING = 13, 11, 15  # [px] font sizes of a node's first line and of all else; from line to line
BOLD = 1.1  # bold letters are so much wider at most; names and titles are bold
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


def _box_size(node: DiagramNode) -> Size:
    widths = [_width(line, SMALL if i else BOLD * NAME) for i, line in enumerate(node.lines)]
    return math.ceil(max([*widths, 20]) + 24), 30 + LEADING * max(0, len(node.lines) - 1)


def _label(edge: DiagramEdge) -> str:
    probability = [] if edge.weight is None else [f"{edge.weight:.3g}"]
    return " · ".join([edge.label] * bool(edge.label) + probability)


def _layout(diagram: Diagram) -> Layout:
    number = {node.key: i for i, node in enumerate(diagram.nodes)}
    arrows = []
    for edge in diagram.edges:
        text = _label(edge)
        size = (math.ceil(_width(text, SMALL)) + 8, SMALL + 5) if text else None
        arrows.append(Arrow(number[edge.source], number[edge.target], edge.group, size))
    return place([_box_size(node) for node in diagram.nodes], arrows)


# The picture: rectangles, paths and texts, with no style sheet and no ids, for a page may hold many diagrams.
# It brings its own ground, for dark pages; its colours are those of Okabe and Ito, for the colour-blind.

INK, LINE, PALE_INK, PALE_LINE = "#1f2933", "#52606d", "#7b838c", "#c5cad0"
FILLS: dict[NodeKind, tuple[str, str, str]] = {  # fill, outline, text
    "start": ("#0072b2", "#0072b2", "#ffffff"),
    "node": ("#f1f6fa", "#4f7896", INK),
    "terminal": ("#eceff1", LINE, INK),
    "reward": ("#fff4d9", "#b87700", INK),
    "cut": ("#ffffff", "#d55e00", "#a34700"),
}
MARKS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # of a node's groups in turn
HINTS = {"choose": "the planner chooses one of these", "chance": "chance decides for one of these"}
MARGIN = 16  # [px]


def _drawn(diagram: Diagram) -> ET.Element:
    layout = _layout(diagram)
    above = 2 * NAME if diagram.title else 0
    width = max(layout.width, _width(diagram.title, BOLD * NAME)) + 2 * MARGIN
    height = layout.height + above + 2 * MARGIN
    left, top = (layout.width - width) / 2, -MARGIN - above
    svg = ET.Element("svg", xmlns="http://www.w3.org/2000/svg", role="img", style="max-width: 100%; height: auto")
    _set(svg, width=width, height=height, viewBox=" ".join(map(_text, (left, top, width, height))))
    _set(svg, font_family=FONT, text_anchor="middle")
    ground = Box(layout.width / 2, top + height / 2, width - 1, height - 1)
    _add_rect(svg, ground, rx=8, fill="#ffffff", stroke="#d5dae0")
    if diagram.title:
        _add_text(svg, diagram.title, layout.width / 2, top + MARGIN + NAME / 2, NAME, INK)
    for i in sorted(layout.arrows, key=lambda i: not diagram.edges[i].muted):  # pale ones below the others
        _draw_edge(svg, diagram.edges[i], layout.arrows[i], layout.labels.get(i))
    for i, box in layout.boxes.items():
        _draw_node(svg, diagram.nodes[i], box)
    for (x, y), (kind, colour) in _marks(diagram, layout).items():
        mark = _add_group(svg, HINTS[kind], data_mark=kind)
        _add_rect(mark, Box(x, y, 9, 9), rx=4.5 if kind == "chance" else 0, fill=colour, stroke="#ffffff")
    return svg


def _draw_edge(svg: ET.Element, edge: DiagramEdge, pieces: list[Curve], label: Point | None) -> None:
    drawn = _add_group(svg, edge.tooltip, data_source=edge.source, data_target=edge.target)
    colour = PALE_LINE if edge.muted else FILLS["reward"][1] if edge.kind == "reward" else LINE
    chance = min(1.0, max(0.0, edge.weight or 0.0))  # a learned probability may be anything, nan included
    for (first, *rest), tip in pieces:
        curve = f"M{_pair(first)} C{' '.join(map(_pair, rest))}"
        _add(drawn, "path", d=curve, fill="none", stroke=colour, stroke_width=1.2 + 2.4 * chance)
        if tip is not None:
            x, y = rest[-1]
            dx, dy = 0.45 * (tip[0] - x), 0.45 * (tip[1] - y)
            head = f"M{_pair(tip)} L{_pair((x - dy, y + dx))} {_pair((x + dy, y - dx))} Z"
            _add(drawn, "path", d=head, fill=colour)
    if label is not None:
        _add_text(drawn, _label(edge), *label, SMALL, PALE_INK if edge.muted else INK)


def _draw_node(svg: ET.Element, node: DiagramNode, box: Box) -> None:
    drawn = _add_group(svg, node.tooltip, data_key=node.key, data_kind=node.kind)
    fill, outline, ink = ("#ffffff", PALE_LINE, PALE_INK) if node.muted else FILLS[node.kind]
    rx = 15 if node.kind == "reward" else 6
    dashes = "4 3" if node.kind == "cut" else "none"
    _add_rect(drawn, box, rx=rx, fill=fill, stroke=outline, stroke_width=1.2, stroke_dasharray=dashes)
    if node.kind == "terminal":  # a double outline, as automata have
        inner = box._replace(width=box.width - 5, height=box.height - 5)
        _add_rect(drawn, inner, rx=rx - 2.5, fill="none", stroke=outline)
    for i, line in enumerate(node.lines):
        y = box.y + (i - (len(node.lines) - 1) / 2) * LEADING
        _add_text(drawn, line, box.x, y, SMALL if i else NAME, ink)


def _marks(diagram: Diagram, layout: Layout) -> dict[Point, tuple[EdgeKind, str]]:
    """Return where the edges of choices and chances start, and in which colour."""
    groups: dict[str, list[int]] = {node.key: [] for node in diagram.nodes}
    marks: dict[Point, tuple[EdgeKind, str]] = {}
    for i, edge in enumerate(diagram.edges):
        if edge.group not in groups[edge.source]:
            groups[edge.source].append(edge.group)
        if edge.kind in HINTS:
            start = layout.arrows[i][0].points[0]
            colour = MARKS[groups[edge.source].index(edge.group) % len(MARKS)]
            if not (edge.muted and start in marks):
                marks[start] = edge.kind, PALE_LINE if edge.muted else colour
    return marks


def _add_group(svg: ET.Element, tooltip: str, **attributes: str) -> ET.Element:
    group = _add(svg, "g", **attributes)
    if tooltip:
        _add(group, "title").text = _legal(tooltip)
    return group


def _add_text(parent: ET.Element, text: str, x: float, y: float, size: float, fill: str) -> None:
    """Write a line centred at x, y."""
    weight = "bold" if size == NAME else "normal"
    line = _add(parent, "text", x=x, y=y + 0.36 * size, font_size=size, font_weight=weight, fill=fill)
    line.text = _legal(text)


def _add_rect(parent: ET.Element, box: Box, **look: float | str) -> None:
    x, y, width, height = box
    _add(parent, "rect", x=x - width / 2, y=y - height / 2, width=width, height=height, **look)


def _add(parent: ET.Element, tag: str, **attributes: float | str) -> ET.Element:
    element = ET.SubElement(parent, tag)
    _set(element, **attributes)
    return element


def _set(element: ET.Element, **attributes: float | str) -> None:
    for name, value in attributes.items():
        element.set(name.replace("_", "-"), _legal(value) if isinstance(value, str) else _text(value))


def _legal(text: str) -> str:
    """Return a text without the control characters that XML forbids."""
    return NOT_XML.sub("\ufffd", text)


def _text(number: float) -> str:
    return f"{round(number, 1) + 0.0:.1f}".removesuffix(".0")  # adding 0 turns -0 into 0


def _pair(point: Point) -> str:
    return f"{_text(point[0])},{_text(point[1])}"


def _figure(svg: ET.Element, purpose: str) -> Figure:
    """Return the same picture as matplotlib draws it."""
    try:
        from matplotlib.figure import Figure
    except ImportError as missing:
        raise MissingExtraError("matplotlib", "plots", purpose) from missing
    from matplotlib.patches import FancyBboxPatch, PathPatch
    from matplotlib.path import Path as Spline

    left, top, width, height = map(float, svg.attrib["viewBox"].split())
    figure = Figure(figsize=(width / 96, height / 96))  # a browser's inch has 96 pixels, which are 72 points
    axes = figure.add_axes((0, 0, 1, 1), xlim=(left, left + width), ylim=(top + height, top))
    axes.set_axis_off()
    for order, element in enumerate(svg.iter()):
        have = element.attrib
        look: dict[str, Any] = {
            "facecolor": have.get("fill"),
            "edgecolor": have.get("stroke", "none"),
            "linewidth": 0.75 * float(have.get("stroke-width", 1)),
            "linestyle": (0, (4, 3)) if have.get("stroke-dasharray", "none") != "none" else "solid",
            "zorder": order,
        }
        if element.tag == "rect":
            x, y, w, h, rx = (float(have[name]) for name in ("x", "y", "width", "height", "rx"))
            axes.add_patch(FancyBboxPatch((x, y), w, h, f"round,pad=0,rounding_size={rx}", **look))
        elif element.tag == "path":
            points = [tuple(map(float, pair.split(","))) for pair in re.findall(r"[-\d.]+,[-\d.]+", have["d"])]
            step = Spline.CURVE4 if "C" in have["d"] else Spline.LINETO
            axes.add_patch(PathPatch(Spline(points, [Spline.MOVETO, *[step] * (len(points) - 1)]), **look))
        elif element.tag == "text":
            text = axes.text(float(have["x"]), float(have["y"]), element.text or "", parse_math=False)
            size = 0.75 * 0.87 * float(have["font-size"])  # matplotlib's own font is wider than Arial
            text.set(size=size, weight=have["font-weight"], color=have["fill"], ha="center", zorder=order)
    return figure
