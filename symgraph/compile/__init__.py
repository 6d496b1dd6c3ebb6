"""From CasADi functions to kernels: machine code where there is a C compiler, CasADi's interpreter elsewhere."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import casadi as ca

from symgraph.compile.compiled import CompiledKernel
from symgraph.compile.interpreted import InterpretedKernel
from symgraph.compile.kernel import Kernel
from symgraph.compile.toolchain import find_compiler
from symgraph.errors import CompileError


def make_kernel(
    value: ca.Function, with_gradient: Callable[[], ca.Function], compiled: bool, single: bool = False
) -> Kernel:
    """Return the fastest kernel there is for a function: compiled if wanted and possible, else interpreted.

    Args:
        value: actions (n, 1), selections (m, 1) and further columns → value (1, 1).
        with_gradient: makes the function that also returns the gradient (n, 1), for the interpreter.
        compiled: compile it where there is a compiler.
        single: compiled, compute in single precision.
    """
    compiler = find_compiler() if compiled else None
    if compiler is not None:
        try:
            return CompiledKernel(value, compiler, single)
        except CompileError as error:
            warnings.warn(f"{error}\nplans are computed in CasADi's interpreter instead", stacklevel=2)
    return InterpretedKernel(with_gradient())
