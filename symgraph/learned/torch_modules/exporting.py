"""Exporting: the graph of a module's operators, traced by torch.export in double precision, and its function."""

from __future__ import annotations

import copy
import io
import logging
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from typing import Any

import casadi as ca
import numpy as np
import torch

from symgraph.errors import InputError, SymgraphError
from symgraph.learned.torch_modules import cache
from symgraph.learned.torch_modules.lowering import Lowered, Lowering
from symgraph.learned.torch_modules.refusals import described, refused_export
from symgraph.learned.torch_modules.symbols import leaves
from symgraph.learned.torch_modules.weights import LiveWeight, Source

A = torch.ops.aten

# Operators that are lowered as a whole, in fewer steps than what torch would make of them.
WHOLE = (
    A.scaled_dot_product_attention.default,
    A.linear.default,
    A.silu.default,
    A.softplus.default,
    A.mish.default,
    A.hardswish.default,
    A.hardsigmoid.default,
    A.log_sigmoid_forward.default,
    A.logaddexp.default,
    A.threshold.default,
    A.softshrink.default,
    A.hardshrink.default,
)

POINTS = 3  # at which an expression is compared with its module

_exporting = threading.Lock()


def in_double(module: torch.nn.Module, name: str) -> torch.nn.Module:
    """Return a copy in double precision, on the CPU, in eval mode."""
    if isinstance(module, torch.jit.ScriptModule):
        raise InputError(f"from_torch({name}): the module is a TorchScript module: give the module that was scripted")
    for path, part in module.named_modules():
        if any(map(torch.nn.parameter.is_lazy, (*part._parameters.values(), *part._buffers.values()))):
            raise InputError(
                f"from_torch({name}): {described(path, type(part).__name__)} has no sizes yet: call the module once on "
                f"an input, or replace lazy layers"
            )
    try:
        twin = copy.deepcopy(module)
    except Exception as error:
        raise InputError(
            f"from_torch({name}): the module cannot be copied ({type(error).__name__}: {error}); tensors that follow "
            f"from parameters must not be kept as attributes: for torch.nn.utils.weight_norm take that of "
            f"torch.nn.utils.parametrizations"
        ) from error
    try:
        return twin.to("cpu").double().eval()
    except Exception as error:
        raise refused_export(name, module, error) from error


def exported(twin: torch.nn.Module, shapes: Sequence[tuple[int, ...]], name: str) -> Any:
    """Return the exported program of a module in double precision.

    Raises:
        InputError: torch cannot export it, or it changes its own buffers.
    """
    # Where torch refuses, it prints and logs at length.
    with double_by_default(), redirect_stderr(io.StringIO()):
        inputs = tuple(torch.zeros(shape) for shape in shapes)
        try:
            program = torch.export.export(twin, inputs, strict=False)
            table = torch.export.default_decompositions()
            for whole in WHOLE:
                table.pop(whole, None)  # type: ignore[no-untyped-call]
            program = program.run_decompositions(table)
        except Exception as error:
            raise refused_export(name, twin, error) from error
    changed = list(program.graph_signature.buffers_to_mutate.values())
    if changed:
        path, _, buffer = changed[0].rpartition(".")
        raise InputError(
            f"from_torch({name}): module {path!r} changes its buffer {buffer!r} when it is called, in eval mode too: "
            f"a model has no memory; make it an input and an output, and with that a slot"
        )
    return program


@contextmanager
def double_by_default() -> Iterator[None]:
    """Let tensors that a module makes be in double precision, and take its layers as they are written.

    Both are switches of the whole process, so exports take turns.
    """
    with _exporting:
        before, fast = torch.get_default_dtype(), torch.backends.mha.get_fastpath_enabled()
        level = logging.root.manager.disable
        torch.set_default_dtype(torch.float64)
        torch.backends.mha.set_fastpath_enabled(False)
        logging.disable(logging.WARNING)
        try:
            yield
        finally:
            logging.disable(level)
            torch.backends.mha.set_fastpath_enabled(fast)
            torch.set_default_dtype(before)


def lowered_module(module: torch.nn.Module, shapes: Sequence[tuple[int, ...]], name: str) -> Lowered:
    """Return a module as a function, kept from an earlier time if it is still the same.

    Raises:
        InputError: torch cannot export it, an operator has no CasADi form, or the function does not compute the same.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they come again where the module is used
        return _lowered_module(module, shapes, name)


def _lowered_module(module: torch.nn.Module, shapes: Sequence[tuple[int, ...]], name: str) -> Lowered:
    twin = in_double(module, name)
    key = cache.fingerprint(twin, shapes)
    found = cache.find(key)
    if found is not None:
        try:
            if _difference(found, twin, shapes, name) <= _tolerance(found):
                return found
        except (SymgraphError, RuntimeError, NotImplementedError, ValueError, LookupError, AttributeError):
            pass  # the file was damaged, or another module's: it is made anew
        cache.forget(key)
    lowered = Lowering(name).run(exported(twin, shapes, name), shapes)
    difference = _difference(lowered, twin, shapes, name)
    if not difference <= _tolerance(lowered):
        raise InputError(
            f"from_torch({name}): the expression differs from the module by {difference:.1e} at random inputs; a "
            f"module must return the same each time, and compute in the precision of its inputs. If it does, please "
            f"report this"
        )
    cache.keep(key, lowered)
    return lowered


def _tolerance(lowered: Lowered) -> float:
    return 1e-4 if lowered.halved else 1e-9


def _difference(lowered: Lowered, twin: torch.nn.Module, shapes: Sequence[tuple[int, ...]], name: str) -> float:
    """Return by how much a function differs from the module at random inputs, relative to the largest output."""
    source = Source("", twin, lowered)
    weights = [ca.DM(LiveWeight(source, weight).value) for weight in lowered.weights]
    worst = 0.0
    with double_by_default(), torch.no_grad():
        for seed in range(POINTS):
            generator = torch.Generator().manual_seed(seed)
            inputs = tuple(torch.randn(shape, generator=generator) for shape in shapes)
            try:
                made = twin(*inputs)
            except Exception as error:  # export does not see everything
                raise refused_export(name, twin, error) from error
            expected = [part for part in leaves(made) if isinstance(part, torch.Tensor)]
            found = lowered.function.call([*(ca.DM(x.flatten().numpy()) for x in inputs), *weights])
            for one, other in zip(found, expected, strict=True):
                here, there = np.array(one).ravel(), other.numpy().ravel()
                scale = max(1.0, float(np.abs(there[np.isfinite(there)]).max(initial=0.0)))
                same = (here == there) | (np.isnan(here) & np.isnan(there))
                worst = max(worst, float(np.where(same, 0.0, np.abs(here - there) / scale).max(initial=0.0)))
    return worst
