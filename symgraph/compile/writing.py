"""From programs to C."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from itertools import islice

import casadi as ca
import numpy as np

from symgraph.compile.differentiate import called, handed
from symgraph.compile.loops import Loop, number
from symgraph.compile.meetings import Meetings
from symgraph.compile.program import CALLS, Indices, Operation, Program, Value, constant_of
from symgraph.compile.schedule import Schedule, Step
from symgraph.compile.sharing import PARTS, Costs
from symgraph.errors import CompileError

PART = 1000  # operations of one C function: the compiler's time grows faster than a function's length
MOST_RUNS = 12  # copies that are written out; beyond that a table says what goes where


class Writer:
    """Writes C functions for programs and those that they call, each once.

    A function takes its inputs, its outputs, workspace and the number of lanes. With lanes, a number that is not bound
    is a row of as many numbers, one for each; the function does the same to all of them. A function that several
    threads share also takes the member of their team that calls it; when it returns all of them have done all of it.

    Args:
        plain: write standard C99 that is C++ too, for one point at a time; else for vectors of the processor.
    """

    def __init__(self, plain: bool = False) -> None:
        self.plain = plain
        self.costs = Costs()
        self._functions: dict[tuple[Program, bool, bool], tuple[str, int]] = {}
        self._tables: dict[tuple[str, bytes], str] = {}
        self._externals: dict[int, tuple[ca.Function, ca.Function]] = {}
        self._text: list[str] = []

    def function(self, program: Program, lanes: bool, shared: bool) -> tuple[str, int]:
        """Write a program; return its name, and the numbers of workspace that it takes, for each lane."""
        key = program, lanes, shared
        if key not in self._functions:
            name = f"f{len(self._functions)}"
            self._functions[key] = name, 0  # the name is taken while those that it calls are written
            self._functions[key] = name, _FunctionWriter(self, program, lanes, shared, name).write()
        return self._functions[key]

    def given(self, shared: bool) -> str:
        """Return what a function hands on to a part of itself."""
        return f"arg, res, w{'' if self.plain else ', B'}{', me' * shared}"

    def defined(self, name: str, shared: bool, lines: Sequence[str]) -> None:
        """Add a function with the arguments that all have."""
        body = "\n".join(lines)
        if self.plain:
            head = f"static void {name}(const real *const *arg, real *const *res, real *w)"
            unused = [f"  (void) {arg};" for arg in ("arg", "res", "w") if not re.search(rf"\b{arg}\b", body)]
            body = "\n".join([body, *unused])
        else:
            head = f"static void {name}{signature(shared)}"
        self.add(f"{head} {{\n{body}\n}}")

    @property
    def pieces(self) -> list[str]:
        """Functions and tables, in order."""
        return self._text

    def add(self, text: str) -> None:
        self._text.append(text)

    def table(self, kind: str, numbers: Iterable[float] | Iterable[int]) -> str:
        """Return the name of a table of constants; equal ones are one."""
        written = [repr(n) for n in numbers] if kind == "int" else [number(n) for n in numbers]
        text = ", ".join(written) or "0"  # standard C has no empty arrays
        key = kind, text.encode()
        if key not in self._tables:
            self._tables[key] = f"t{len(self._tables)}"
            self.add(f"static const {kind} {self._tables[key]}[] = {{{text}}};")
        return self._tables[key]

    def external(self, function: ca.Function) -> ca.Function:
        """Return the function under whose name CasADi's code is called.

        Raises:
            CompileError: that code is no strict standard C.
        """
        if self.plain:
            raise CompileError(
                f"{function.name()!r} is or calls a lookup table, a solver or a callback of CasADi's, which cannot be "
                f"written as standard C; write what it does as an expression, or fit a network to it"
            )
        key = hash(function)
        if key not in self._externals:
            inputs, name = function.mx_in(), f"external_{len(self._externals)}"
            self._externals[key] = function, ca.Function(name, inputs, function.call(inputs, False, True))
        return self._externals[key][1]

    def casadi(self) -> str:
        """Return CasADi's code for functions that have no program."""
        if not self._externals:
            return ""
        generator = ca.CodeGenerator("externals", {"with_header": False, "include_math": False})
        for _, wrapped in self._externals.values():
            generator.add(wrapped)
        return generator.dump()


class _FunctionWriter:
    """Writes one program, cut into functions of moderate length."""

    def __init__(self, writer: Writer, program: Program, lanes: bool, shared: bool, name: str) -> None:
        self._writer = writer
        self._program = program
        self._lanes = lanes
        self._name = name
        self._shared = shared
        self._shares = writer.costs.shares(program).part if shared else None
        self._schedule = Schedule(program, lanes, self._shares)
        self._meetings = Meetings(self._schedule, self._shares, writer.costs) if self._shares is not None else None
        calling = [step[0] for step in self._schedule.steps if step[0].code in (*CALLS, "external")]
        # Workspace of what is called: each part has some of its own, what they call together may have all of it.
        self._room_of_part = max((self._room(o) for o in calling if not self._together(o)), default=0)
        together = max((self._room(o) for o in calling if self._together(o)), default=0)
        self._below = max(together, self._room_of_part * (PARTS if shared else 1))
        self._lines: list[str] = []
        self._parts: list[str] = []

    def write(self) -> int:
        count = 0
        for i, step in enumerate(self._schedule.steps):
            begin = len(self._lines)
            self._write_step(step)
            if len(self._lines) > begin:
                self._share(i, begin)
            count += len(step)
            if count >= PART:
                self._end_part()
                count = 0
        self._write_outputs()
        if not self._parts:
            self._writer.defined(self._name, self._shared, self._lines)
            return self._schedule.work + self._below
        self._end_part()
        given = self._writer.given(self._shared)
        self._writer.defined(self._name, self._shared, [f"  {part}({given});" for part in self._parts])
        return self._schedule.work + self._below

    def _room(self, operation: Operation) -> int:
        """Return the workspace of what an operation calls."""
        if operation.code in CALLS:
            together = self._together(operation)
            functions = (self._writer.function(program, self._lanes, together) for program in called(operation))
            return max(work for _, work in functions)
        if operation.code == "external":
            function = self._writer.external(operation.detail)
            count = sum(x.size for x in (*operation.args, *operation.outputs))
            # Doubles, one in the room of two numbers in single precision, and one more to begin where one may.
            return 2 * (count + function.sz_w() + 1)
        return 0

    def _end_part(self) -> None:
        if self._lines:
            name = f"{self._name}_{len(self._parts)}"
            self._writer.defined(name, self._shared, self._lines)
            self._parts.append(name)
            self._lines = []

    # threads

    def _share(self, i: int, begin: int) -> None:
        """Let the thread whose part a step is do it, whose lines begin there, or all of them together."""
        if self._meetings is None:
            return
        due = self._meetings.before(i)
        part = self._part(self._schedule.steps[i][0])
        if part is not None:
            self._by_part(part, begin)
        if due:
            self._lines.insert(begin, "  meet(me);")

    def _part(self, operation: Operation) -> int | None:
        return None if self._shares is None else self._shares[operation]

    def _by_part(self, part: int, begin: int) -> None:
        self._lines[begin:] = [f"  if (me->parts & {1 << part}) {{", *self._lines[begin:], "  }"]

    # where things are

    def _pointer(self, value: Value) -> str:
        """Return where a value begins."""
        numbers = constant_of(value)
        if numbers is not None:
            return self._writer.table("real", numbers.tolist())
        place = self._schedule.place(value)
        base = {"a": f"arg[{place.base[1:]}]", "r": f"res[{place.base[1:]}]", "w": "w"}[place.base[0]]
        # The workspace, unlike inputs and outputs, has only numbers for all lanes, where there are lanes.
        return f"{base} + {place.offset}{' * B' if place.wide else ''}" if place.offset else base

    def _wide(self, value: Value) -> bool:
        return self._schedule.is_wide(value)

    def _each(self, value: Value) -> str:
        """Return how many numbers a value has for each that it has without lanes."""
        return "B" if self._wide(value) else "1"

    # steps

    def _write_step(self, step: Step) -> None:
        operation = step[0]
        if operation.is_elementwise:
            self._write_loop(step)
            return
        getattr(self, f"_write_{str(operation.code).replace(' ', '_')}")(operation)

    def _write_loop(self, step: Step) -> None:
        size = step[0].outputs[0].size
        loop = Loop(self._schedule, self._pointer, size, self._lanes, self._writer.plain)
        for operation in step:
            loop.add(operation)
        stored = [o.outputs[0] for o in step if self._schedule.is_used_later(o.outputs[0], step)]
        self._lines += loop.lines(stored)

    def _write_gather(self, operation: Operation) -> None:
        (result,) = operation.outputs
        self._copy(result, operation.args, operation.detail)

    def _copy(self, result: Value, sources: Sequence[Value], where: Indices) -> None:
        target, wide = self._pointer(result), self._wide(result)
        edges = np.cumsum([0, *(source.size for source in sources)])
        runs = list(islice(_runs(where, edges), MOST_RUNS + 1))
        if len(runs) <= MOST_RUNS:
            for source, begin, step, at, count in runs:
                to = f"{target} + {at}{' * B' if wide else ''}"
                if source < 0:
                    self._lines.append(f"  zero({to}, {count}{' * B' if wide else ''});")
                    continue
                arg = sources[source]
                if self._is_in_place(result, at, arg, begin, step):
                    continue
                come = f"{self._pointer(arg)} + {begin}{' * B' if self._wide(arg) else ''}"
                do = "widen" if wide and not self._wide(arg) else "copy"
                self._lines.append(f"  {do}({to}, {come}, {count}, {step}, {'B' if wide else 1});")
            return
        if (where < 0).any():
            self._lines.append(f"  zero({target}, {result.size}{' * B' if wide else ''});")
        for s, arg in enumerate(sources):
            (places,) = np.nonzero((where >= edges[s]) & (where < edges[s + 1]))
            if places.size and not self._is_in_place(result, int(places[0]), arg, 0, 1):
                pairs = np.stack([places, where[places] - edges[s]], 1)
                table = self._writer.table("int", pairs.ravel().tolist())
                do = "widen" if wide and not self._wide(arg) else "copy"
                pointers = f"{target}, {self._pointer(arg)}"
                self._lines.append(f"  {do}_some({pointers}, {table}, {places.size}, {'B' if wide else 1});")

    def _is_in_place(self, result: Value, at: int, arg: Value, begin: int, step: int) -> bool:
        if constant_of(self._schedule.source(arg)) is not None or step != 1:
            return False
        there, here = self._schedule.place(result), self._schedule.place(arg)
        return there.wide == here.wide and (there.base, there.offset + at) == (here.base, here.offset + begin)

    def _write_spread(self, operation: Operation) -> None:
        self._copy(operation.outputs[0], operation.args, np.arange(operation.args[0].size))

    def _write_transpose(self, operation: Operation) -> None:
        rows, columns = operation.detail
        arg, result = operation.args[0], operation.outputs[0]
        self._lines.append(
            f"  transpose({self._pointer(result)}, {self._pointer(arg)}, {rows}, {columns}, {self._each(result)});"
        )

    def _write_product(self, operation: Operation) -> None:
        (left, right), (result,) = operation.args, operation.outputs
        pointers = ", ".join(map(self._pointer, (left, right, result)))
        m, k, n = operation.detail
        if self._wide(result):
            each = f"{self._each(left)}, {self._each(right)}"
            self._lines.append(f"  multiply_lanes({pointers}, {m}, {k}, {n}, {each}, B);")
        else:
            self._lines.append(f"  multiply({pointers}, {m}, {k}, {n});")

    def _write_pack(self, operation: Operation) -> None:
        m, k, transposed = operation.detail
        pointers = ", ".join(map(self._pointer, (*operation.args, *operation.outputs)))
        strides = f"{k}, 1" if transposed else f"1, {m}"
        self._lines.append(f"  pack({pointers}, {m}, {k}, {strides});")

    def _write_packed_product(self, operation: Operation) -> None:
        m, k, n, squared = operation.detail
        pointers = ", ".join(map(self._pointer, (*operation.args, *operation.outputs)))
        do = "multiply_packed_lanes" if self._lanes else ("multiply_squares" if squared else "multiply_packed")
        self._lines.append(f"  {do}({pointers}, {m}, {k}, {n}{', B' if self._lanes else ''});")

    def _write_weighted_product(self, operation: Operation) -> None:
        m, k, n, transposed, squared = operation.detail
        pointers = ", ".join(map(self._pointer, (*operation.args, *operation.outputs)))
        do = ("multiply", "multiply_transposed")[transposed] + "_squares" * squared
        self._lines.append(f"  {do}({pointers}, {m}, {k}, {n});")

    def _write_packed_pair(self, operation: Operation) -> None:
        pointers = ", ".join(map(self._pointer, (*operation.args, *operation.outputs)))
        self._lines.append(f"  multiply_pair({pointers}, {', '.join(map(str, operation.detail))});")

    def _write_accumulate(self, operation: Operation) -> None:
        result = operation.outputs[0]
        table = self._writer.table("int", np.stack(operation.detail, 1).ravel().tolist())
        terms = len(operation.detail[0])
        width = "B" if self._wide(result) else "1"
        self._lines.append(f"  zero({self._pointer(result)}, {result.size} * {width});")
        args = ", ".join(f"{self._pointer(arg)}, {self._each(arg)}" for arg in operation.args)
        do = ("add_some", "add_products")[len(operation.args) - 1]
        self._lines.append(f"  {do}({self._pointer(result)}, {table}, {terms}, {args}, {width});")

    # calls

    def _call(
        self, caller: Operation, program: Program, args: Sequence[str], results: Sequence[str], indent: str = "  "
    ) -> list[str]:
        shared = self._together(caller)
        name, _ = self._writer.function(program, self._lanes, shared)
        given, made = ", ".join(args) or "0", ", ".join(results) or "0"
        return [
            f"{indent}{{ const real *const x[] = {{{given}}};",
            f"{indent}  real *const y[] = {{{made}}};",
            f"{indent}  {name}(x, y, {self._free(caller)}{'' if self._writer.plain else ', B'}{', me' * shared}); }}",
        ]

    def _together(self, operation: Operation) -> bool:
        """Whether all threads call what an operation calls, and share it."""
        return self._shared and self._part(operation) is None

    def _free(self, operation: Operation) -> str:
        """Return where workspace for what an operation calls begins."""
        begin = self._schedule.work + (self._part(operation) or 0) * self._room_of_part
        return f"w + {begin}{' * B' if self._lanes else ''}"

    def _write_call(self, operation: Operation) -> None:
        args, results = map(self._pointer, operation.args), map(self._pointer, operation.outputs)
        self._lines += self._call(operation, operation.detail, list(args), list(results))

    def _write_switch(self, operation: Operation) -> None:
        index = self._pointer(operation.args[0])
        results = list(map(self._pointer, operation.outputs))
        cases = operation.detail
        self._lines.append(f"  switch ((long) ({index})[0]) {{")
        for i, (case, own) in enumerate(zip(cases, handed(operation), strict=True)):
            args = list(map(self._pointer, own))
            self._lines.append(f"    {'default' if i == len(cases) - 1 else f'case {i}'}:")
            self._lines += self._call(operation, case, args, results, "      ")
            self._lines.append("      break;")
        self._lines.append("  }")

    def _write_repeat(self, operation: Operation) -> None:
        program, times = operation.detail

        def moving(value: Value) -> str:
            part = f"{value.size // times}{' * B' if self._wide(value) else ''}"
            return f"{self._pointer(value)} + i * {part}"

        args, results = list(map(moving, operation.args)), list(map(moving, operation.outputs))
        self._lines.append(f"  {{ long i; for (i = 0; i < {times}; ++i)")
        self._lines += self._call(operation, program, args, results, "    ")
        self._lines.append("  }")

    def _write_external(self, operation: Operation) -> None:
        """CasADi's own code does one lane after the other, with doubles of its own."""
        function = self._writer.external(operation.detail)
        wide = self._wide(operation.outputs[0])
        lines = [
            "  { long l;",
            f"    const double *x[{function.sz_arg() + 1}]; double *y[{function.sz_res() + 1}];",
            f"    casadi_int iw[{function.sz_iw() + 1}]; int failed;",
            f"    double *const s = doubles({self._free(operation)});",
            f"    for (l = 0; l < {'B' if wide else 1}; ++l) {{",
        ]
        at = 0
        for i, arg in enumerate(operation.args):
            lines.append(f"      x[{i}] = s + {at};")
            lines.append(f"      take({self._pointer(arg)}, {self._each(arg)}, l, s + {at}, {arg.size});")
            at += arg.size
        outs = []
        for i, result in enumerate(operation.outputs):
            lines.append(f"      y[{i}] = s + {at};")
            outs.append(
                f"      put({self._pointer(result)}, {self._each(result)}, l, s + {at}, {result.size}, failed);"
            )
            at += result.size
        lines.append(f"      failed = {function.name()}(x, y, iw, s + {at}, 0);")
        self._lines += [*lines, *outs, "    } }"]

    def _write_outputs(self) -> None:
        begin = len(self._lines)
        for i, value in enumerate(self._program.outputs):
            constant = constant_of(self._schedule.source(value))
            if constant is None and self._schedule.place(value).base == f"r{i}":
                continue
            if value.size:
                each = self._each(value)
                self._lines.append(f"  copy(res[{i}], {self._pointer(value)}, {value.size}, 1, {each});")
        if self._meetings is not None:
            copies = len(self._lines) > begin
            if copies:
                self._by_part(0, begin)
            if self._meetings.before_end():
                self._lines.insert(begin, "  meet(me);")
            if copies:
                self._lines.append("  meet(me);")


def signature(shared: bool) -> str:
    """Return the arguments of a function."""
    return f"(const real *const *arg, real *const *res, real *w, long B{', struct member *me' * shared})"


def _runs(where: Indices, edges: Indices) -> Iterable[tuple[int, int, int, int, int]]:
    """Split indices into runs of equal steps: (source or -1, its first number, step, place in the result, count)."""
    if not where.size:
        return
    owner = np.where(where >= 0, np.searchsorted(edges, where, side="right") - 1, -1)
    at = 0
    while at < where.size:
        source = int(owner[at])
        if source < 0:
            others = np.flatnonzero(owner[at:] >= 0)
            end = at + int(others[0]) if others.size else where.size
            yield -1, 0, 0, at, end - at
        else:
            step = int(where[at + 1] - where[at]) if at + 1 < where.size and owner[at + 1] == source else 1
            here = where[at:]
            kept = (owner[at:] == source) & (here == where[at] + step * np.arange(here.size))
            breaks = np.flatnonzero(~kept)
            end = at + int(breaks[0]) if breaks.size else where.size
            yield source, int(where[at] - edges[source]), step, at, end - at
        at = end
