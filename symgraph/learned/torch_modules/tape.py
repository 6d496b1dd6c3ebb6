"""Tape: what a module computes from its weights alone, kept as calls that torch carries out again for new weights.

So reparametrised weights, folded statistics and transposes need no CasADi form and cost a plan nothing.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch

Read = Callable[[str], torch.Tensor]  # from the name of a parameter or buffer to its numbers in double precision


@dataclass(frozen=True)
class Derived:
    """A tensor that follows from weights alone: a step of a tape, and its value when it was recorded.

    Attributes:
        step: of the tape.
        value: at that time.
        sources: names of the parameters and buffers that it follows from.
    """

    step: int
    value: Any
    sources: tuple[str, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.value.shape)


@dataclass
class Tape:
    """Calls in order.

    Attributes:
        steps: [name of torch's operator, arguments, named arguments], as JSON knows them; an argument {"step": i} is
            the result of step i. The operator "state" reads the parameter or buffer of that name.
    """

    steps: list[Any] = field(default_factory=list)
    _known: dict[str, Any] = field(default_factory=dict, repr=False)

    def state(self, name: str, value: torch.Tensor) -> Derived:
        """Record the reading of a parameter or buffer."""
        return Derived(self._add("state", [name], {}), value, (name,))

    def call(self, target: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
        """Carry out and record an operator some of whose arguments are derived, once for equal arguments."""
        name, given = _name(target), (_encoded(args), {key: _encoded(value) for key, value in kwargs.items()})
        key = repr((name, given))
        if key not in self._known:
            with torch.no_grad():
                made = target(*_values(args), **_values(kwargs))
            sources = tuple(dict.fromkeys(_sources((args, kwargs))))
            step = self._add(name, *given)
            if isinstance(made, (list, tuple)):
                parts = [self._add("getitem", [{"step": step}, i], {}) for i in range(len(made))]
                self._known[key] = [Derived(at, one, sources) for at, one in zip(parts, made, strict=True)]
            else:
                self._known[key] = Derived(step, made, sources)
        return self._known[key]

    def _add(self, *step: Any) -> int:
        self.steps.append(list(step))
        return len(self.steps) - 1

    def run(self, step: int, read: Read) -> Any:
        """Return the result of a step for the weights of now."""
        needed = {step}
        for at in range(step, -1, -1):  # a step comes after those that it needs
            if at in needed:
                _, args, kwargs = self.steps[at]
                needed.update(_steps([*args, *kwargs.values()]))
        results: dict[int, Any] = {}
        with torch.no_grad():
            for at in sorted(needed):
                name, args, kwargs = self.steps[at]
                if name == "state":
                    results[at] = read(args[0])
                else:
                    named = {key: _decoded(value, results) for key, value in kwargs.items()}
                    results[at] = _operator(name)(*_decoded(args, results), **named)
        return results[step]


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


def _sources(tree: Any) -> Iterator[str]:
    if isinstance(tree, (list, tuple)):
        for branch in tree:
            yield from _sources(branch)
    elif isinstance(tree, dict):
        yield from _sources(list(tree.values()))
    elif isinstance(tree, Derived):
        yield from tree.sources


def _steps(tree: Any) -> Iterator[int]:
    if isinstance(tree, list):
        for branch in tree:
            yield from _steps(branch)
    elif isinstance(tree, dict) and "step" in tree:
        yield tree["step"]


def _encoded(value: Any) -> Any:
    if isinstance(value, Derived):
        return {"step": value.step}
    if isinstance(value, (list, tuple)):
        return [_encoded(part) for part in value]
    if isinstance(value, torch.Tensor):
        return {"tensor": _encoded(value.tolist()), "dtype": str(value.dtype).removeprefix("torch.")}
    if isinstance(value, complex):
        return {"complex": [value.real, value.imag]}
    if isinstance(value, torch.device):
        return {"device": str(value)}
    if isinstance(value, (torch.dtype, torch.layout, torch.memory_format)):
        return {"torch": str(value).removeprefix("torch.")}
    return value


def _decoded(value: Any, results: Mapping[int, Any]) -> Any:
    if isinstance(value, list):
        return [_decoded(part, results) for part in value]
    if not isinstance(value, dict):
        return value
    if "step" in value:
        return results[value["step"]]
    if "tensor" in value:
        return torch.tensor(_decoded(value["tensor"], results), dtype=getattr(torch, value["dtype"]))
    if "complex" in value:
        return complex(*value["complex"])
    if "device" in value:
        return torch.device(value["device"])
    return getattr(torch, value["torch"])
