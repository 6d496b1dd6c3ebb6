"""Weights of a module as parameters of a graph, read from the module whenever they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np

from symgraph.errors import InputError
from symgraph.model import Parameter
from symgraph.slots import Array

if TYPE_CHECKING:
    import torch

    from symgraph.learned.torch_modules.lowered import Lowered, Weight
    from symgraph.learned.torch_modules.tape import Tape


AGAIN = "call from_torch again"


class Source:
    """A module, and what is computed from its weights.

    Args:
        name: for messages.
        module: the user's.
        lowered: what was made of it.
        agrees: whether that still computes what the module does.
    """

    def __init__(
        self, name: str, module: torch.nn.Module, lowered: Lowered, agrees: Callable[[], bool] = lambda: True
    ) -> None:
        self.name = name
        self._module = module
        self._agrees = agrees
        self._settings = self._settings_now()
        self._tape: Tape = lowered.tape
        self._kept = {kept: self._state(kept).clone() for kept in lowered.kept}

    def check(self) -> None:
        """Compare the module with its expression in numbers, if its layers or settings are others than they were.

        Raises:
            InputError: it computes something else.
        """
        settings = self._settings_now()
        if settings is not None and settings != self._settings:
            if not self._agrees():
                raise InputError(
                    f"{self.name}: the module's layers, settings or tensors that are no buffers have changed, and it "
                    f"computes something else than when it was exported; {AGAIN}"
                )
            self._settings = settings

    def _settings_now(self) -> str | None:
        from symgraph.learned.torch_modules.description import settings_of  # brings torch

        return settings_of(self._module)

    def states(self, names: Sequence[str]) -> dict[str, torch.Tensor]:
        """Return parameters and buffers of this moment as they are.

        Raises:
            InputError: the module has lost one, or has changed a constant, since it was exported.
        """
        for name, value in self._kept.items():
            if not _same(value, self._state(name)):
                raise InputError(
                    f"{self.name}: the buffer {name!r} was a constant when the module was exported, and has changed; "
                    f"{AGAIN}"
                )
        return {name: self._state(name) for name in names}

    def read(self, step: int, states: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return a step of the tape, computed in double precision."""
        import torch

        double = {name: state.to("cpu", torch.float64) for name, state in states.items()}
        return self._tape.run(step, double.__getitem__)  # type: ignore[no-any-return]  # a tensor where a weight is

    def _state(self, name: str) -> torch.Tensor:
        try:
            tensor: Any = reduce(getattr, name.split("."), self._module)
        except AttributeError:
            raise InputError(
                f"{self.name}: the module has no {name!r} any more, which it had when it was exported; call "
                f"from_torch again"
            ) from None
        if tensor is None:
            raise InputError(f"{self.name}: {name!r} is None, and was a tensor when the module was exported; {AGAIN}")
        return tensor.detach()  # type: ignore[no-any-return]  # parameters and buffers are tensors


class LiveWeight(Parameter):
    """A parameter that is what the module's weights make it at this moment.

    Args:
        source: where it is read.
        weight: what to read.
        leads: whether it checks the module for all of its weights.
    """

    def __init__(self, source: Source, weight: Weight, leads: bool = False) -> None:
        self._source = source
        self._leads = leads
        self._weight = weight
        states = source.states(weight.sources)
        super().__init__(self._computed(states), f"{source.name}.{' + '.join(weight.sources)}")
        self._seen = {name: state.clone() for name, state in states.items()}

    @property
    def value(self) -> Array:
        """The numbers, in the shape of the symbol; train the module to change them."""
        if self._leads:
            self._source.check()
        states = self._source.states(self._weight.sources)
        # Numbers are compared: there are ways to change a tensor that its version does not tell.
        if not all(_same(state, self._seen[name]) for name, state in states.items()):
            self._value = self._checked(self._computed(states))
            self._seen = {name: state.clone() for name, state in states.items()}
        return self._value

    @value.setter
    def value(self, value: Any) -> None:
        raise InputError(f"parameter {self.name!r} is read from a torch module: change its weights there")

    def _computed(self, states: Mapping[str, torch.Tensor]) -> Array:
        rows, columns = self._weight.shape
        numbers = self._source.read(self._weight.step, states)
        if numbers.numel() != rows * columns or (numbers.ndim and numbers.shape[-1] != rows):
            names = " + ".join(self._weight.sources)
            raise InputError(
                f"{self._source.name}: the weights {names!r} make a tensor of shape {tuple(numbers.shape)}, and were "
                f"{columns} × {rows} when the module was exported; {AGAIN}"
            )
        return np.array(numbers.contiguous().numpy().reshape(columns, rows)).T  # a copy: training goes on in place

    def __reduce__(self) -> tuple[Any, ...]:  # to other processes go the numbers of now, which need no torch there
        return Parameter, (self.value, self.name)


def _same(one: torch.Tensor, other: torch.Tensor) -> bool:
    if one.dtype != other.dtype or one.device != other.device or one.shape != other.shape:
        return False
    return one.equal(other) or bool(((one == other) | ((one != one) & (other != other))).all())
