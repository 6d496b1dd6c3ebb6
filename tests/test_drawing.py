"""Diagrams: what is drawn, that nothing covers anything else, and the files they are saved to."""

import os
import random
import re
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from itertools import combinations
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.textpath import TextPath

from symgraph.drawing import Diagram, DiagramEdge, DiagramNode
from symgraph.errors import GraphError, InputError, MissingExtraError
from symgraph.layout import PAGE, Arrow, place

SVG = "{http://www.w3.org/2000/svg}"


def nodes(*keys):
    return tuple(DiagramNode(key, (key,), "start" if i == 0 else "node") for i, key in enumerate(keys))


CANNON = Diagram(
    (*nodes("aim", "landed"), DiagramNode("score", ("score",), "reward")),
    (
        DiagramEdge("aim", "landed", "lower: fly", kind="choose"),
        DiagramEdge("aim", "landed", "upper: fly", kind="choose", muted=True),
        DiagramEdge("landed", "score", kind="reward"),
    ),
)

POURING = Diagram(
    (
        *nodes("n0", "n1", "n1r", "n2a", "n2b", "n2c", "n3ti", "n3sa", "n4ti", "n4sa"),
        *(DiagramNode(f"r{i}", ("reward", f"R_{i}"), "reward") for i in range(4)),
    ),
    (
        DiagramEdge("n0", "n1", "F_grasp"),
        DiagramEdge("n1", "n2a", "F_mv_to_rcv", group=0),
        DiagramEdge("n1", "n1r", "F_mv_to_rcv_rcvmv", group=1),
        DiagramEdge("n1r", "r0", kind="reward"),
        DiagramEdge("n2a", "n2b", "F_mv_to_pour"),
        DiagramEdge("n2b", "n2c", group=0),
        DiagramEdge("n2b", "r1", group=1, kind="reward"),
        DiagramEdge("n2c", "n3ti", "tip: F_flowc_tip", kind="choose"),
        DiagramEdge("n2c", "n3sa", "shake: F_flowc_shake", kind="choose"),
        DiagramEdge("n3ti", "n4ti", "F_amount"),
        DiagramEdge("n3sa", "n4sa", "F_amount"),
        DiagramEdge("n4ti", "r2", kind="reward"),
        DiagramEdge("n4sa", "r3", kind="reward"),
    ),
    title="pouring",
)

# Chance, a choice, a loop over two nodes, arrows from a node to itself, parallel ones, groups side by side.
LOOPS = Diagram(
    (*nodes("start", "reach", "grasp", "held", "dropped"), DiagramNode("done", ("done",), "terminal")),
    (
        DiagramEdge("start", "reach", "move"),
        DiagramEdge("reach", "grasp", "approach", group=0),
        DiagramEdge("reach", "reach", "wait", group=1),
        DiagramEdge("reach", "reach", "wait longer", group=2),
        DiagramEdge("grasp", "held", "holds", kind="chance", weight=0.7),
        DiagramEdge("grasp", "dropped", "slips", kind="chance", weight=0.25),
        DiagramEdge("grasp", "grasp", kind="chance", weight=0.05),
        DiagramEdge("dropped", "reach", "pick up"),
        DiagramEdge("held", "done", "place", kind="choose"),
        DiagramEdge("held", "done", "throw", kind="choose", muted=True),
        DiagramEdge("held", "dropped", "let go", kind="choose"),
        DiagramEdge("held", "grasp", group=1, kind="chance", weight=1.0),
    ),
)


def tree(size, branches=3):
    """A tree with probabilities and expected values; its branches are chosen or happen."""
    return Diagram(
        tuple(DiagramNode(str(i), (f"node {i}", f"p {0.5**i:.3g}", f"J −{i / 7:.3f}")) for i in range(size)),
        tuple(
            DiagramEdge(
                str((i - 1) // branches),
                str(i),
                f"branch {i % branches}",
                kind=("choose", "chance")[i // branches % 2],
                weight=(None, 1 / branches)[i // branches % 2],
            )
            for i in range(1, size)
        ),
    )


def tangle(size, seed):
    """A random graph with loops, parallel arrows and groups."""
    draw = random.Random(seed)
    ends = [(draw.randrange(max(0, i - 4), i), i) for i in range(1, size)]
    ends += [(draw.randrange(size), draw.randrange(size)) for _ in range(size // 2)]
    edges = (
        DiagramEdge(str(i), str(j), draw.choice(["", "go on", "F_flow"]), group=draw.randrange(2), kind="chance")
        for i, j in ends
    )
    return Diagram(tuple(DiagramNode(str(i), ("node", str(i))) for i in range(size)), tuple(edges))


DIAGRAMS = {
    "cannon": CANNON,
    "pouring": POURING,
    "loops": LOOPS,
    "five to itself": Diagram(nodes("a"), tuple(DiagramEdge("a", "a", f"way {i}", group=i) for i in range(5))),
    "small tree": tree(13),
    "large tree": tree(150),
    "chain": tree(40, branches=1),
    "forest": Diagram(nodes("a", "b", "c", "d"), (DiagramEdge("c", "d", "on"),)),
    **{f"tangle {seed}": tangle(12 + 12 * seed, seed) for seed in range(4)},
}

each_diagram = pytest.mark.parametrize("diagram", DIAGRAMS.values(), ids=DIAGRAMS)


class Picture:
    """What an SVG holds, in its own coordinates."""

    def __init__(self, diagram):
        self.root = ET.fromstring(diagram.svg())
        self.texts = [text.text or "" for text in self.root.iter(f"{SVG}text")]
        groups = self.root.findall(f"{SVG}g")
        self.nodes = {group.get("data-key"): group for group in groups if "data-key" in group.attrib}
        self.edges = [group for group in groups if "data-source" in group.attrib]
        self.marks = [group for group in groups if "data-mark" in group.attrib]

    def box(self, group):
        """(left, top, right, bottom) of a group's outer rectangle."""
        rect = group.find(f"{SVG}rect")
        x, y, width, height = (float(rect.get(name)) for name in ("x", "y", "width", "height"))
        return x, y, x + width, y + height

    def ways(self, source, target):
        """The arrows from one node to another: each a list of its points, of which the last is the tip."""
        found = []
        for group in self.edges:
            if (group.get("data-source"), group.get("data-target")) == (source, target):
                paths = [path.get("d") for path in group.iter(f"{SVG}path")]
                *lines, head = [re.findall(r"([-\d.]+),([-\d.]+)", path) for path in paths]
                points = [point for line in lines for point in line] + head[:1]
                found.append([(float(x), float(y)) for x, y in points])
        return found


def overlap(first, second):
    """Whether two (left, top, right, bottom) share more than a rounding error."""
    return all(min(first[2 + axis], second[2 + axis]) - max(first[axis], second[axis]) > 0.2 for axis in (0, 1))


def on_border(point, box):
    """Whether a point lies on the edge of a box, within two pixels."""
    (x, y), (left, top, right, bottom) = point, box
    inside = left - 2 < x < right + 2 and top - 2 < y < bottom + 2
    return inside and min(abs(x - left), abs(x - right), abs(y - top), abs(y - bottom)) < 2


# What is drawn


@each_diagram
def test_every_text_node_and_edge_is_drawn(diagram):
    picture = Picture(diagram)
    wanted = [line for node in diagram.nodes for line in node.lines]
    wanted += [diagram.title] * bool(diagram.title)
    wanted += [
        " · ".join([edge.label] * bool(edge.label) + ([] if edge.weight is None else [f"{edge.weight:.3g}"]))
        for edge in diagram.edges
        if edge.label or edge.weight is not None
    ]
    assert sorted(picture.texts) == sorted(wanted)
    assert list(picture.nodes) == [node.key for node in diagram.nodes]
    drawn = sorted((group.get("data-source"), group.get("data-target")) for group in picture.edges)
    assert drawn == sorted((edge.source, edge.target) for edge in diagram.edges)


@each_diagram
def test_every_arrow_leads_from_its_source_to_its_target(diagram):
    picture = Picture(diagram)
    for edge in diagram.edges:
        for points in picture.ways(edge.source, edge.target):
            assert on_border(points[0], picture.box(picture.nodes[edge.source]))
            assert on_border(points[-1], picture.box(picture.nodes[edge.target]))


@each_diagram
def test_parallel_arrows_and_those_from_a_node_to_itself_stay_apart(diagram):
    picture = Picture(diagram)
    for source, target in {(edge.source, edge.target) for edge in diagram.edges}:
        ways = picture.ways(source, target)
        assert len({tuple(points) for points in ways}) == len(ways)
        assert all(len(set(points)) > 3 for points in ways if source == target)


def test_groups_leave_side_by_side_and_share_a_mark():
    diagram = Diagram(
        nodes("n", "a", "b", "c", "d", "e"),
        (
            DiagramEdge("n", "a", kind="choose", group=0),
            DiagramEdge("n", "b", kind="choose", group=0),
            DiagramEdge("n", "c", kind="chance", group=1),
            DiagramEdge("n", "d", kind="chance", group=1),
            DiagramEdge("n", "e", group=2),
        ),
    )
    picture = Picture(diagram)
    starts = [picture.ways("n", target)[0][0] for target in "abcde"]
    assert starts[0] == starts[1] != starts[2] == starts[3] != starts[4]
    assert [mark.get("data-mark") for mark in picture.marks] == ["choose", "chance"]
    assert [float(mark.find(f"{SVG}rect").get("rx")) > 0 for mark in picture.marks] == [False, True]
    assert len({mark.find(f"{SVG}rect").get("fill") for mark in picture.marks}) == 2


def test_unselected_branch_is_pale_and_probability_widens():
    def looks(**properties):
        picture = Picture(Diagram(nodes("a", "b"), (DiagramEdge("a", "b", "go", **properties),)))
        path = picture.edges[0].find(f"{SVG}path")
        return path.get("stroke"), float(path.get("stroke-width"))

    colour, width = looks()
    assert looks(muted=True)[0] != colour
    assert looks(weight=0.0)[1] == width < looks(weight=0.3)[1] < looks(weight=1.0)[1]
    assert looks(weight=float("nan"))[1] == width
    assert looks(weight=7.0)[1] == looks(weight=1.0)[1]


def test_kinds_of_nodes_differ_in_more_than_colour():
    kinds = ("node", "terminal", "reward", "cut")
    picture = Picture(Diagram(tuple(DiagramNode(kind, ("x",), kind) for kind in kinds)))

    def shape(kind):
        rects = picture.nodes[kind].findall(f"{SVG}rect")
        return len(rects), rects[0].get("rx"), rects[0].get("stroke-dasharray")

    assert len({shape(kind) for kind in kinds}) == len(kinds)


def test_tooltips_are_titles():
    diagram = Diagram(
        (DiagramNode("a", ("a",), tooltip="where it begins"), DiagramNode("b", ("b",))),
        (DiagramEdge("a", "b", tooltip="the way"),),
    )
    assert [title.text for title in Picture(diagram).root.iter(f"{SVG}title")] == [
        "the way",
        "where it begins",
    ]


@settings(max_examples=30)
@given(text=st.text(max_size=20))
def test_any_text_is_legal_and_comes_back(text):
    diagram = Diagram(
        (DiagramNode(text, (text, "<&>\"'"), tooltip=text), DiagramNode(f"{text}2", (text,), "reward")),
        (DiagramEdge(text, f"{text}2", text, tooltip=text), DiagramEdge(text, text, f"x{text}")),
        title=text,
    )
    parsed = "".join(Picture(diagram).texts)
    visible = [letter for letter in text if letter.isprintable()]
    assert "<&>\"'" in parsed
    assert all(parsed.count(letter) >= 4 for letter in visible)


def test_control_characters_are_replaced():
    diagram = Diagram((DiagramNode("\x00a", ("go\x1b[0m", "\ud800"), tooltip="\x07"),), title="\x0b")
    assert Picture(diagram).texts == ["\ufffd", "go\ufffd[0m", "\ufffd"]


def test_empty_diagram_and_single_node():
    assert Picture(Diagram(())).texts == []
    assert Picture(Diagram((), title="nothing yet")).texts == ["nothing yet"]
    assert Picture(Diagram(nodes("only"))).texts == ["only"]
    assert Picture(Diagram((DiagramNode("bare", ()),))).texts == []


def test_notebooks_show_it():
    assert CANNON._repr_svg_() == CANNON.svg()


# Nothing covers anything else


@each_diagram
def test_boxes_stay_apart_and_inside(diagram):
    picture = Picture(diagram)
    boxes = [picture.box(group) for group in picture.nodes.values()]
    assert not any(overlap(first, second) for first, second in combinations(boxes, 2))
    left, top, width, height = map(float, picture.root.get("viewBox").split())
    for box in boxes:
        assert left < box[0] < box[2] < left + width
        assert top < box[1] < box[3] < top + height


@pytest.mark.parametrize(
    "text", ["aim", "WWWWMMMM@@", "illjjit", "F_mv_to_rcv_rcvmv", "p 0.25   J −1.234", "θ = ½π ± ÄÖ", "(0.1) [m/s]"]
)
def test_text_fits_its_box(text):
    def drawn(size):  # in matplotlib's own font, which is wider than Arial by 1/0.87
        return TextPath((0, 0), text, size=0.87 * size, usetex=False).get_extents().width

    picture = Picture(Diagram((DiagramNode("a", (text, text)),)))
    left, _, right, _ = picture.box(picture.nodes["a"])
    assert 1.1 * drawn(13) + 8 < right - left < 1.6 * drawn(13) + 40


@pytest.mark.parametrize("seed", range(12))
def test_labels_touch_neither_labels_nor_boxes(seed):
    draw = random.Random(seed)
    boxes = [(draw.randint(40, 160), draw.randint(30, 75)) for _ in range(4 + 3 * seed)]
    ends = [(draw.randrange(i), i) for i in range(1, len(boxes))]
    ends += [(draw.randrange(len(boxes)), draw.randrange(len(boxes))) for _ in range(seed)]
    ends += [(0, 0), (0, 0), (1, 1)] * (seed % 2)
    arrows = [Arrow(i, j, draw.randrange(3), (draw.randint(20, 120), 16)) for i, j in ends]
    layout = place(boxes, arrows)
    areas = [
        (x - width / 2, y - height / 2, x + width / 2, y + height / 2)
        for x, y, width, height in [
            *layout.boxes.values(),
            *((*centre, *arrows[i].label) for i, centre in layout.labels.items()),
        ]
    ]
    assert len(areas) == len(boxes) + len(arrows)
    assert not any(overlap(first, second) for first, second in combinations(areas, 2))
    for area in areas:
        assert -1 < area[0] < area[2] < layout.width + 1
        assert -1 < area[1] < area[3] < layout.height + 1


def sampled(points):
    """Points along a cubic Bézier spline."""
    for k in range(0, len(points) - 1, 3):
        for t in (0.1, 0.3, 0.5, 0.7, 0.9):
            weights = ((1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t * t * (1 - t), t**3)
            yield tuple(
                sum(w * point[axis] for w, point in zip(weights, points[k : k + 4], strict=True)) for axis in (0, 1)
            )


@pytest.mark.parametrize("branches", [1, 2, 3, 5])
def test_arrows_of_trees_cross_no_box_and_no_label(branches):
    draw = random.Random(branches)
    boxes = [(draw.randint(40, 300), draw.randint(30, 120)) for _ in range(60)]
    labels = [draw.choice([None, (draw.randint(20, 120), 16)]) for _ in boxes]
    arrows = [Arrow((i - 1) // branches, i, i % 2, labels[i]) for i in range(1, len(boxes))]
    layout = place(boxes, arrows)
    areas = [*layout.boxes.values()]
    areas += [(*centre, *arrows[i].label) for i, centre in layout.labels.items()]
    for pieces in layout.arrows.values():
        for x, y in (point for piece in pieces for point in sampled(piece.points)):
            assert not any(abs(x - area[0]) < area[2] / 2 - 1 and abs(y - area[1]) < area[3] / 2 - 1 for area in areas)


def test_wide_pictures_run_to_the_right_and_long_ones_down():
    def size(diagram):
        _, _, width, height = map(float, Picture(diagram).root.get("viewBox").split())
        return width, height

    assert size(tree(5, branches=4))[0] < PAGE
    assert size(tree(300))[0] < 3 * PAGE < size(tree(300))[1]
    width, height = size(tree(60, branches=1))
    assert 10 * width < height

    # Here it is the labels that are wide.
    assert place([(40, 30)] * 13, [Arrow(0, i, 0, (150, 16)) for i in range(1, 13)]).width < PAGE


# The same picture every time, soon


def test_equal_diagrams_give_equal_text_in_every_process():
    program = "import test_drawing as t; print(*(d.svg() for d in (t.LOOPS, t.tangle(20, 5))))"
    path = os.pathsep.join(entry for entry in [str(Path(__file__).parent), *sys.path] if entry)
    printed = {
        subprocess.run(
            [sys.executable, "-c", program],
            env=os.environ | {"PYTHONHASHSEED": seed, "PYTHONPATH": path, "PYTHONIOENCODING": "utf-8"},
            capture_output=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert printed == {f"{LOOPS.svg()} {tangle(20, 5).svg()}{os.linesep}".encode()}


def test_tree_of_1000_nodes_takes_less_than_two_seconds_and_says_nothing(capfd):
    diagram = tree(1000)
    start = time.process_time()
    text = diagram.svg()
    seconds = time.process_time() - start
    picture = Picture(diagram)
    assert diagram.svg() == text
    assert len(picture.nodes) == 1000
    assert len(picture.edges) == 999
    assert capfd.readouterr() == ("", "")
    assert seconds < 2.0


# Files


@pytest.mark.parametrize(("name", "begins"), [("a.png", b"\x89PNG"), ("a.PNG", b"\x89PNG"), ("a.pdf", b"%PDF")])
def test_saves_what_matplotlib_draws(tmp_path, name, begins):
    LOOPS.save(tmp_path / name)
    assert (tmp_path / name).read_bytes().startswith(begins)


def test_png_has_two_dots_a_pixel_unless_it_grows_too_large(tmp_path):
    def dots(diagram):
        diagram.save(tmp_path / "a.png")
        header = (tmp_path / "a.png").read_bytes()[16:24]
        return int.from_bytes(header[:4]), int.from_bytes(header[4:])

    size = [float(Picture(LOOPS).root.get(name)) for name in ("width", "height")]
    assert dots(LOOPS) == pytest.approx([2 * size[0], 2 * size[1]], abs=2)
    assert dots(Diagram((DiagramNode("long", ("",) * 1200),)))[1] == pytest.approx(2**15, abs=2)


def test_saves_svg(tmp_path):
    POURING.save(str(tmp_path / "pouring.svg"))
    assert (tmp_path / "pouring.svg").read_text(encoding="utf-8") == POURING.svg()


@pytest.mark.parametrize("name", ["a.gif", "a", "a.svg.txt"])
def test_unknown_suffix_names_the_known_ones(tmp_path, name):
    with pytest.raises(InputError, match=r"\.svg, \.png or \.pdf"):
        CANNON.save(tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_missing_matplotlib_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingExtraError, match=r"saving a diagram as \.png .*symgraph\[plots\]"):
        CANNON.save(tmp_path / "a.png")
    CANNON.save(tmp_path / "a.svg")


# Errors


def test_two_nodes_with_one_key_are_refused():
    with pytest.raises(GraphError, match="two nodes have the key 'a'"):
        Diagram(nodes("a", "b", "a"))


def test_edge_without_its_node_is_refused():
    with pytest.raises(GraphError, match=r"edge 'a' → 'c': no node 'c'; there are 'a', 'b'"):
        Diagram(nodes("a", "b"), (DiagramEdge("a", "c"),))
