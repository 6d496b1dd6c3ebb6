"""Elementwise operations as loops in C: along lanes, or along an array where there are none."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from symgraph.compile.elementwise import expression
from symgraph.compile.program import Operation, Value, constant_of
from symgraph.compile.schedule import Schedule


def number(value: float) -> str:
    """Return a number as C has it."""
    value = float(value)
    if np.isnan(value):
        return "NAN"
    if np.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return repr(value)


class Loop:
    """Writes elementwise operations on arrays of one size as one loop.

    Args:
        schedule: where values are.
        pointer: C for where a value begins.
        size: of the arrays.
        lanes: whether there are lanes.
        plain: in standard C, number by number; else with vectors of the processor.
    """

    def __init__(
        self, schedule: Schedule, pointer: Callable[[Value], str], size: int, lanes: bool, plain: bool
    ) -> None:
        self._schedule = schedule
        self._pointer = pointer
        self._size = size
        self._lanes = lanes
        self._plain = plain
        self._vector = not plain and (lanes or size > 1)
        self._names: dict[Value, str] = {}
        self._body: list[str] = []
        self._in_step = True  # all arrays in step, element by element and lane by lane

    def add(self, operation: Operation) -> None:
        args = [self._read(arg) for arg in operation.args]
        kind = "vec" if self._vector else "real"
        text = expression(int(operation.code), args, "v" if self._vector else "s")
        self._body.append(f"const {kind} {self._name(operation.outputs[0])} = {text};")

    def _name(self, value: Value) -> str:
        self._names[value] = f"v{len(self._names)}"
        return self._names[value]

    def _read(self, value: Value) -> str:
        root = self._schedule.source(value)
        if value in self._names:
            return self._names[value]
        if root in self._names and root.size == value.size:
            return self._names[root]
        numbers = constant_of(value)
        if numbers is not None and numbers.size == 1:
            text = f"all({number(numbers[0])})" if self._vector else f"(real) {number(numbers[0])}"
        else:
            pointer, single, wide = self._pointer(value), value.size < self._size, self._schedule.is_wide(value)
            if not self._vector:
                text = f"*({pointer})" if single or self._size == 1 else f"({pointer})[i]"
            elif self._lanes and wide:
                text = f"load({pointer} + {'l' if single and self._size > 1 else 'i'})"
                self._in_step = self._in_step and not (single and self._size > 1)
            elif self._lanes:
                text = f"all(({pointer})[{'0' if single or self._size == 1 else 'e'}])"
                self._in_step = self._in_step and (single or self._size == 1)
            elif single:
                text = f"all(*({pointer}))"
            else:
                text = f"load_some({pointer} + i, {self._size} - i)"
        kind = "vec" if self._vector else "real"
        name = self._name(value)
        self._body.append(f"const {kind} {name} = {text};")
        return name

    def lines(self, stored: Sequence[Value]) -> list[str]:
        """Return the loop, which ends by storing values."""
        for value in stored:
            pointer, name = self._pointer(value), self._names[value]
            if not self._vector:
                self._body.append(f"({pointer})[i] = {name};" if self._size > 1 else f"*({pointer}) = {name};")
            elif self._lanes:
                self._body.append(f"store({pointer} + i, {name});")
            else:
                self._body.append(f"store_some({pointer} + i, {name}, {self._size} - i);")
        if not self._vector and self._size > 1:
            return [
                f"  {{ long i; for (i = 0; i < {self._size}; ++i) {{",
                *(f"    {line}" for line in self._body),
                "  } }",
            ]
        if not self._vector:
            head = ["  {"]
        elif not self._lanes:
            head = [f"  {{ long i; for (i = 0; i < {self._size}; i += VL) {{"]
        elif self._in_step:
            head = [f"  {{ long i; for (i = 0; i < {self._size} * B; i += VL) {{"]
        else:
            loops = f"for (e = 0; e < {self._size}; ++e) for (l = 0; l < B; l += VL) {{"
            head = [f"  {{ long e, l; {loops}", "    const long i = e * B + l;"]
        tail = ["  } }"] if self._vector else ["  }"]
        return [*head, *(f"    {line}" for line in self._body), *tail]
