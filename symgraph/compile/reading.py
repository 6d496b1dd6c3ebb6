"""From CasADi functions to programs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import numpy as np

from symgraph.compile.elementwise import ELEMENTWISE
from symgraph.compile.program import Indices, Kind, Program, Value
from symgraph.compile.rules import adjoint_of
from symgraph.errors import CompileError

INLINED = 64  # instructions up to which a function that is called several times is written out each time

Kinds = tuple[Kind, ...]


class Reader:
    """Reads a function and those that it calls; what stands for them is kept and used again.

    Functions are told apart by hash, which is that of CasADi's object: wrappers of one object are not equal.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        self._programs: dict[tuple[int, Kinds], Program] = {}
        self._sites = _call_sites(function)
        self._lengths: dict[int, int] = {}

    def program(self, kinds: Sequence[Kind], function: ca.Function | None = None) -> Program:
        """Return the program of a function, given what its inputs follow from."""
        function = self._function if function is None else function
        key = hash(function), tuple(kinds)
        if key not in self._programs:
            sizes = [function.nnz_in(i) for i in range(function.n_in())]
            program = Program(function.name(), [Value(size, kind) for size, kind in zip(sizes, kinds, strict=True)])
            program.outputs = tuple(self.write(program, function, program.inputs))
            self._programs[key] = program
        return self._programs[key]

    def write(self, program: Program, function: ca.Function, inputs: Sequence[Value]) -> list[Value]:
        """Write what a function does to values into a program."""
        if function.is_a("SXFunction") and not _calls(function):
            return write_scalars(program, function, inputs)
        if function.is_a("MXFunction"):
            return _MatrixWriter(self, program, function, inputs).run()
        return self._called(program, function, inputs)

    def write_call(self, program: Program, function: ca.Function, args: Sequence[Value]) -> list[Value]:
        """Write a call of a function: what it does, where that is little or done nowhere else, or the call itself."""
        kept = [a if follows else program.held(a) for a, follows in zip(args, function.is_diff_in(), strict=True)]
        results = self._called(program, function, kept)
        return [r if follows else program.held(r) for r, follows in zip(results, function.is_diff_out(), strict=True)]

    def _called(self, program: Program, function: ca.Function, args: Sequence[Value]) -> list[Value]:
        sizes = [function.nnz_out(i) for i in range(function.n_out())]
        kinds = [arg.kind for arg in args]
        rule = adjoint_of(function)
        if rule is not None:
            return _write_ruled(program, function, rule, args)
        if function.is_a("MXFunction") or (function.is_a("SXFunction") and not _calls(function)):
            if self._sites[hash(function)] <= 1 or self._length(function) <= INLINED:
                return self.write(program, function, args)
            return list(program.add("call", tuple(args), self.program(kinds, function), sizes, hash(function)))
        if function.class_name() == "Switch" and args[0].kind < Kind.LANE:
            info = function.info()
            if not info["project_in"] and not info["project_out"]:
                cases = (*info["f"], info["f_def"])
                programs = tuple(self.program(kinds[1:], case) for case in cases)
                return list(program.add("switch", tuple(args), programs, sizes, tuple(map(hash, cases))))
        if function.class_name() == "Map":
            info = function.info()
            inner, times = info["f"], info["n"]
            rule = adjoint_of(inner)
            if rule is not None:
                return _write_ruled(program, inner, rule, args)
            if (
                inner.is_a("SXFunction")
                and not _calls(inner)
                and all(inner.numel_in(i) == 1 for i in range(inner.n_in()))
                and all(inner.numel_out(i) == 1 for i in range(inner.n_out()))
            ):
                return write_scalars(program, inner, args, each=True)
            detail = (self.program(kinds, inner), times)
            return list(program.add("repeat", tuple(args), detail, sizes, (hash(inner), times)))
        return list(program.add("external", tuple(args), function, sizes, hash(function)))

    def _length(self, function: ca.Function) -> int:
        """Return how many instructions a function comes to with all that it calls."""
        key = hash(function)
        if key not in self._lengths:
            own = function.n_instructions() if function.is_a("SXFunction") or function.is_a("MXFunction") else INLINED
            self._lengths[key] = own + sum(map(self._length, _called_by(function)))
        return self._lengths[key]


def _call_sites(function: ca.Function) -> Counter[int]:
    """Count the places that call each function, over all functions that are ever called."""
    sites: Counter[int] = Counter()
    waiting = [function]
    while waiting:
        for called in _called_by(waiting.pop()):
            sites[hash(called)] += 1
            if sites[hash(called)] == 1:
                waiting.append(called)
    return sites


def _called_by(function: ca.Function) -> list[ca.Function]:
    if function.class_name() == "Switch":
        info = function.info()
        return [*info["f"], info["f_def"]]
    if function.class_name() == "Map":
        return [function.info()["f"]] * 2  # its body is written once, apart
    if not function.is_a("MXFunction"):
        return []
    calls = [k for k in range(function.n_instructions()) if function.instruction_id(k) == ca.OP_CALL]
    return [function.instruction_MX(k).which_function() for k in calls]


def _calls(function: ca.Function) -> bool:
    """Whether scalar code calls functions, which CasADi lets it do with interpolants."""
    return any(function.instruction_id(k) == ca.OP_CALL for k in range(function.n_instructions()))


def write_scalars(
    program: Program, function: ca.Function, inputs: Sequence[Value], each: bool = False, spread: bool = True
) -> list[Value]:
    """Write a function of scalar instructions.

    Args:
        program: to write into.
        function: what to write.
        inputs: its inputs.
        each: do it for each number of inputs that it takes one of.
        spread: results have a number for each, even where all are the same.
    """
    work: dict[int, Value] = {}
    results: list[list[Value | None]] = [[None] * function.nnz_out(i) for i in range(function.n_out())]
    for k in range(function.n_instructions()):
        code, args, outs = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
        if code == ca.OP_INPUT:
            source = inputs[args[0]]
            work[outs[0]] = source if each else program.element(source, args[1])
        elif code == ca.OP_OUTPUT:
            results[outs[0]][outs[1]] = work[args[0]]
        elif code == ca.OP_CONST:
            work[outs[0]] = program.constant(function.instruction_constant(k))
        elif code not in ELEMENTWISE:
            raise CompileError(f"{function.name()}: CasADi's operation {code} has no C code; please report it")
        else:
            work[outs[0]] = program.elementwise(code, *(work[i] for i in args))
    zero = program.constant(0.0)
    if each:
        size = max(arg.size for arg in inputs)
        columns = [values[0] or zero if values else program.constant(np.zeros(0)) for values in results]
        return [_spread(program, column, size) if spread else column for column in columns]
    return [
        program.concatenate([value or zero for value in values]) if values else program.constant(np.zeros(0))
        for values in results
    ]


def _write_ruled(program: Program, function: ca.Function, rule: ca.Function, args: Sequence[Value]) -> list[Value]:
    """Write a function of scalars that has its own reverse derivative, for each number of its inputs."""
    results = write_scalars(program, function, args, each=True)
    if max(arg.kind for arg in args) < Kind.LANE:
        return results
    given = (*results, *args)
    return list(program.add("ruled", given, (len(results), rule), [result.size for result in results], hash(rule)))


def _spread(program: Program, value: Value, size: int) -> Value:
    return value if value.size == size else program.gather([value], np.zeros(size))


class _MatrixWriter:
    """Writes a function of matrix instructions. A value holds the non-zeros of a matrix in CasADi's order."""

    def __init__(self, reader: Reader, program: Program, function: ca.Function, inputs: Sequence[Value]) -> None:
        self._reader = reader
        self._program = program
        self._function = function
        self._inputs = inputs

    def run(self) -> list[Value]:
        function, program = self._function, self._program
        work: dict[int, Value] = {}
        results: list[list[tuple[int, Value]]] = [[] for _ in range(function.n_out())]
        for k in range(function.n_instructions()):
            code, ins, outs = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
            node = function.instruction_MX(k)
            args = [work[i] for i in ins] if code != ca.OP_INPUT else []
            if code == ca.OP_INPUT:
                info = node.info()
                at = int(info["offset"])
                made = [program.gather([self._inputs[info["ind"]]], np.arange(at, at + node.nnz()))]
            elif code == ca.OP_OUTPUT:
                info = node.info()
                results[info["ind"]].append((int(info["offset"]), args[0]))
                continue
            elif code == ca.OP_CALL:
                made = self._reader.write_call(program, node.which_function(), args)
            else:
                made = self._written(code, node, args)
            work.update((out, value) for out, value in zip(outs, made, strict=True) if out >= 0)
        return [
            program.concatenate([value for _, value in sorted(parts, key=lambda part: part[0])])
            if parts
            else program.constant(np.zeros(function.nnz_out(i)))
            for i, parts in enumerate(results)
        ]

    def _written(self, code: int, node: ca.MX, args: list[Value]) -> list[Value]:
        program = self._program
        if code == ca.OP_CONST:
            return [program.constant(np.array(node.to_DM().nonzeros()))]
        if code == ca.OP_TRANSPOSE and node.is_dense():
            return [program.transpose(args[0], *node.shape[::-1])]
        if code in ELEMENTWISE:
            return [program.elementwise(code, *args)]
        if code in _PLACED:
            return [program.gather(args, where) for where in _PLACED[code](node)]
        deps = [node.dep(i) for i in range(node.n_dep())]
        if code == ca.OP_MTIMES:
            base, left, right = args
            return [program.elementwise(ca.OP_ADD, base, self._product(node, left, right))]
        if code == ca.OP_DOT:
            every = np.arange(args[0].size)
            return [program.accumulate(1, 0 * every, args, [every, every])]
        if code == ca.OP_BILIN and deps[0].is_dense():
            m, n = deps[0].shape
            through = program.product(args[0], args[2], (m, n, 1))
            return [program.accumulate(1, np.zeros(m), [args[1], through], [np.arange(m)] * 2)]
        if code == ca.OP_RANK1 and deps[0].is_dense():
            outer = program.product(args[2], args[3], (deps[0].shape[0], 1, deps[0].shape[1]))
            return [program.elementwise(ca.OP_ADD, args[0], program.elementwise(ca.OP_MUL, args[1], outer))]
        if code in (ca.OP_NORM2, ca.OP_NORMF):
            return [program.elementwise(ca.OP_SQRT, program.total(program.elementwise(ca.OP_SQ, args[0])))]
        if code == ca.OP_NORM1:
            return [program.total(program.elementwise(ca.OP_FABS, args[0]))]
        if code == ca.OP_ADDNONZEROS:
            where = _slots(node.info())
            added = program.accumulate(args[0].size, where, [args[1]], [np.arange(args[1].size)])
            return [program.elementwise(ca.OP_ADD, args[0], added)]
        if code == ca.OP_HORZREPSUM:
            size = node.nnz()
            return [program.accumulate(size, np.arange(args[0].size) % size, args, [np.arange(args[0].size)])]
        if code in (ca.OP_MONITOR, ca.OP_LIFT, ca.OP_PRINTME):
            return [args[0]]
        if code == ca.OP_ASSERTION:  # not met: not a number
            failed = program.elementwise(ca.OP_NOT, args[1])
            poison = program.elementwise(ca.OP_IF_ELSE_ZERO, failed, program.constant(np.nan))
            return [program.elementwise(ca.OP_ADD, args[0], poison)]
        return self._external(node, deps, args)

    def _product(self, node: ca.MX, left: Value, right: Value) -> Value:
        x, y, z = node.dep(1).sparsity(), node.dep(2).sparsity(), node.sparsity()
        if x.is_dense() and y.is_dense() and z.is_dense():
            return self._program.product(left, right, (x.size1(), x.size2(), y.size2()))
        place = {pair: i for i, pair in enumerate(zip(*_coordinates(z), strict=True))}
        columns: dict[int, list[tuple[int, int]]] = {}
        for at, (i, k) in enumerate(zip(*_coordinates(x), strict=True)):
            columns.setdefault(k, []).append((i, at))
        terms = [
            (place[i, j], a, b)
            for b, (k, j) in enumerate(zip(*_coordinates(y), strict=True))
            for i, a in columns.get(k, [])
            if (i, j) in place
        ]
        table = np.array(terms, dtype=np.int64).reshape(-1, 3)
        return self._program.accumulate(z.nnz(), table[:, 0], [left, right], [table[:, 1], table[:, 2]])

    def _external(self, node: ca.MX, deps: list[ca.MX], args: list[Value]) -> list[Value]:
        """Leave a node to CasADi's own code, as a function of what it depends on."""
        symbols = [ca.MX.sym(f"x{i}", dep.sparsity()) for i, dep in enumerate(deps)]
        (alone,) = ca.graph_substitute([node], deps, symbols)
        function = ca.Function(f"node_{len(self._program.operations)}", symbols, [alone])
        return list(self._program.add("external", tuple(args), function, [node.nnz()], hash(node)))


def _coordinates(sparsity: ca.Sparsity) -> tuple[list[int], list[int]]:
    return sparsity.row(), sparsity.get_col()


def _slots(info: dict[str, Any]) -> Indices:
    """Return the non-zeros that an operation on some of them names."""
    if "nz" in info:
        return np.array(info["nz"], dtype=np.int64)
    if "slice" in info:
        return _range(info["slice"])
    return (_range(info["outer"])[:, None] + _range(info["inner"])[None, :]).ravel()


def _range(part: dict[str, int]) -> Indices:
    return np.arange(part["start"], part["stop"], part["step"])


def _moved(node: ca.MX, move: Callable[[list[ca.DM]], Any]) -> list[Indices]:
    """Return where the non-zeros of the results come from, by moving numbers that count them."""
    numbered, count = [], 1
    for i in range(node.n_dep()):
        sparsity = node.dep(i).sparsity()
        numbered.append(ca.DM(sparsity, np.arange(count, count + sparsity.nnz())))
        count += sparsity.nnz()
    results = move(numbered)
    results = results if isinstance(results, (list, tuple)) else [results]
    # Numbers that were structurally zero are 0 where the result holds them.
    return [np.round(np.array(result.nonzeros())).astype(np.int64) - 1 for result in results]


def _set(node: ca.MX) -> list[Indices]:
    where = np.arange(node.nnz())
    slots = _slots(node.info())
    where[slots] = node.nnz() + np.arange(slots.size)
    return [where]


def _projected(node: ca.MX) -> list[Indices]:
    return _moved(node, lambda given: ca.project(given[0], node.sparsity()))


def _split_rows(node: ca.MX) -> list[Indices]:
    edges = np.cumsum([0, *(node.get_output(i).size1() for i in range(node.n_out()))]).tolist()
    return _moved(node, lambda given: ca.vertsplit(given[0], edges))


def _split_columns(node: ca.MX) -> list[Indices]:
    edges = np.cumsum([0, *(node.get_output(i).size2() for i in range(node.n_out()))]).tolist()
    return _moved(node, lambda given: ca.horzsplit(given[0], edges))


def _split_diagonal(node: ca.MX) -> list[Indices]:
    outputs = [node.get_output(i) for i in range(node.n_out())]
    rows = np.cumsum([0, *(output.size1() for output in outputs)]).tolist()
    columns = np.cumsum([0, *(output.size2() for output in outputs)]).tolist()
    return _moved(node, lambda given: ca.diagsplit(given[0], rows, columns))


# Operations that move numbers: for each result, where its numbers come from.
_PLACED: dict[int, Callable[[ca.MX], list[Indices]]] = {
    ca.OP_RESHAPE: lambda node: [np.arange(node.nnz())],
    ca.OP_SPARSITY_CAST: lambda node: [np.arange(node.nnz())],
    ca.OP_GETNONZEROS: lambda node: [_slots(node.info())],
    ca.OP_SETNONZEROS: _set,
    ca.OP_PROJECT: _projected,
    ca.OP_TRANSPOSE: lambda node: _moved(node, lambda given: given[0].T),
    ca.OP_VERTCAT: lambda node: _moved(node, lambda given: ca.vertcat(*given)),
    ca.OP_HORZCAT: lambda node: _moved(node, lambda given: ca.horzcat(*given)),
    ca.OP_DIAGCAT: lambda node: _moved(node, lambda given: ca.diagcat(*given)),
    ca.OP_VERTSPLIT: _split_rows,
    ca.OP_HORZSPLIT: _split_columns,
    ca.OP_DIAGSPLIT: _split_diagonal,
    ca.OP_HORZREPMAT: lambda node: [np.arange(node.nnz()) % node.dep(0).nnz()],
}
