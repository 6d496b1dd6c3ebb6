"""Kernels in C: CasADi's code for value and gradient, with the local search compiled around it."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Sequence
from importlib import resources
from typing import Any, get_args

import casadi as ca
import numpy as np

from symgraph.compile.kernel import NEVER, AdadeltaSteps, BoundKernel, Ended, Kernel, Outcome, Stop
from symgraph.compile.toolchain import load
from symgraph.errors import CompileError
from symgraph.slots import Array

# The point-by-point call of CasADi's function, between that and search.c.
_HEAD = """
#define N_ACTIONS {n_actions}
struct inputs {{ const double *selections; const double *const *shared; const volatile int *stop; double *w; }};
static int evaluate(const double *x, const struct inputs *in, double *value, double *gradient) {{
  const double *arg[{arguments}];
  double *res[{results}];
  casadi_int iw[{integers}];
  int i;
  arg[0] = x;
  arg[1] = in->selections;
  for (i = 0; i < {n_shared}; ++i) arg[2 + i] = in->shared[i];
  res[0] = value;
  res[1] = gradient;
  return {name}(arg, res, iw, in->w, 0);
}}
"""

# What Python calls, after search.c. Workspace: first CasADi's, then the search's.
_TAIL = """
void symgraph_evaluate(long long points, const double *actions, const double *selections, const double *const *shared,
                       const int *stop, double *values, double *gradients, double *w) {{
  struct inputs in;
  long long p;
  in.shared = shared;
  in.stop = stop;
  in.w = w;
  for (p = 0; p < points; ++p) {{
    in.selections = selections + p * {n_selections};
    if ((p && *in.stop) || evaluate(actions + p * N_ACTIONS, &in, values + p, gradients + p * N_ACTIONS))
      values[p] = NAN;
  }}
}}
long long symgraph_climb(double *x, const double *selection, const double *const *shared, const int *stop,
                         const double *low, const double *high, long long iterations, double tolerance,
                         double *value, int *outcome, double *history, double *w) {{
  struct inputs in;
  in.selections = selection;
  in.shared = shared;
  in.stop = stop;
  in.w = w;
  return climb(x, &in, low, high, iterations, tolerance, value, outcome, history, w + {work});
}}
long long symgraph_ascend(double *x, const double *selection, const double *const *shared, const int *stop,
                          const double *low, const double *high, long long limit, double decay, double epsilon,
                          double tolerance, double scale, int oscillation, int scaled, int keep_best,
                          double *value, int *outcome, double *history, double *w) {{
  struct inputs in;
  in.selections = selection;
  in.shared = shared;
  in.stop = stop;
  in.w = w;
  return ascend(x, &in, low, high, limit, decay, epsilon, tolerance, scale, oscillation, scaled, keep_best, value,
                outcome, history, w + {work});
}}
int symgraph_work(void) {{ return {work} + SEARCH_WORK; }}
"""

_OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)  # in the order of search.c's enum


class CompiledKernel(Kernel):
    """A kernel as machine code.

    Raises:
        CompileError: the compiler refused the code.
    """

    def __init__(self, function: ca.Function, compiler: str) -> None:
        generator = ca.CodeGenerator("kernel", {"with_header": False, "include_math": False})
        generator.add(function)
        sizes = {
            "name": function.name(),
            "arguments": function.sz_arg(),
            "results": function.sz_res(),
            "integers": max(1, function.sz_iw()),
            "n_actions": function.numel_in(0),
            "n_selections": function.numel_in(1),
            "n_shared": function.n_in() - 2,
            "work": function.sz_w(),
        }
        function_code = _text("extrema.c") + _with_fast_products(generator.dump())
        self._source = function_code + _HEAD.format(**sizes) + _text("search.c") + _TAIL.format(**sizes)
        self._compiler = compiler
        self.n_actions, self.n_selections = function.numel_in(0), function.numel_in(1)
        self._load()

    def _load(self) -> None:
        library = load(self._source, self._compiler)
        pointer: Any = ctypes.c_void_p
        whole: Any = ctypes.c_longlong
        number: Any = ctypes.c_double
        library.symgraph_evaluate.argtypes = [whole, *[pointer] * 7]
        library.symgraph_evaluate.restype = None
        library.symgraph_climb.argtypes = [*[pointer] * 6, whole, number, *[pointer] * 4]
        library.symgraph_climb.restype = whole
        steps = [whole, *[number] * 4, ctypes.c_int, ctypes.c_int, ctypes.c_int]
        library.symgraph_ascend.argtypes = [*[pointer] * 6, *steps, *[pointer] * 4]
        library.symgraph_ascend.restype = whole
        self.code: Any = library
        self.work = int(library.symgraph_work())

    def __getstate__(self) -> dict[str, Any]:  # other processes load the library from the cache
        return {name: value for name, value in self.__dict__.items() if name not in ("code", "work")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._load()

    def bind(self, shared: Sequence[Array], low: Array, high: Array, stop: Stop = NEVER) -> BoundKernel:
        columns = [contiguous(column) for column in shared]
        return _BoundCompiled(self, columns, contiguous(low), contiguous(high), stop)


class _BoundCompiled(BoundKernel):
    """Hands arrays of its own to the library, since looking up an array's address costs as much as ten gradients."""

    def __init__(self, kernel: CompiledKernel, shared: list[Array], low: Array, high: Array, stop: Stop) -> None:
        self._kernel = kernel
        self._inputs = shared, low, high, stop
        self._pointers = (ctypes.c_void_p * max(1, len(shared)))(*[_address(column) for column in shared])
        self._work = np.empty(kernel.work)
        self._point, self._selection = np.zeros(kernel.n_actions), np.zeros(kernel.n_selections)
        self._value, self._outcome = ctypes.c_double(), ctypes.c_int()
        self._history = np.empty(0)
        self._before = (
            _address(self._point),
            _address(self._selection),
            ctypes.addressof(self._pointers),
            stop.address,
            _address(low),
            _address(high),
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return _BoundCompiled, (self._kernel, *self._inputs)

    def evaluate(self, actions: Array, selections: Array) -> tuple[Array, Array]:
        actions, selections = contiguous(actions), contiguous(selections)
        values, gradients = np.empty(len(actions)), np.empty(actions.shape)
        self._kernel.code.symgraph_evaluate(
            len(actions),
            _address(actions),
            _address(selections),
            ctypes.addressof(self._pointers),
            self._inputs[3].address,
            _address(values),
            _address(gradients),
            _address(self._work),
        )
        return values, gradients

    def climb(self, start: Array, selection: Array, iterations: int, tolerance: float) -> Ended:
        function = self._kernel.code.symgraph_climb
        return self._search(function, start, selection, iterations, (iterations, tolerance))

    def ascend(self, start: Array, selection: Array, limit: int, steps: AdadeltaSteps) -> Ended:
        numbers = steps.decay, steps.epsilon, steps.tolerance, steps.scale
        settings = (limit, *numbers, steps.oscillation, steps.scaled, steps.keep_best)
        return self._search(self._kernel.code.symgraph_ascend, start, selection, limit + 1, settings)

    def _search(self, function: Any, start: Array, selection: Array, length: int, settings: tuple[Any, ...]) -> Ended:
        if self._history.size < length:
            self._history = np.empty(length)
            self._after = (
                ctypes.addressof(self._value),
                ctypes.addressof(self._outcome),
                _address(self._history),
                _address(self._work),
            )
        self._point[:] = start
        self._selection[:] = selection
        spent = function(*self._before, *settings, *self._after)
        outcome = _OUTCOMES[self._outcome.value]
        return Ended(self._point.copy(), self._value.value, outcome, self._history[:spent].copy())


def _with_fast_products(source: str) -> str:
    """Put the products of matrices.c in place of CasADi's, where there are any."""
    call = "casadi_mtimes_dense("
    if call not in source:
        return source
    products = _text("matrices.c")
    theirs = re.compile(r"void casadi_mtimes_dense\([^)]*\) \{\n.*?\n\}\n", re.DOTALL)
    replaced, times = theirs.subn(lambda _: products, source)
    if times != 1:
        raise CompileError(
            f"CasADi {ca.CasadiMeta.version()} writes {call}…) in another form than is known; please report it"
        )
    return replaced


def _text(name: str) -> str:
    """Return a C file of this package."""
    return (resources.files("symgraph.compile") / name).read_text()


def contiguous(column: Array) -> Array:
    """Return the column as C sees it: doubles one after the other."""
    return np.ascontiguousarray(column, dtype=float)


def _address(column: Array) -> int:
    return int(column.__array_interface__["data"][0])
