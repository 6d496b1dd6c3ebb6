"""What a module cannot be made an expression for: where that is, and what to do about it."""

from __future__ import annotations

import re
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from symgraph.errors import InputError

TORCH = str(Path(torch.__file__).parent)

ORDER = "the order of numbers does not change smoothly with them; use softmax, logsumexp or amax, or weigh all of them"
NOISE = (
    "a model is a function; add noise where the graph uses it, Model(…, noise={label: variance}), or a Gaussian slot"
)
EMBEDDING = (
    "what is read must not depend on an input; give the choice as a one-hot column, as selections are, and multiply it "
    "with the matrix"
)
COMPLEX = "complex numbers are not supported; write it with real and imaginary parts"
SOLVER = "write the solution out, or make it a CasADi function of its own (casadi.solve) between two modules"
SIZES = "the size of a result must not depend on values; use a mask that multiplies, or torch.where"
LOOP = "control flow must not depend on values; use torch.where, or make it branches of a choice in the graph"
OTHERWISE = (
    "write it with other operators of torch, or split the module there and write this part as a plain function of "
    "CasADi columns"
)

ADVICE = {
    r"aten\.(sort|topk|median|nanmedian|kthvalue|mode|argsort|argmax|argmin|searchsorted|bucketize|unique)": ORDER,
    r"aten\.embedding\w*|aten\._embedding\w*|aten\.(index|gather|take|scatter)\w*": EMBEDDING,
    r"aten\.(\w*fft\w*|view_as_\w+|complex|polar|real|imag|angle|_conj|conj\w*)": COMPLEX,
    r"aten\.\w*(solve|cholesky|linalg_inv|inverse|qr|svd|eig|slogdet|_det|lu_factor|pinv|lstsq|matrix_exp)\w*": SOLVER,
    r"aten\.(nonzero|masked_select|where\.default|unique\w*)": SIZES,
    r"aten\.(_local_scalar_dense|item|is_nonzero|sym_\w+)|\w*_assert\w*|higher_order.*|cond|while_loop|scan|map": LOOP,
}


def advice_on(target: Any) -> str:
    """Return what to do about an operator that has no CasADi form."""
    name = str(target)
    return next((advice for pattern, advice in ADVICE.items() if re.match(rf"({pattern})(\.|$|_)", name)), OTHERWISE)


def place_of(node: Any) -> str:
    """Return the module that a node of an exported graph comes from, and the line."""
    stack = list((node.meta.get("nn_module_stack") or {}).values())
    path, kind = stack[-1] if stack else ("", "")
    line = ""
    lines = re.findall(r'File "([^"]+)", line (\d+)', node.meta.get("stack_trace") or "")
    for file, number in reversed(lines):
        if not file.startswith((TORCH, "<")):
            line = f", {Path(file).name}:{number},"
            break
    return f"{described(path, str(kind).rpartition('.')[2])}{line}"


def described(path: str, kind: str) -> str:
    """Return a module in words."""
    kind = kind.removesuffix("'>")
    return f"module {path!r} ({kind})" if path else f"the module itself ({kind})" if kind else "the module itself"


def refused_export(
    name: str, module: torch.nn.Module, error: Exception, shapes: Sequence[tuple[int, ...]]
) -> InputError:
    """Return the error that says why torch could not export a module, where, and what to do."""
    paths = {id(part): path for path, part in module.named_modules()}
    place, line, distributes = described("", type(module).__name__), "", False
    found = error
    while True:  # the first cause is the nearest to the user's code
        cause = found.__cause__ or (None if found.__suppress_context__ else found.__context__)
        frames = list(traceback.walk_tb(found.__traceback__))
        for frame, number in frames:
            code = frame.f_code
            here = frame.f_locals.get(code.co_varnames[0]) if code.co_argcount else None
            distributes = distributes or code.co_filename.startswith(f"{TORCH}/distributions")
            if id(here) in paths and code.co_name == "forward":
                place = described(paths[id(here)], type(here).__name__)
                if not frame.f_code.co_filename.startswith(TORCH):
                    line = f", {Path(frame.f_code.co_filename).name}:{number},"
        if not isinstance(cause, Exception):
            break
        found = cause
    if distributes:
        return InputError(
            f"from_torch({name}): {place}{line} makes a distribution: return its mean and its deviation as tensors"
        )
    text = f"{type(error).__name__}: {error}"
    said = next((part.strip() for part in str(error).splitlines() if part.strip()), type(error).__name__)
    for pattern, what, advice in EXPORT:
        if re.search(pattern, text, re.DOTALL):
            return InputError(f"from_torch({name}): {place}{line} {what}: {advice}")
    given = " and ".join(f"({', '.join(map(str, shape))})" for shape in shapes)
    return InputError(
        f"from_torch({name}): {place}{line} cannot be called by torch.export with what reads makes, a tensor of shape "
        f"{given} ({type(error).__name__}: {said.rstrip('.')}); give other sizes or shapes, or mend the module"
    )


EXPORT = [
    (r"scalar types: Long, Int", "looks up real numbers in a table", EMBEDDING),
    (r"(?i)torch\.cond|cond_op|true_fn", "chooses by torch.cond", LOOP),
    (
        r"(?i)functorch|torch\._?func|autograd\.grad|requires_grad|fake tensor in the exported program|data pointer",
        "takes derivatives in forward",
        "torch.export cannot follow them; write the derivative out with torch's operators",
    ),
    (
        r"(?i)nonzero|masked_select|unbacked symint.*size|dynamic output shape",
        "makes tensors whose size depends on values",
        SIZES,
    ),
    (
        r"(?i)data.dependent|GuardOnDataDependent|_local_scalar_dense|could not (guard|extract)|aten\.(item|equal)",
        "decides by the value of a tensor (if, while, float(x), x.item())",
        LOOP,
    ),
    (r"(?i)numpy|__array__", "leaves torch for numpy", "write it with torch's operators"),
    (
        r"(?i)same dtype|expected .*dtype|dtype mismatch",
        "mixes precisions",
        "models compute in double precision: make new tensors with dtype=x.dtype, and leave out .float() and .half()",
    ),
]
