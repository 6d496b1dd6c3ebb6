"""In which order a program's operations are carried out, which of them in one loop, and where values are kept."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from symgraph.compile.hoist import is_run
from symgraph.compile.program import Kind, Operation, Program, Value, constant_of

LONGEST = {True: 256, False: 96}  # elementwise operations of one loop: on single numbers, on arrays

_MOVES = ("gather", "accumulate", "spread")  # operations that cost little

Step = list[Operation]  # one operation, or elementwise ones on arrays of the same size
Loop = tuple[int, int | None]  # that size, and the part of a shared program that they belong to


@dataclass(frozen=True)
class Place:
    """Where a value begins: `offset` numbers, each for all lanes if it is `wide`, behind a pointer of the C code."""

    base: str
    offset: int
    wide: bool


class Schedule:
    """Steps of a program, and where its values are.

    Args:
        program: what to carry out.
        lanes: whether values have a number for each of several points.
        parts: the program's operations in another order, if threads share it, and which part each is of.

    Attributes:
        steps: in order.
        work: numbers of workspace, each for all lanes if there are lanes.
    """

    def __init__(self, program: Program, lanes: bool, parts: Mapping[Operation, int | None] | None = None) -> None:
        self._program = program
        self._lanes = lanes
        self._operations = list(program.operations if parts is None else parts)
        self._parts = dict.fromkeys(self._operations, 0) if parts is None else parts
        self._divided = parts is not None
        self._aliases: dict[Value, tuple[Value, int]] = {}  # value → the one that it is a part of, and from where on
        for operation in self._operations:
            if operation.code == "held" or is_view(operation):
                offset = 0 if operation.code == "held" else int(operation.detail[0])
                self._aliases[operation.outputs[0]] = operation.args[0], offset
        self.steps = list(self._make_steps())
        self._join()
        self._bases: dict[Value, tuple[str, int]] = {}
        for i, value in enumerate(program.inputs):
            self._bases[value] = f"a{i}", 0
        for i, value in enumerate(program.outputs):
            root, offset = self._root(value)
            free = root.maker is not None and root not in self._bases and constant_of(root) is None
            if free and offset == 0 and root.size == value.size:
                self._bases[root] = f"r{i}", 0
        self.work = self._allocate()

    def place(self, value: Value) -> Place:
        """Return where a value that is no constant is kept."""
        root, offset = self._root(value)
        base, begin = self._bases[root]
        return Place(base, begin + offset, self.is_wide(value))

    def is_wide(self, value: Value) -> bool:
        """Whether a value has a number for each lane."""
        return self._lanes and value.kind > Kind.BOUND

    def source(self, value: Value) -> Value:
        """Return the value that this one is a part of, or the constant that it is."""
        return self._root(value)[0]

    def is_used_later(self, value: Value, step: Step) -> bool:
        """Whether any other step, or the caller, reads a value."""
        return value in self._outside[id(step)]

    def _root(self, value: Value) -> tuple[Value, int]:
        offset = 0
        while value in self._aliases:
            value, begin = self._aliases[value]
            offset += begin
        return value, offset

    def _made_by(self, value: Value) -> Operation | None:
        return self._root(value)[0].maker

    def _make_steps(self) -> Iterator[Step]:
        """Put elementwise operations on equally long arrays together, as long as nothing in between needs them."""
        open_steps: dict[Loop, Step] = {}
        owner: dict[Operation, Loop] = {}

        def close(loop: Loop) -> Step:
            step = open_steps.pop(loop)
            for operation in step:
                owner.pop(operation, None)
            return step

        for operation in self._operations:
            if operation.code == "constant" or operation.outputs[0] in self._aliases:
                continue
            size = operation.outputs[0].size
            here = (size, self._parts[operation]) if operation.is_elementwise else None
            needed: dict[Loop, None] = {}
            for arg in operation.args:
                maker = self._made_by(arg)
                # One number of an array is complete only after the loop that makes the array.
                if maker is not None and maker in owner and not (owner[maker] == here and size == arg.size):
                    needed[owner[maker]] = None
            if self._divided and operation.code not in _MOVES and here is None:
                needed = dict.fromkeys(open_steps)  # what others need of these must not wait for this operation
            for other in needed:
                yield close(other)
            if here is None:
                yield [operation]
                continue
            open_steps.setdefault(here, []).append(operation)
            owner[operation] = here
            if len(open_steps[here]) >= LONGEST[size == 1]:
                yield close(here)
        for loop in list(open_steps):
            yield close(loop)

    def _join(self) -> None:
        """Let values that are put one after the other be written there in the first place."""
        made = {output: operation for step in self.steps for operation in step for output in operation.outputs}
        for operation in self._operations:
            whole = operation.outputs[0]
            if operation.code != "gather" or not is_concatenation(operation) or whole not in made:
                continue
            begin = 0
            for arg in operation.args:
                fits = arg in made and arg not in self._aliases and self.is_wide(arg) == self.is_wide(whole)
                if fits and self._root(whole)[0] is not arg:
                    self._aliases[arg] = whole, begin
                begin += arg.size

    def _allocate(self) -> int:
        """Give values places in the workspace, from the step that first writes them to the last one that reads them."""
        first: dict[Value, int] = {}
        last: dict[Value, int] = {}
        readers: dict[Value, set[int]] = {}
        lent: set[Value] = set()  # to other parts: where it is kept its own part cannot write without waiting for them
        for s, step in enumerate(self.steps):
            for operation in step:
                for value in (*operation.args, *operation.outputs):
                    root = self._root(value)[0]
                    first.setdefault(root, s)
                    last[root] = s
                for arg in operation.args:
                    root = self._root(arg)[0]
                    readers.setdefault(arg, set()).add(s)
                    readers.setdefault(root, set()).add(s)
                    if self._parts[operation] not in (None, self._part_of(root)):
                        lent.add(root)
        end = len(self.steps)
        for value in self._program.outputs:
            root = self._root(value)[0]
            last[root] = end
            readers.setdefault(value, set()).add(end)
            readers.setdefault(root, set()).add(end)
        joined = {value for value in self._aliases if value.maker is not None and not is_view(value.maker)}
        self._outside = {
            id(step): {
                output
                for operation in step
                for output in operation.outputs
                if output in joined or readers.get(output, set()) - {s}
            }
            for s, step in enumerate(self.steps)
        }
        ends: dict[int, list[Value]] = {}
        begins: dict[int, list[Value]] = {}
        for root, s in first.items():
            if root not in self._bases and constant_of(root) is None and root.maker is not None:
                begins.setdefault(s, []).append(root)
                ends.setdefault(last[root], []).append(root)
        # Each part has memory of its own: it need not wait for others to write to it.
        memories: dict[int, _Memory] = defaultdict(_Memory)
        offsets: dict[Value, int] = {}
        for s in range(end):
            for root in begins.get(s, []):
                offsets[root] = memories[self._part_of(root)].take(root.size)
            for root in ends.get(s, []):
                if root not in lent:
                    memories[self._part_of(root)].give(offsets[root], root.size)
        begin = dict(zip(memories, accumulate((memory.size for memory in memories.values()), initial=0), strict=False))
        for root, offset in offsets.items():
            self._bases[root] = "w", begin[self._part_of(root)] + offset
        return sum(memory.size for memory in memories.values())

    def _part_of(self, root: Value) -> int:
        return (self._parts[root.maker] if root.maker is not None else None) or 0


class _Memory:
    """Where arrays are put: at the first gap that is long enough."""

    def __init__(self) -> None:
        self.size = 0
        self._gaps: list[tuple[int, int]] = []  # offset and length, by offset

    def take(self, length: int) -> int:
        for i, (offset, gap) in enumerate(self._gaps):
            if gap >= length:
                self._gaps[i : i + 1] = [(offset + length, gap - length)] if gap > length else []
                return offset
        offset = self.size
        if self._gaps and sum(self._gaps[-1]) == self.size:  # the last gap reaches the end
            offset = self._gaps.pop()[0]
        self.size = offset + length
        return offset

    def give(self, offset: int, length: int) -> None:
        at = int(np.searchsorted([gap[0] for gap in self._gaps], offset)) if self._gaps else 0
        self._gaps.insert(at, (offset, length))
        for i in (at, at - 1):  # joined with its neighbours
            if 0 <= i < len(self._gaps) - 1 and sum(self._gaps[i]) == self._gaps[i + 1][0]:
                self._gaps[i : i + 2] = [(self._gaps[i][0], self._gaps[i][1] + self._gaps[i + 1][1])]


def is_view(operation: Operation) -> bool:
    """Whether an operation returns consecutive numbers of an array, so that nothing need be done."""
    return operation.code == "gather" and len(operation.args) == 1 and is_run(operation.detail)


def is_concatenation(operation: Operation) -> bool:
    """Whether an operation returns arrays one after the other."""
    size = sum(arg.size for arg in operation.args)
    return len(operation.args) > 1 and operation.detail.size == size and is_run(operation.detail)
