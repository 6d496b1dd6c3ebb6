"""Exporting: the graph of a module's operators, traced by torch.export in double precision, and its function."""

from __future__ import annotations

import copy
import inspect
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
from torch.nn.modules import transformer

from symgraph.errors import InputError, SymgraphError
from symgraph.learned.torch_modules import cache
from symgraph.learned.torch_modules.lowered import Lowered
from symgraph.learned.torch_modules.lowering import KNOWN, Lowering
from symgraph.learned.torch_modules.refusals import described, refused_export
from symgraph.learned.torch_modules.symbols import leaves
from symgraph.learned.torch_modules.weights import LiveWeight, Source

# The sizes of the random inputs at which an expression is compared with its module. Far from 0 rounding may grow by
# itself, which does no harm where an earlier export is doubted.
NEAR = (1.0, 1.0, 4.0)
FAR = (*NEAR, 20.0, 100.0)

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
        advice = "leave out attributes that cannot be copied"
        if "graph leaves" in str(error) or "created explicitly" in str(error):
            advice = (
                "tensors that follow from parameters must not be kept as attributes: in place of "
                "torch.nn.utils.weight_norm take that of torch.nn.utils.parametrizations"
            )
        said = f"{type(error).__name__}: {error}".rstrip(".")
        raise InputError(f"from_torch({name}): the module cannot be copied ({said}); {advice}") from error
    try:
        return twin.to("cpu").double().eval()
    except Exception as error:
        raise refused_export(name, module, error, ()) from None


def exported(twin: torch.nn.Module, shapes: Sequence[tuple[int, ...]], name: str) -> Any:
    """Return the exported program of a module in double precision.

    Raises:
        InputError: torch cannot export it, or it changes its own buffers.
    """
    # Where torch refuses, it prints and logs at length.
    try:
        inspect.signature(twin.forward).bind(*shapes)
    except (TypeError, ValueError):
        count = f"{len(shapes)} tensor{'s' * (len(shapes) > 1)}"
        raise InputError(
            f"from_torch({name}): forward{inspect.signature(twin.forward)} cannot be called with {count}: give reads "
            f"as a list with a dict for each tensor; a module that wants anything else, put into one that takes tensors"
        ) from None
    with double_by_default(), redirect_stderr(io.StringIO()):
        inputs = tuple(torch.zeros(shape) for shape in shapes)
        try:
            program = torch.export.export(twin, inputs, strict=False)
            table = torch.export.default_decompositions()
            for known in KNOWN:
                table.pop(known, None)  # type: ignore[no-untyped-call]  # torch gives it no types
            program = program.run_decompositions(table)
        except Exception as error:
            raise refused_export(name, twin, error, shapes) from None
    signature = program.graph_signature
    changed = [*signature.buffers_to_mutate.values(), *getattr(signature, "parameters_to_mutate", {}).values()]
    if changed:
        path, _, tensor = changed[0].rpartition(".")
        place = described(path, type(twin.get_submodule(path)).__name__)
        raise InputError(
            f"from_torch({name}): {place} changes its {tensor!r} when it is called, in eval mode too: a model has no "
            f"memory; make it an input and an output, and with that a slot"
        )
    return program


@contextmanager
def double_by_default() -> Iterator[None]:
    """Let tensors that a module makes be in double precision, and take its layers as they are written.

    These are switches of the whole process, so exports take turns.
    """
    with _exporting:
        before, fast = torch.get_default_dtype(), torch.backends.mha.get_fastpath_enabled()
        level = logging.root.manager.disable
        detect = transformer._detect_is_causal_mask
        torch.set_default_dtype(torch.float64)
        torch.backends.mha.set_fastpath_enabled(False)
        # It looks at a mask's numbers, only to tell layers that they may use another kernel.
        transformer._detect_is_causal_mask = lambda mask, is_causal=None, size=None: bool(is_causal)
        logging.disable(logging.CRITICAL)
        try:
            yield
        finally:
            logging.disable(level)
            transformer._detect_is_causal_mask = detect
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
            if _difference(found, twin, shapes, name, FAR) <= _tolerance(found):
                return found
        except (SymgraphError, RuntimeError, NotImplementedError, ValueError, LookupError, AttributeError):
            pass  # the file was damaged, or another module's: it is made anew
        cache.forget(key)
    program = exported(twin, shapes, name)
    with double_by_default():
        lowered = Lowering(name).run(program, shapes)
    difference = _difference(lowered, twin, shapes, name, NEAR)
    if not difference <= _tolerance(lowered):
        raise InputError(
            f"from_torch({name}): the expression differs from the module by {difference:.1e} at random inputs; a "
            f"module must return the same each time, and compute in the precision of its inputs. If it does, please "
            f"report this"
        )
    cache.keep(key, lowered)
    return lowered


def agrees(lowered: Lowered, module: torch.nn.Module, shapes: Sequence[tuple[int, ...]], name: str) -> bool:
    """Whether a function still computes what a module does."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return _difference(lowered, in_double(module, name), shapes, name, NEAR) <= _tolerance(lowered)
    except (SymgraphError, RuntimeError):
        return False


def _tolerance(lowered: Lowered) -> float:
    return max(1e-9, 100 * lowered.coarsest)


def _difference(
    lowered: Lowered, twin: torch.nn.Module, shapes: Sequence[tuple[int, ...]], name: str, scales: Sequence[float]
) -> float:
    """Return by how much a function differs from the module at random inputs of given sizes, where outputs are large
    relative to them; infinite if one of them is no number where the other one is.
    """
    source = Source(name, twin, lowered)
    weights = [ca.DM(LiveWeight(source, weight).value) for weight in lowered.weights]
    worst = [0.0]
    with double_by_default(), torch.no_grad():
        for seed, scale in enumerate(scales):
            generator = torch.Generator().manual_seed(seed)
            inputs = tuple(scale * torch.randn(shape, generator=generator) for shape in shapes)
            try:
                made = twin(*(x.clone() for x in inputs))  # it may change them in place
            except Exception as error:  # export does not see everything
                raise refused_export(name, twin, error, shapes) from None
            expected = [part for part in leaves(made) if isinstance(part, (torch.Tensor, bool, int, float))]
            found = lowered.function.call([*(ca.DM(x.flatten().numpy()) for x in inputs), *weights])
            for one, other in zip(found, expected, strict=True):
                here, there = np.array(one).ravel(), np.asarray(other, dtype=float).ravel()
                with np.errstate(invalid="ignore"):
                    apart = np.abs(here - there) / np.maximum(1.0, np.abs(there))
                same = (here == there) | (np.isnan(here) & np.isnan(there))
                worst += np.where(same, 0.0, np.where(np.isnan(apart), np.inf, apart)).tolist()
    return max(worst)
