"""From CasADi functions to kernels: machine code where there is a C compiler, CasADi's interpreter elsewhere."""

from __future__ import annotations

import warnings

import casadi as ca

from symgraph.compile.compiled import CompiledKernel
from symgraph.compile.interpreted import InterpretedKernel
from symgraph.compile.kernel import Kernel
from symgraph.compile.toolchain import find_compiler
from symgraph.errors import CompileError


def make_kernel(function: ca.Function, compiled: bool) -> Kernel:
    """Return the fastest kernel there is for a function: compiled if wanted and possible, else interpreted."""
    compiler = find_compiler() if compiled else None
    if compiler is not None:
        try:
            return CompiledKernel(function, compiler)
        except CompileError as error:
            warnings.warn(f"{error}\nplans are computed in CasADi's interpreter instead", stacklevel=2)
    return InterpretedKernel(function)
