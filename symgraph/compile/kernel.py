"""Kernels: one function evaluated at many points, in compiled C or in CasADi's interpreter."""

from __future__ import annotations

import ctypes
import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from symgraph.compile.library import find_compiler, load
from symgraph.errors import CompileError
from symgraph.slots import Array

# casadi's function for one point, called for point after point; what the points share is passed once.
_LOOP = """
int symgraph_evaluate(long long points, const double *actions, const double *selections, const double **shared,
                      double *values, double *gradients, double *w)
{{
  const double *arg[{arguments}];
  double *res[{results}];
  casadi_int iw[{integers}];
  long long p;
  int i;
  for (p = 0; p < points; ++p) {{
    /* casadi uses the tails of arg and res as scratch, hence anew for each point */
    arg[0] = actions + p * {n_actions};
    arg[1] = selections + p * {n_selections};
    for (i = 0; i < {n_shared}; ++i) arg[2 + i] = shared[i];
    res[0] = values + p;
    res[1] = gradients + p * {n_actions};
    if ({name}(arg, res, iw, w, 0)) return 1;
  }}
  return 0;
}}
"""


class Kernel(ABC):
    """Value and gradient at many points.

    The function behind it maps actions (n, 1), selections (m, 1) and further columns that all points share to a
    value (1, 1) and a gradient (n, 1).
    """

    @abstractmethod
    def __call__(self, actions: Array, selections: Array, shared: Sequence[Array]) -> tuple[Array, Array]:
        """Evaluate P points.

        Args:
            actions: (P, n), a row per point.
            selections: (P, m) one-hot rows.
            shared: the other inputs, each as a flat array in column-major order.

        Returns:
            values (P,) and gradients (P, n); not finite where the model is not.
        """


class InterpretedKernel(Kernel):
    """CasADi's virtual machine: no compiler needed, ready at once."""

    def __init__(self, function: ca.Function) -> None:
        self._function = function

    def __call__(self, actions: Array, selections: Array, shared: Sequence[Array]) -> tuple[Array, Array]:
        points, n = actions.shape
        values, gradients = np.empty(points), np.empty((points, n))
        buffer, evaluate = self._function.buffer()
        here, chosen = np.zeros(n), np.zeros(selections.shape[1])
        value, gradient = np.zeros(1), np.zeros(n)
        kept = [np.ascontiguousarray(column, dtype=float) for column in shared]
        for i, column in enumerate([here, chosen, *kept]):
            buffer.set_arg(i, memoryview(column))
        buffer.set_res(0, memoryview(value))
        buffer.set_res(1, memoryview(gradient))
        for p in range(points):
            here[:] = actions[p]
            chosen[:] = selections[p]
            evaluate()
            values[p] = value[0]
            gradients[p] = gradient
        return values, gradients


class CompiledKernel(Kernel):
    """The function as C code, compiled for this machine.

    Raises:
        CompileError: the compiler refused the code.
    """

    def __init__(self, function: ca.Function, compiler: str) -> None:
        generator = ca.CodeGenerator("kernel", {"with_header": False})
        generator.add(function)
        loop = _LOOP.format(
            name=function.name(),
            arguments=function.sz_arg(),
            results=function.sz_res(),
            integers=max(1, function.sz_iw()),
            n_actions=function.numel_in(0),
            n_selections=function.numel_in(1),
            n_shared=function.n_in() - 2,
        )
        self._source = generator.dump() + loop
        self._compiler = compiler
        self._work = function.sz_w()
        self._load()

    def _load(self) -> None:
        library, _ = load(self._source, self._compiler)
        self._evaluate: Any = library.symgraph_evaluate
        pointer = ctypes.c_void_p
        self._evaluate.argtypes = [ctypes.c_longlong, *[pointer] * 6]

    def __getstate__(self) -> dict[str, Any]:  # other processes load the library from the cache
        return {"_source": self._source, "_compiler": self._compiler, "_work": self._work}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._load()

    def __call__(self, actions: Array, selections: Array, shared: Sequence[Array]) -> tuple[Array, Array]:
        points, n = actions.shape
        actions = np.ascontiguousarray(actions, dtype=float)
        selections = np.ascontiguousarray(selections, dtype=float)
        values, gradients, work = np.empty(points), np.empty((points, n)), np.empty(self._work)
        kept = [np.ascontiguousarray(column, dtype=float) for column in shared]
        pointers = (ctypes.c_void_p * len(kept))(*[column.ctypes.data for column in kept])
        failed = self._evaluate(
            points,
            actions.ctypes.data,
            selections.ctypes.data,
            ctypes.addressof(pointers),
            values.ctypes.data,
            gradients.ctypes.data,
            work.ctypes.data,
        )
        if failed:
            values[:] = np.nan
        return values, gradients


def make_kernel(function: ca.Function, compiled: bool) -> Kernel:
    """Return the fastest kernel there is for a function: compiled if wanted and possible, else interpreted."""
    compiler = find_compiler() if compiled else None
    if compiler is not None:
        try:
            return CompiledKernel(function, compiler)
        except CompileError as error:
            warnings.warn(f"{error}\nplans are computed in CasADi's interpreter instead", stacklevel=2)
    return InterpretedKernel(function)
