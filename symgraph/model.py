"""Models: a function of slots, or anything with moments of its own, and its options."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol, runtime_checkable

import casadi as ca
import numpy as np

from symgraph.errors import GraphError, SlotError, did_you_mean, names
from symgraph.propagation import RULES
from symgraph.slots import Array, Gaussian, as_numbers


@runtime_checkable
class Propagator(Protocol):
    """What a model with moments of its own offers, e.g. a network or a closed form.

    `reads` and `writes` hold labels; `propagate` maps {label: Gaussian of MX} to {label: Gaussian of MX}, means as
    (n, 1) columns and covariances as (n, n) matrices. A reward model writes one scalar under any name, a probability
    model one scalar per branch. Weights that change without a rebuild are listed as `parameters`, a sequence of
    `Parameter`, and enter `propagate` by their symbols. Three more attributes are used where there are any: `name`, in
    messages; `with_propagation(rule)`, for `Model(…, propagation=rule)`, which is called with the default of plain
    functions if there is an attribute `propagation` that is None; and `lacking`, a text that says what it still needs
    before it can be planned with, such as "2 of 3 samples", or None.
    """

    reads: Iterable[str]
    writes: Iterable[str]

    def propagate(self, inputs: dict[str, Gaussian]) -> Mapping[str, Gaussian]:
        """Return the Gaussians of what it writes, given those of what it reads."""
        ...


class Parameter:
    """Numbers inside a model that may change without a rebuild, such as a network's weights.

    Derivatives of an objective by parameters are not taken: CasADi finds 0 for them.

    Args:
        value: number or array; its shape is kept for good.

    Raises:
        SlotError: a new value of another shape, or one that is not finite.
    """

    def __init__(self, value: Any, name: str = "parameter") -> None:
        self.name = name
        self._value = self._checked(value)
        self.symbol = ca.MX.sym(name, *self._value.shape)

    @property
    def value(self) -> Array:
        """The numbers, in the shape of the symbol; set it to change them, since they cannot be changed in place."""
        return self._value

    @value.setter
    def value(self, value: Any) -> None:
        new = self._checked(value)
        if new.shape != self._value.shape:
            raise SlotError(f"parameter {self.name!r}: shape {new.shape} for {self._value.shape}; the shape is fixed")
        self._value = new

    def __getstate__(self) -> dict[str, Any]:  # a CasADi symbol does not travel; another one serves
        return {"name": self.name, "_value": self._value}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._value.flags.writeable = False
        self.symbol = ca.MX.sym(self.name, *self._value.shape)

    def _checked(self, value: Any) -> Array:
        numbers = as_numbers(value, f"parameter {self.name!r}")
        if numbers.ndim > 2:
            raise SlotError(f"parameter {self.name!r} has shape {numbers.shape}; give a number, a column or a matrix")
        if not np.isfinite(numbers).all():
            raise SlotError(f"parameter {self.name!r}: the value is not finite")
        # In CasADi's order, and not to be changed in place: kernels keep what follows from the numbers.
        matrix = np.asfortranarray(numbers.reshape(-1, 1) if numbers.ndim < 2 else numbers)
        matrix.flags.writeable = False
        return matrix


class Model:
    """A function or a propagator with its options.

    Args:
        function: a plain function of CasADi columns whose parameter names are slot labels and which returns
            {label: column} (a reward: one scalar; a probability: {branch: scalar}), or a `Propagator`.
            Parameters with a default value are constants of the function, not slots.
        rename: {name in the function: label of the graph}, for what it reads and what it writes.
        propagation: how Gaussians pass: "mean", "linear" (default of an edge and a probability), "second-order"
            (default of a reward), "unscented" or "quadrature" for a plain function; the rules of
            `symgraph.learned.StochasticNetwork` for a network.
        noise: {label: covariance} of independent process noise that is added to what it writes [unit²].

    Raises:
        GraphError: not a function or propagator, an unknown rule, options that do not apply.
    """

    def __init__(
        self,
        function: Callable[..., Any] | Propagator,
        rename: Mapping[str, str] | None = None,
        propagation: str | None = None,
        noise: Mapping[str, Any] | None = None,
    ) -> None:
        self.function = function
        self.name = _name(function)
        examples = ("rename", rename, "{'muzzle': 'lower_muzzle'}"), ("noise", noise, "{'height': 0.01}")
        for option, given, example in examples:
            if given is not None and not isinstance(given, Mapping):
                raise GraphError(f"model {self.name!r}: {option} = {given!r}; give a dict, e.g. {example}")
        self.rename = dict(rename or {})
        self.propagation = propagation
        self.noise = dict(noise or {})
        if isinstance(function, Model):
            raise GraphError(f"model {self.name!r} is wrapped in Model twice; give all options to one Model")
        if not is_propagator(function) and not callable(function):
            raise GraphError(f"{function!r} is not a model; give a function of slots, a Model or a network")
        if propagation is not None and is_propagator(function):
            self.function = self._with_propagation(function, propagation)
        elif propagation is not None and (not isinstance(propagation, str) or propagation not in RULES):
            raise GraphError(
                f"model {self.name!r}: propagation = {propagation!r} is not a rule"
                f"{did_you_mean(propagation, RULES)} Rules: {names(RULES)}"
            )

    def _with_propagation(self, propagator: Any, rule: str) -> Propagator:
        """Return the propagator under another rule, if it has several."""
        if not hasattr(propagator, "with_propagation"):
            raise GraphError(f"model {self.name!r} propagates Gaussians by itself; leave out propagation={rule!r}")
        try:
            return propagator.with_propagation(rule)  # type: ignore[no-any-return]  # any object may offer it
        except ValueError as error:
            raise GraphError(f"model {self.name!r}: {error}") from None

    def __repr__(self) -> str:
        return f"Model({self.name})"


def is_propagator(function: Any) -> bool:
    """Whether a model propagates Gaussians by itself."""
    return isinstance(function, Propagator)


def _name(function: Any) -> str:
    if isinstance(function, Model):
        return function.name
    if is_propagator(function) and isinstance(getattr(function, "name", None), str):
        return str(function.name)
    target = getattr(function, "func", function)  # functools.partial
    return str(getattr(target, "__name__", type(target).__name__))
