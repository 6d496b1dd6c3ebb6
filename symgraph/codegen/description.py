"""What a generated planner is of: its slots, tree and settings, in words and numbers that need no Python to be read."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from typing import Any

from symgraph.codegen.foresight import Write
from symgraph.constraints import Constraint
from symgraph.errors import InputError
from symgraph.expectation import Expectation
from symgraph.objective import Objective

FORMAT = 1  # of the description

# Keywords of C and C++, and names that programs must not take.
_C_WORDS = frozenset(
    """
    NULL and_eq or_eq xor_eq not_eq dynamic_cast co_await co_return co_yield consteval constinit typeof linux unix
    alignas alignof and asm auto bitand bitor bool break case catch char char16_t char32_t char8_t class compl
    complex concept const constexpr continue decltype default delete do double else enum explicit export
    extern false float for friend goto if imaginary inline int long main mutable namespace new noexcept not
    nullptr operator or private protected public register reinterpret_cast requires restrict return short
    signed sizeof static static_assert static_cast struct switch template this thread_local throw true try
    typedef typeid typename union unsigned using virtual void volatile wchar_t while xor
    """.split()  # noqa: SIM905 a list of them would be a page
)


_HEADERS = frozenset(
    """
    assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdalign stdarg stdatomic
    stdbool stddef stdint stdio stdlib stdnoreturn string tgmath threads time uchar wchar wctype
    """.split()  # noqa: SIM905
)


@dataclass(frozen=True)
class ActionSlot:
    """An action as C has it; bounds are one number per element [unit]."""

    label: str
    name: str
    size: int
    unit: str | None
    low: tuple[float, ...]
    high: tuple[float, ...]


@dataclass(frozen=True)
class SelectionSlot:
    """A selection as C has it."""

    label: str
    name: str
    choices: tuple[str, ...]
    choice_names: tuple[str, ...]


@dataclass(frozen=True)
class StateSlot:
    """A state that the task reads or writes; `given`: part of the start state; `uncertain`: with a covariance there."""

    label: str
    name: str
    size: int
    unit: str | None
    given: bool
    uncertain: bool


@dataclass(frozen=True)
class Node:
    """A node of the tree; nodes with the same group exclude each other."""

    path: str
    name: str
    node: str
    parent: int
    group: int
    cut: bool


@dataclass(frozen=True)
class Demand:
    """A constraint: where and what, the number it is compared with, and the (selection, choice) that lead to it."""

    told: str
    bound: float
    equality: bool
    way: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Description:
    """All that a planner's header, its manual and its Python wrapper say.

    Attributes:
        task: a number that tells tasks, and so their weights, apart.
        weights: how many numbers the models' parameters come to.
    """

    format: int
    name: str
    precision: str
    weights_in: str
    optimizer: str
    settings: dict[str, Any]
    risk: float
    cut_value: float
    actions: tuple[ActionSlot, ...]
    selections: tuple[SelectionSlot, ...]
    states: tuple[StateSlot, ...]
    nodes: tuple[Node, ...]
    writes: tuple[tuple[int, int, int, int], ...]  # node, state, where its mean and its covariance (or -1) begin
    moments: int
    demands: tuple[Demand, ...]
    most_starts: int
    unread: tuple[str, ...] = ()  # states that nothing needs
    version: str = ""
    task: int = 0
    weights: int = 0
    memory: int = 0
    stack: int = 0
    notes: tuple[str, ...] = ()

    @property
    def given(self) -> tuple[StateSlot, ...]:
        return tuple(slot for slot in self.states if slot.given)

    @property
    def decided(self) -> list[str]:
        """Labels of actions and selections."""
        return [slot.label for slot in self.actions] + [slot.label for slot in self.selections]

    @property
    def units(self) -> dict[str, str]:
        """{label: unit} of the actions and states that have one."""
        found = {slot.label: slot.unit for slot in self.actions} | {slot.label: slot.unit for slot in self.states}
        return {label: unit for label, unit in found.items() if unit}

    def with_sizes(self, task: int, weights: int, memory: int, stack: int) -> Description:
        return replace(self, task=task, weights=weights, memory=memory, stack=stack)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, read: dict[str, Any]) -> Description:
        """Return what `to_dict` made, after a round through JSON."""

        def listed(kind: type, rows: Iterable[dict[str, Any]]) -> tuple[Any, ...]:
            return tuple(kind(**{key: _tuples(value) for key, value in row.items()}) for row in rows)

        kinds: dict[str, type] = {
            "actions": ActionSlot,
            "selections": SelectionSlot,
            "states": StateSlot,
            "nodes": Node,
            "demands": Demand,
        }
        made: dict[str, Any] = {
            key: listed(kinds[key], value) if key in kinds else _tuples(value) for key, value in read.items()
        }
        return cls(**made)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def describe(
    objective: Objective,
    expectation: Expectation,
    writes: Sequence[Write],
    name: str,
    precision: str,
    weights_in: str,
    optimizer: str,
    settings: dict[str, Any],
    most_starts: int,
    notes: Sequence[str],
) -> Description:
    """Describe a task in C's terms."""
    slots = objective.graph.slots
    tree = objective.tree
    selections = objective.graph.selections()
    actions = objective.graph.actions()
    labels = dict.fromkeys([*tree.needed_states, *(write.label for write in writes)])
    taken = [f"{name}_covariance" for name in c_names(expectation.inputs.uncertain)]  # members of the state too
    words = [*actions, *selections, *labels]
    fields = dict(zip(words, c_names([*taken, *words])[len(taken) :], strict=True))
    order = list(labels)
    sizes = {label: int(slots[label].size) for label in labels}  # NumPy's numbers do not go into JSON
    places = [(w.node, order.index(w.label), w.mean, w.covariance) for w in writes]
    ends = [w.mean + sizes[w.label] + (sizes[w.label] ** 2 if w.covariance >= 0 else 0) for w in writes]
    return Description(
        format=FORMAT,
        name=name,
        precision=precision,
        weights_in=weights_in,
        optimizer=optimizer,
        settings=settings,
        risk=objective.risk,
        cut_value=float(tree.cut_value),
        actions=tuple(
            ActionSlot(
                label, fields[label], slot.size, slot.unit, tuple(slot.lower.tolist()), tuple(slot.upper.tolist())
            )
            for label, slot in actions.items()
        ),
        selections=tuple(
            SelectionSlot(label, fields[label], tuple(slot.choices), tuple(c_names(slot.choices)))
            for label, slot in selections.items()
        ),
        states=tuple(
            StateSlot(
                label,
                fields[label],
                sizes[label],
                objective.graph.states()[label].unit,
                label in tree.needed_states,
                label in expectation.inputs.uncertain,
            )
            for label in labels
        ),
        nodes=_nodes(objective),
        writes=tuple(places),
        moments=max(ends, default=0),
        demands=tuple(_demand(objective, one) for one in expectation.constraints),
        most_starts=most_starts,
        unread=tuple(label for label in objective.graph.states() if label not in labels),
        version=_version(),
        notes=tuple(notes),
    )


def _version() -> str:
    try:
        return metadata.version("symgraph")
    except metadata.PackageNotFoundError:  # run from its folder, without being installed
        return ""


def _nodes(objective: Objective) -> tuple[Node, ...]:
    tree = objective.tree
    group_of: dict[int, int] = {0: 0}
    for node in tree.nodes:
        for group in node.groups:
            children = [branch.child for branch in group.branches if branch.child is not None]
            group_of |= dict.fromkeys(children, children[0] if children else 0)  # a group is known by its first child
    paths = [tree.path(node.index) for node in tree.nodes]
    names = c_names(paths)
    return tuple(
        Node(path, name, node.name, node.parent if node.parent is not None else -1, group_of[node.index], node.cut)
        for path, name, node in zip(paths, names, tree.nodes, strict=True)
    )


def _demand(objective: Objective, one: Constraint) -> Demand:
    selections = objective.graph.selections()
    labels = list(selections)
    way = tuple((labels.index(label), selections[label].choices.index(choice)) for label, choice in one.way.items())
    return Demand(one.told(objective.tree), one.bound, one.is_equality, way)


def c_names(words: Iterable[str]) -> list[str]:
    """Return different C identifiers for words."""
    made: dict[str, None] = {}
    for word in words:
        plain = re.sub(r"_+", "_", re.sub(r"\W", "_", word, flags=re.ASCII)).strip("_") or "x"
        if plain[0].isdigit() or plain in _C_WORDS:
            plain = f"{plain}_" if plain in _C_WORDS else f"n{plain}"
        name, number = plain, 2
        while name in made:
            name, number = f"{plain}_{number}", number + 1
        made[name] = None
    return list(made)


def checked_name(name: object) -> str:
    """Return the prefix of all public names, or raise InputError."""
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) or name in _C_WORDS:
        raise InputError(f"export_c: name = {name!r}; give a C identifier, e.g. 'cannon'")
    if name.lower() in (*_HEADERS, "main"):  # name.h would be taken for the library's, Main.c for main.c
        raise InputError(
            f"export_c: name = {name!r} is that of a file of C's; give another one, e.g. 'my_{name.lower()}'"
        )
    return name
