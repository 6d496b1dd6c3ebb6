"""Tape: what a module computes from its weights alone, kept as calls that torch carries out again for new weights.

So reparametrised weights, folded statistics and transposes need no CasADi form and cost a plan nothing.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

Read = Callable[[str], torch.Tensor]  # from the name of a parameter or buffer to its numbers in double precision


@dataclass(frozen=True)
class Derived:
    """A tensor that follows from weights alone: a step of a tape, and its value when it was recorded."""

    step: int
    value: Any

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.value.shape)


@dataclass
class Tape:
    """Calls in order.

    Attributes:
        steps: (name of torch's operator, arguments, named arguments), as JSON knows them; an argument {"step": i} is
            the result of step i. The operator "state" reads the parameter or buffer of that name.
    """

    steps: list[Any] = field(default_factory=list)

    def state(self, name: str, value: torch.Tensor) -> Derived:
        """Record the reading of a parameter or buffer."""
        self.steps.append(["state", [name], {}])
        return Derived(len(self.steps) - 1, value)

    def call(self, target: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
        """Carry out and record an operator some of whose arguments are derived."""
        made = target(*_values(args), **_values(kwargs))
        self.steps.append([_name(target), _encoded(list(args)), _encoded(kwargs)])
        step = len(self.steps) - 1
        if not isinstance(made, (list, tuple)):
            return Derived(step, made)
        parts = []
        for i, part in enumerate(made):
            self.steps.append(["getitem", [{"step": step}, i], {}])
            parts.append(Derived(len(self.steps) - 1, part))
        return parts

    def run(self, step: int, read: Read) -> Any:
        """Return the result of a step for the weights of now."""
        known: dict[int, Any] = {}

        def result(at: int) -> Any:
            if at not in known:
                name, args, kwargs = self.steps[at]
                given = _decoded(args, result), _decoded(kwargs, result)
                known[at] = read(args[0]) if name == "state" else _operator(name)(*given[0], **given[1])
            return known[at]

        with torch.no_grad():
            return result(step)


def is_operator(target: Any) -> bool:
    """Whether torch knows an operator by its name, so that it can be recorded."""
    return target is operator.getitem or isinstance(target, torch._ops.OpOverload)


def _name(target: Any) -> str:
    return "getitem" if target is operator.getitem else str(target)


def _operator(name: str) -> Callable[..., Any]:
    if name == "getitem":
        return operator.getitem
    found: Any = torch.ops
    for part in name.split("."):
        found = getattr(found, part)
    return found  # type: ignore[no-any-return]  # an operator


def _values(tree: Any) -> Any:
    if isinstance(tree, (list, tuple)):
        return [_values(branch) for branch in tree]
    if isinstance(tree, dict):
        return {key: _values(branch) for key, branch in tree.items()}
    return tree.value if isinstance(tree, Derived) else tree


_TORCH = (torch.dtype, torch.device, torch.layout, torch.memory_format)


def _encoded(value: Any) -> Any:
    if isinstance(value, Derived):
        return {"step": value.step}
    if isinstance(value, (list, tuple)):
        return [_encoded(part) for part in value]
    if isinstance(value, dict):
        return {key: _encoded(part) for key, part in value.items()}
    if isinstance(value, torch.Tensor):
        return {"tensor": value.tolist(), "dtype": str(value.dtype).removeprefix("torch.")}
    if isinstance(value, _TORCH):
        return {"torch": str(value).removeprefix("torch.")}
    return value


def _decoded(value: Any, result: Callable[[int], Any]) -> Any:
    if isinstance(value, list):
        return [_decoded(part, result) for part in value]
    if not isinstance(value, dict):
        return value
    if "step" in value:
        return result(value["step"])
    if "tensor" in value:
        return torch.tensor(value["tensor"], dtype=getattr(torch, value["dtype"]))
    if "torch" in value:
        return getattr(torch, value["torch"], None) or torch.device(value["torch"])
    return {key: _decoded(part, result) for key, part in value.items()}
