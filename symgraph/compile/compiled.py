"""Kernels in C: value and gradient of many points side by side, with the local search compiled around them."""

from __future__ import annotations

import ctypes
import hashlib
import warnings
from collections.abc import Iterator, Sequence
from functools import cache, cached_property
from importlib import resources
from itertools import pairwise
from time import perf_counter
from typing import Any, get_args

import casadi as ca
import numpy as np

from symgraph.compile.crew import Crew
from symgraph.compile.kernel import NEVER, AdadeltaSteps, BoundKernel, Ended, Kernel, Outcome, Stop
from symgraph.compile.rules import rules_in
from symgraph.compile.sharing import PARTS
from symgraph.compile.source import kernel_source
from symgraph.compile.toolchain import load
from symgraph.errors import CompileError
from symgraph.slots import Array, Choices

SLICE = 0.05  # seconds of a search between two looks at what the user wants
FIRST_ROUNDS = 16  # gradients before the first one
FIRST_POINTS = 256  # points of an evaluation before the first one
ALIGNMENT = 64  # bytes: a cache line, and the longest vector
SINGLE_TOLERANCE = 1e4  # times those of double precision
MOST_SPARE = 2  # blocks of memory of one size that are kept
FEW = 1000  # numbers that are compared one by one
HEAVY = 256  # weights from which on single points have a kernel of their own

_OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)  # in the order of search.c's enum
_UNDER_WAY = -1


class CompiledKernel(Kernel):
    """A kernel as machine code.

    Args:
        function: actions (n, 1), selections (m, 1) and what is bound → value (1, 1).
        compiler: the path of a C compiler.
        single: compute in single precision.

    Raises:
        CompileError: the compiler refused the code.
    """

    def __init__(self, function: ca.Function, compiler: str, single: bool = False) -> None:
        self.function = function
        self.single = single
        self._compiler = compiler
        self._prepared: dict[int, _Prepared] = {}
        self.n_actions, self.n_selections = function.numel_in(0), function.numel_in(1)
        # A point alone leaves most of a vector empty, which matters where there are matrices of weights.
        self._heavy = any(function.numel_in(i) >= HEAVY for i in range(2, function.n_in()))
        self.wide  # noqa: B018 compiled here, where errors are expected

    @cached_property
    def wide(self) -> Library:
        """For points side by side."""
        return Library(self.function, self._compiler, lanes=True, single=self.single)

    @cached_property
    def narrow(self) -> Library:
        """For points one at a time."""
        if not self._heavy:
            return self.wide
        try:
            return Library(self.function, self._compiler, lanes=False, single=self.single)
        except CompileError as error:
            warnings.warn(f"{error}\nsingle points are computed by code for many, which is slower", stacklevel=2)
            return self.wide

    def compile_for_one(self) -> None:
        self.narrow  # noqa: B018 compiled when it is first asked for

    def library(self, count: int) -> Library:
        """Return the code that is best for so many points."""
        return self.narrow if count == 1 else self.wide

    def prepared(self, library: Library, columns: Sequence[Array], threads: int) -> _Prepared:
        """Return what follows from bound inputs; the last of them is kept, since many calls come with the same ones."""
        last = self._prepared.get(id(library))
        if last is None or not last.serves(columns):
            last = self._prepared[id(library)] = _Prepared(library, columns, threads)
        return last

    def __reduce__(self) -> tuple[Any, ...]:  # other processes load the libraries from the cache
        return CompiledKernel, (self.function, self._compiler, self.single)

    def bind(
        self, shared: Sequence[Array], low: Array, high: Array, stop: Stop = NEVER, threads: int = 1
    ) -> BoundKernel:
        columns = [contiguous(column) for column in shared]
        return _BoundCompiled(self, columns, contiguous(low), contiguous(high), stop, threads)


class Library:
    """The functions of kernel.c for one function, compiled."""

    def __init__(self, function: ca.Function, compiler: str, lanes: bool, single: bool) -> None:
        key = hashlib.sha256(function.serialize().encode())
        for part in (*_engine(), *rules_in(function), repr((lanes, single))):
            key.update(part.encode())
        code: Any = load(key.hexdigest(), lambda: kernel_source(function, lanes, single), compiler)
        pointer: Any = ctypes.c_void_p
        whole: Any = ctypes.c_longlong
        code.symgraph_sizes.argtypes = [pointer]
        code.symgraph_bind.argtypes = [pointer] * 4
        code.symgraph_evaluate.argtypes = [pointer, whole, *[pointer] * 7]
        code.symgraph_begin.argtypes = [pointer, pointer, pointer, whole, whole, *[pointer] * 9]
        code.symgraph_advance.argtypes = [pointer, pointer, pointer, pointer, whole]
        for name in ("sizes", "bind", "evaluate", "begin", "advance"):
            getattr(code, f"symgraph_{name}").restype = None
        self.code = code
        self.real = np.dtype(np.float32 if single else np.float64)
        sizes = (ctypes.c_longlong * 5)()
        code.symgraph_sizes(sizes)
        self.block, self.early_work, self.work, self.search_bytes, shared = sizes
        self.shared = bool(shared)  # whether the members of a team share each evaluation; else threads share points
        self._spare: dict[int, list[Array]] = {}

    def members(self, threads: int) -> int:
        """Return how many of so many threads make a team."""
        return min(threads, PARTS) if self.shared else 1

    def memory(self, count: int) -> Array:
        """Return room for numbers, of an earlier plan if there is some: to fetch megabytes anew takes milliseconds."""
        try:
            return self._spare[max(1, count)].pop()
        except (KeyError, IndexError):
            return aligned(count, self.real)

    def give_back(self, memory: Array) -> None:
        spare = self._spare.setdefault(memory.size, [])
        if len(spare) < MOST_SPARE:
            spare.append(memory)


class _Settings(ctypes.Structure):
    """`struct settings` of search.c."""

    _fields_ = (
        ("low", ctypes.c_void_p),
        ("high", ctypes.c_void_p),
        ("limit", ctypes.c_longlong),
        ("ascends", ctypes.c_int),
        ("decay", ctypes.c_double),
        ("epsilon", ctypes.c_double),
        ("oscillation", ctypes.c_int),
        ("scaled", ctypes.c_int),
        ("keep_best", ctypes.c_int),
        ("stop", ctypes.c_void_p),
    )


class _Prepared:
    """Bound inputs of a library, and what follows from them; only read from here on, by any thread."""

    def __init__(self, library: Library, columns: Sequence[Array], threads: int) -> None:
        self._library, self._block = library, library.memory(library.block)
        # Others may write to their own numbers later.
        self._columns = [column.copy() if column.flags.writeable else column for column in columns]
        early = library.memory(library.early_work)
        self._kept = [*(np.ascontiguousarray(column, dtype=library.real) for column in self._columns), self._block]
        self._pointers = (ctypes.c_void_p * len(self._kept))(*[address(column) for column in self._kept])
        self.address = ctypes.addressof(self._pointers)
        given = self.address, address(self._block), address(early)
        Crew(1, library.members(threads)).work(library.code.symgraph_bind, [given])
        library.give_back(early)

    def __del__(self) -> None:
        self._library.give_back(self._block)

    def serves(self, columns: Sequence[Array]) -> bool:
        """Whether other inputs are the same: the same memory, which nobody can change, or the same few numbers."""
        return all(
            (address(a) == address(b) and a.size == b.size and not (a.flags.writeable or b.flags.writeable))
            or (a.size == b.size <= FEW and a.tobytes() == b.tobytes())
            for a, b in zip(columns, self._columns, strict=True)
        )


class _Inputs:
    """What a library needs to evaluate: bound inputs, threads, and workspace for each of their teams."""

    def __init__(self, library: Library, prepared: _Prepared, threads: int) -> None:
        members = library.members(threads)
        self.library, self.teams = library, threads // members
        self._workspaces = [library.memory(library.work) for _ in range(self.teams)]
        self._prepared = prepared
        self.shared = prepared.address
        self.crew = Crew(self.teams, members)
        self.work = [address(workspace) for workspace in self._workspaces]

    def __del__(self) -> None:
        for workspace in self._workspaces:
            self.library.give_back(workspace)


class _BoundCompiled(BoundKernel):
    def __init__(
        self, kernel: CompiledKernel, shared: list[Array], low: Array, high: Array, stop: Stop, threads: int
    ) -> None:
        self._kernel = kernel
        self._given = shared, low, high, stop
        self._threads = threads
        self._inputs: dict[int, _Inputs] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return _BoundCompiled, (self._kernel, *self._given, self._threads)

    def _for(self, count: int) -> _Inputs:
        library = self._kernel.library(count)
        if id(library) not in self._inputs:
            prepared = self._kernel.prepared(library, self._given[0], self._threads)
            self._inputs[id(library)] = _Inputs(library, prepared, self._threads)
        return self._inputs[id(library)]

    def evaluate(self, actions: Array, selections: Array) -> tuple[Array, Array]:
        order = _by_selection(selections)
        points, chosen = contiguous(actions), contiguous(selections)
        if order is not None:
            points, chosen = points[order], chosen[order]
        inputs, stop = self._for(len(points)), self._given[3].address
        values, gradients = np.empty(len(points)), np.empty(points.shape)

        def work(member: int, part: list[Array], workspace: int) -> None:
            x, h, v, g = map(address, part)
            inputs.library.code.symgraph_evaluate(member, len(part[0]), x, h, inputs.shared, stop, v, g, workspace)

        done, count = 0, FIRST_POINTS * inputs.teams
        while done < len(points):
            if done and self._given[3]:
                values[done:], gradients[done:] = np.nan, np.nan
                break
            begin, end = perf_counter(), min(done + count, len(points))
            edges = [done + (end - done) * team // inputs.teams for team in range(inputs.teams + 1)]
            parts = [[array[a:b] for array in (points, chosen, values, gradients)] for a, b in pairwise(edges) if b > a]
            inputs.crew.work(work, list(zip(parts, inputs.work, strict=False)))
            done = end
            count = max(FIRST_POINTS, min(4 * count, int(count * SLICE / max(perf_counter() - begin, 1e-9))))
        if order is None:
            return values, gradients
        in_turn = np.empty_like(values), np.empty_like(gradients)
        in_turn[0][order], in_turn[1][order] = values, gradients
        return in_turn

    def climb(
        self, starts: Array, selections: Array, iterations: int, tolerances: Array
    ) -> Iterator[tuple[int, Ended]]:
        # In single precision slopes are never as small as in double.
        reachable = tolerances * (SINGLE_TOLERANCE if self._kernel.single else 1.0)
        return self._search(starts, selections, reachable, np.ones(len(starts)), limit=iterations)

    def ascend(
        self, starts: Array, selections: Array, limit: int, steps: AdadeltaSteps, scales: Array
    ) -> Iterator[tuple[int, Ended]]:
        return self._search(
            starts,
            selections,
            steps.tolerance * scales,
            scales,
            limit=limit + 1,
            ascends=True,
            decay=steps.decay,
            epsilon=steps.epsilon,
            oscillation=steps.oscillation,
            scaled=steps.scaled,
            keep_best=steps.keep_best,
        )

    def _search(
        self, starts: Array, selections: Array, tolerances: Array, scales: Array, **settings: float
    ) -> Iterator[tuple[int, Ended]]:
        """Search from all starts, some time at once, and hand out those that have ended in between."""
        _, low, high, stop = self._given
        count = len(starts)
        order = _by_selection(selections)
        order = np.arange(count) if order is None else order
        inputs = self._for(count)
        code = inputs.library.code
        given = [contiguous(column[order]) for column in (starts, selections, tolerances, scales)]
        ends, values, histories = np.empty(starts.shape), np.empty(count), np.empty((count, int(settings["limit"])))
        outcomes, spent = np.full(count, _UNDER_WAY, dtype=np.intc), np.zeros(count, dtype=np.longlong)
        pointers = [address(column) for column in (*given, ends, values, histories, outcomes, spent)]
        all_settings = _Settings(low=address(low), high=address(high), stop=stop.address, **settings)
        following = ctypes.c_long(0)  # the first start that waits, for all searches
        searches = [np.empty(inputs.library.search_bytes, dtype=np.uint8) for _ in inputs.work]
        for search in searches:
            shares = address(search), ctypes.addressof(all_settings), ctypes.addressof(following), len(searches)
            code.symgraph_begin(*shares, count, *pointers)

        def work(member: int, search: Array, workspace: int) -> None:
            code.symgraph_advance(member, address(search), inputs.shared, workspace, rounds)

        rounds, waiting, over = FIRST_ROUNDS, np.ones(count, dtype=bool), False
        while waiting.any() and not over:
            begin = perf_counter()
            over = bool(stop) and not waiting.all()  # one last round, in which walks that are under way end
            rounds = 1 if over else rounds
            inputs.crew.work(work, list(zip(searches, inputs.work, strict=True)))
            rounds = max(1, min(4 * rounds, int(rounds * SLICE / max(perf_counter() - begin, 1e-9))))
            for p in np.flatnonzero(waiting & (outcomes != _UNDER_WAY)):
                waiting[p] = False
                outcome, history = _OUTCOMES[outcomes[p]], histories[p, : spent[p]].copy()
                yield int(order[p]), Ended(ends[p].copy(), float(values[p]), outcome, history)


def _by_selection(selections: Array) -> Choices | None:
    """Return an order in which equal rows stand together; None where they do already."""
    if len(selections) <= 1 or selections.shape[1] == 0 or (selections == selections[0]).all():
        return None
    return np.lexsort(selections.T)


@cache
def _engine() -> tuple[str, ...]:
    """Return all that decides what a function becomes: the files of this package."""
    folder = resources.files("symgraph.compile")
    files = sorted((file.name, file.read_text()) for file in folder.iterdir() if file.name.endswith((".py", ".c")))
    return tuple(text for _, text in files)


def contiguous(column: Array) -> Array:
    """Return the column as C sees it: doubles one after the other."""
    return np.ascontiguousarray(column, dtype=float)


def aligned(count: int, real: np.dtype[Any]) -> Array:
    """Return numbers that begin where a cache line does."""
    memory = np.empty(max(1, count) * real.itemsize + ALIGNMENT, dtype=np.uint8)
    begin = -address(memory) % ALIGNMENT
    return memory[begin : begin + max(1, count) * real.itemsize].view(real)


def address(column: Any) -> int:
    """Return where an array's numbers are."""
    return int(column.__array_interface__["data"][0])
