"""Weights of a module as parameters of a graph, read from the module whenever they are asked for."""

from __future__ import annotations

from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np

from symgraph.errors import InputError
from symgraph.model import Parameter
from symgraph.slots import Array

if TYPE_CHECKING:
    import torch

    from symgraph.learned.torch_modules.lowering import Lowered, Weight
    from symgraph.learned.torch_modules.tape import Tape


class Source:
    """A module, and what is computed from its weights.

    Args:
        name: for messages.
        module: the user's.
        lowered: what was made of it.
    """

    def __init__(self, name: str, module: torch.nn.Module, lowered: Lowered) -> None:
        self.name = name
        self._module = module
        self._tape: Tape = lowered.tape
        self._kept = {kept: self._state(kept).clone() for kept in lowered.kept}

    def read(self, step: int) -> torch.Tensor:
        """Return a step of the tape for the weights of this moment, in double precision.

        Raises:
            InputError: the module has lost a weight, or has changed a constant, since it was exported.
        """
        for name, value in self._kept.items():
            if not value.equal(self._state(name)):
                raise InputError(
                    f"{self.name}: the buffer {name!r} was a constant when the module was exported, and has changed; "
                    f"call from_torch again"
                )
        return self._tape.run(step, self._double)  # type: ignore[no-any-return]  # a tensor where a weight is

    def _double(self, name: str) -> torch.Tensor:
        import torch

        return self._state(name).to("cpu", torch.float64)

    def _state(self, name: str) -> torch.Tensor:
        try:
            tensor: Any = reduce(getattr, name.split("."), self._module)
        except AttributeError:
            raise InputError(
                f"{self.name}: the module has no {name!r} any more, which it had when it was exported; call "
                f"from_torch again"
            ) from None
        return tensor.detach()  # type: ignore[no-any-return]  # parameters and buffers are tensors


class LiveWeight(Parameter):
    """A parameter that is what the module's weights make it at this moment.

    Args:
        source: where it is read.
        weight: what to read.
    """

    def __init__(self, source: Source, weight: Weight) -> None:
        self._source = source
        self._weight = weight
        super().__init__(self._read(), f"{source.name}.{weight.name}")

    @property
    def value(self) -> Array:
        """The numbers, in the shape of the symbol; train the module to change them."""
        new = self._read()
        if not np.array_equal(new, self._value):
            self._value = self._checked(new)
        return self._value

    @value.setter
    def value(self, value: Any) -> None:
        raise InputError(f"parameter {self.name!r} is read from a torch module: change its weights there")

    def _read(self) -> Array:
        rows, columns = self._weight.shape
        numbers = self._source.read(self._weight.step)
        if numbers.numel() != rows * columns:
            raise InputError(
                f"{self._source.name}: the weights {self._weight.name!r} have {numbers.numel()} elements, and had "
                f"{rows * columns} when the module was exported; call from_torch again"
            )
        return numbers.contiguous().numpy().reshape(columns, rows).T

    def __reduce__(self) -> tuple[Any, ...]:  # to other processes go the numbers of now, which need no torch there
        return Parameter, (self.value, self.name)
