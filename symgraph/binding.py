"""How a model becomes part of a graph: checked against the slots by tracing it, then applied to symbolic Gaussians."""

from __future__ import annotations

import copy
import inspect
import math
import re
import warnings
from collections.abc import Iterable, Mapping
from typing import Any

import casadi as ca
import numpy as np

from symgraph.errors import GraphError, SlotError, SymgraphError, did_you_mean, names
from symgraph.model import Model, Parameter, is_propagator
from symgraph.propagation import RULES
from symgraph.slots import Array, Gaussian, Slot, State, as_covariance

REWARD = "reward"  # the one thing a reward model returns
REQUIREMENT = "requirement"  # likewise

SINGLE = {REWARD: "a reward returns one scalar", REQUIREMENT: "a requirement returns a scalar or a column"}

SCALAR_LIMIT = 50_000  # instructions up to which a model is written out scalar by scalar
FEW_SCALARS = 5_000  # up to which nothing else is worth a thought
MATRIX_GAIN = 20  # between them: what products of matrices must save, since compilers take long over scalars

# The rule of a plain function that does not name one.
DEFAULT_PROPAGATION = {"edge": "linear", "probability": "linear", "reward": "second-order", "requirement": "linear"}


class BoundModel:
    """A model that has been checked against a graph's slots and can be applied to symbolic Gaussians."""

    def __init__(
        self,
        model: Model,
        reads: Mapping[str, str],
        writes: Mapping[str, tuple[str, int]],
        slots: Mapping[str, Slot],
        rule: str | None,
        noise: Mapping[str, Array],
        place: str,
    ) -> None:
        self.name = model.name
        self.place = place
        self.reads = tuple(dict.fromkeys(reads.values()))  # labels, each once
        self.writes = dict(writes.values())
        self.parameters = _parameters(model.function)
        self._function = model.function
        self._reads = dict(reads)  # its own name → label
        self._writes = dict(writes)  # its own name → (label, size)
        self._sizes = {label: slots[label].size for label in self.reads}
        self._rule = rule
        self._noise = dict(noise)
        self._built: dict[tuple[str, ...], ca.Function] = {}

    def at(self, place: str) -> BoundModel:
        """Return the same for another place of the graph; what is built for one serves both."""
        other = copy.copy(self)
        other.place = f"{place}: model {self.name!r}"
        other._built = self._built
        return other

    @property
    def learner(self) -> Any:
        """The model itself if it can be fitted to samples, else None."""
        return self._function if hasattr(self._function, "fit") and is_propagator(self._function) else None

    @property
    def sources(self) -> dict[str, str]:
        """{the model's own name: label} of all that it reads."""
        return dict(self._reads)

    @property
    def targets(self) -> dict[str, str]:
        """{the model's own name: label} of all that it writes."""
        return {name: label for name, (label, _) in self._writes.items()}

    @property
    def lacking(self) -> str | None:
        """What the model still needs before it can be planned with, e.g. "2 of 3 samples"."""
        return getattr(self._function, "lacking", None)

    def __getstate__(self) -> dict[str, Any]:  # CasADi's expressions do not travel; they are built anew
        return {**self.__dict__, "_built": {}}

    def apply(self, inputs: Mapping[str, Gaussian]) -> dict[str, Gaussian]:
        """Return what the model writes, given the Gaussians (of MX) of at least what it reads."""
        function, uncertain = self.moments(inputs)
        arguments = [inputs[label].mean for label in self.reads]
        arguments += [inputs[label].covariance for label in uncertain]
        results = function.call([ca.MX(x) for x in arguments] + [p.symbol for p in self.parameters])
        n = len(self.writes)
        # Of a model that reads nothing CasADi returns numbers.
        return {label: Gaussian(ca.MX(results[i]), ca.MX(results[n + i])) for i, label in enumerate(self.writes)}

    def spread(self, uncertain: frozenset[str]) -> set[str]:
        """Return which of the written labels are uncertain when those given are."""
        function = self.function_for(tuple(label for label in self.reads if label in uncertain))
        n = len(self.writes)
        return {label for i, label in enumerate(self.writes) if function.nnz_out(n + i)}

    def moments(self, inputs: Mapping[str, Gaussian]) -> tuple[ca.Function, tuple[str, ...]]:
        """Return the function from input moments to output moments, and the labels that are uncertain in it.

        Its arguments are the means of all reads, the covariances of the uncertain ones, the parameters; its results
        are the means of all writes and then their covariances.
        """
        uncertain = tuple(label for label in self.reads if inputs[label].covariance.nnz())
        return self.function_for(uncertain), uncertain

    def function_for(self, uncertain: tuple[str, ...]) -> ca.Function:
        """Return the function of `moments` for given uncertain labels, in the order of `reads`."""
        if uncertain not in self._built:
            build = self._build_propagator if is_propagator(self._function) else self._build_function
            self._built[uncertain] = build(uncertain)
        return self._built[uncertain]

    def _build_function(self, uncertain: tuple[str, ...]) -> ca.Function:
        # SX evaluates scalar by scalar and is far faster; MX serves functions that call what SX cannot hold, and those
        # with large matrices, whose products written out would keep the C compiler busy for minutes.
        try:
            traced = self._trace(ca.SX)
        except Exception:
            return self._moments_in(ca.MX, *self._trace(ca.MX), uncertain)
        directions = sum(self._sizes[label] for label in uncertain)
        scalars = _instructions(*traced) * (1 + directions)
        if scalars <= FEW_SCALARS:
            return self._moments_in(ca.SX, *traced, uncertain)
        try:
            matrices = self._trace(ca.MX)
        except Exception:  # it computes with what SX alone has
            return self._moments_in(ca.SX, *traced, uncertain)
        if scalars <= SCALAR_LIMIT and MATRIX_GAIN * _instructions(*matrices) * (1 + directions) > scalars:
            return self._moments_in(ca.SX, *traced, uncertain)
        return self._moments_in(ca.MX, *matrices, uncertain)

    def _moments_in(
        self, kind: Any, x: Mapping[str, Any], y: Mapping[str, Any], uncertain: tuple[str, ...]
    ) -> ca.Function:
        sigma = {label: kind.sym(f"{label}_cov", self._sizes[label], self._sizes[label]) for label in uncertain}
        moments = [RULES[str(self._rule)](y[label], x, sigma) for label in self.writes]
        covariances = [
            covariance + kind(ca.DM(self._noise[label])) if label in self._noise else covariance
            for label, (_, covariance) in zip(self.writes, moments, strict=True)
        ]
        results = [m for m, _ in moments] + [_full(c) for c in covariances]
        results = ca.cse(results) if results else []
        return ca.Function(_identifier(self.name), [*x.values(), *sigma.values()], results)

    def _trace(self, kind: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        x = {label: kind.sym(_identifier(label), self._sizes[label]) for label in self.reads}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # numpy's functions work on CasADi's columns
            returned = self._function(**{name: kind(x[label]) for name, label in self._reads.items()})  # type: ignore[operator]  # no propagator
        if not isinstance(returned, Mapping):  # of a reward or a requirement
            returned = dict.fromkeys(self._writes, returned)
        return x, {label: _column(returned[name], kind) for name, (label, _) in self._writes.items()}

    def _build_propagator(self, uncertain: tuple[str, ...]) -> ca.Function:
        x = {label: ca.MX.sym(_identifier(label), self._sizes[label]) for label in self.reads}
        sigma = {label: ca.MX.sym(f"{label}_cov", self._sizes[label], self._sizes[label]) for label in uncertain}
        y = _call_propagator(self._function, self._reads, x, sigma, self.place)
        gaussians = {label: y[name] for name, (label, _) in self._writes.items()}
        covariances = [
            g.covariance + ca.DM(self._noise[label]) if label in self._noise else g.covariance
            for label, g in gaussians.items()
        ]
        moments = [*x.values(), *sigma.values()]
        function = ca.Function(
            _identifier(self.name),
            [*moments, *(parameter.symbol for parameter in self.parameters)],
            [ca.densify(g.mean) for g in gaussians.values()] + [_full(c) for c in covariances],
            # Nobody asks for derivatives by weights, and the reverse sweep would compute them.
            {"is_diff_in": [True] * len(moments) + [False] * len(self.parameters)},
        )
        if self.parameters:  # weights are matrices: scalar by scalar they would be millions of instructions
            return function
        try:
            return function.expand()
        except RuntimeError:  # it calls what SX cannot hold
            return function


def bind(model: Any, slots: Mapping[str, Slot], role: str, place: str, branches: Iterable[str] = ()) -> BoundModel:
    """Check a model against the slots by tracing it once.

    Args:
        model: a plain function, a `Model` or a `Propagator`.
        slots: the graph's slots.
        role: "edge", "reward", "requirement" or "probability".
        place: where in the graph it stands, for messages.
        branches: the branches whose probabilities a probability model returns.

    Raises:
        GraphError: naming place, model, value and remedy.
    """
    if not isinstance(model, Model):
        try:
            model = Model(model)
        except GraphError as error:
            raise GraphError(f"{place}: {error}") from None
    if is_propagator(model.function) and getattr(model.function, "propagation", "") is None:
        model = copy.copy(model)
        model.function = model.function.with_propagation(DEFAULT_PROPAGATION[role])
    place = f"{place}: model {model.name!r}"
    own_names = _reads(model.function, place)
    reads = {}
    for name in own_names:
        label = model.rename.get(name, name)
        if label not in slots:
            raise GraphError(f"{place} reads {label!r}{did_you_mean(label, slots)} Slots: {names(slots)}")
        reads[name] = label

    sizes = _written_sizes(model.function, reads, slots, role, place)
    writes = _writes(model, sizes, slots, role, place, tuple(branches))
    unused = [name for name in model.rename if name not in reads and name not in sizes]
    if unused:
        known = [*reads, *sizes]
        raise GraphError(
            f"{place}: rename names {unused[0]!r}, which it neither reads nor writes{did_you_mean(unused[0], known)}"
            f" Its names: {names(known)}"
        )
    noise = {}
    for label, covariance in model.noise.items():
        if role != "edge" or label not in dict(writes.values()):
            written = dict(writes.values()) if role == "edge" else {}
            raise GraphError(f"{place}: noise on {label!r}, which it does not write{did_you_mean(label, written)}")
        try:
            noise[label] = as_covariance(covariance, slots[label].size, f"{place}: noise on {label!r}")
        except SlotError as error:
            raise GraphError(str(error)) from None
    noise = {label: covariance for label, covariance in noise.items() if covariance.any()}
    rule = None if is_propagator(model.function) else model.propagation or DEFAULT_PROPAGATION[role]
    return BoundModel(model, reads, writes, slots, rule, noise, place)


def _parameters(function: Any) -> tuple[Parameter, ...]:
    return tuple(getattr(function, "parameters", ())) if is_propagator(function) else ()


def _reads(function: Any, place: str) -> list[str]:
    if is_propagator(function):
        try:
            return list(function.reads)
        except TypeError:
            raise GraphError(f"{place}: reads is {function.reads!r}; give labels, e.g. ('x', 'y')") from None
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        raise GraphError(
            f"{place} shows no parameter names; wrap it in a function whose parameters are slots"
        ) from None
    starred = [p for p in parameters if p.kind in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    if starred:
        stars = "*" if starred[0].kind is starred[0].VAR_POSITIONAL else "**"
        raise GraphError(f"{place} has the parameter '{stars}{starred[0].name}'; name each slot that it reads")
    positional = [p for p in parameters if p.kind is p.POSITIONAL_ONLY and p.default is p.empty]
    if positional:
        raise GraphError(f"{place}: parameter {positional[0].name!r} is positional-only; slots are passed by name")
    return [p.name for p in parameters if p.default is p.empty]


def _written_sizes(
    function: Any, reads: Mapping[str, str], slots: Mapping[str, Slot], role: str, place: str
) -> dict[str, int]:
    """Call the model once on symbols and return {its own name: number of elements} of what it writes."""
    if is_propagator(function):
        x = {label: ca.MX.sym(label, slots[label].size) for label in reads.values()}
        sigma = {label: ca.MX.sym(label, s.size, s.size) for label, s in slots.items() if isinstance(s, State)}
        # The rules of plain functions need no check, and take time.
        known = getattr(function, "propagation", None) in RULES
        sigma = {label: sigma[label] for label in x if label in sigma and not known}
        moments = _call_propagator(function, reads, x, sigma, place)
        if not all(isinstance(parameter, Parameter) for parameter in _parameters(function)):
            raise GraphError(
                f"{place}: parameters is {_short(function.parameters)}; list objects of symgraph.Parameter"
            )
        parameters = [parameter.symbol for parameter in _parameters(function)]
        results = [expression for g in moments.values() for expression in (g.mean, g.covariance)]
        _check_symbols(results, [*x.values(), *sigma.values(), *parameters], place, "list it in `parameters`")
        return {name: gaussian.mean.numel() for name, gaussian in moments.items()}

    def call(kind: Any) -> tuple[Any, list[Any]]:
        # Copies are handed out: a model may change its arguments in place.
        x = {label: kind.sym(_identifier(label), slots[label].size) for label in reads.values()}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # numpy's functions work on CasADi's columns
            return function(**{name: kind(x[label]) for name, label in reads.items()}), list(x.values())

    kind: Any = ca.SX
    try:
        returned, inputs = call(ca.SX)
        if _holds_nan(returned):
            call(ca.MX)  # math.sin and float() turn SX into NaN without a word, but refuse MX
    except Exception as error:
        kind = ca.MX
        try:
            returned, inputs = call(ca.MX)
        except Exception:
            said = str(error).strip().rstrip(".")
            raise GraphError(
                f"{place} raised {type(error).__name__}: {said}. It is called once with CasADi columns named "
                f"{names(reads)}: use CasADi functions (casadi.sin, casadi.if_else) and no Python branches on values"
            ) from error
    if role in SINGLE:
        if isinstance(returned, Mapping):
            raise GraphError(f"{place} returned a dict; {SINGLE[role]}")
        returned = {role: returned}
    elif not isinstance(returned, Mapping):
        what = "a dict {slot: value}" if role == "edge" else "a dict {branch: probability}"
        got = "nothing" if returned is None else f"{type(returned).__name__} {_short(returned)}"
        raise GraphError(f"{place} returned {got}; it must return {what}")
    sizes = {}
    for name, value in returned.items():
        try:
            column = _column(value, kind)
        except Exception:
            raise GraphError(
                f"{place} returned {_short(value)} ({type(value).__name__}) for {name!r}; "
                f"return a CasADi column, a number or a list of them"
            ) from None
        if column.shape[1] != 1:
            shape = f"{column.shape[0]}×{column.shape[1]}"
            raise GraphError(f"{place} returned a {shape} matrix for {name!r}; return a column, e.g. transposed (.T)")
        _check_symbols([column], inputs, place, "read it as a slot, or put a number in its place")
        sizes[str(name)] = int(column.numel())
    return sizes


def _writes(
    model: Model, sizes: Mapping[str, int], slots: Mapping[str, Slot], role: str, place: str, branches: tuple[str, ...]
) -> dict[str, tuple[str, int]]:
    """Return {its own name: (label, size)} after checking names and sizes for the role."""
    if role in SINGLE:
        if len(sizes) != 1:
            raise GraphError(f"{place} writes {names(sizes)}; {SINGLE[role]}")
        name, size = next(iter(sizes.items()))
        if size != 1 and role == REWARD:
            raise GraphError(f"{place} returned {size} elements; {SINGLE[role]}, e.g. casadi.sum1(…)")
        if size == 0:
            raise GraphError(f"{place} returned nothing; {SINGLE[role]}")
        return {name: (role, size)}
    if role == "probability":
        if set(sizes) != set(branches):
            raise GraphError(f"{place} returned the branches {names(sizes)}; the chance has {names(branches)}")
        wrong = [name for name, size in sizes.items() if size != 1]
        if wrong:
            raise GraphError(f"{place} returned {sizes[wrong[0]]} elements for branch {wrong[0]!r}; give a scalar")
        return {name: (name, 1) for name in branches}
    writes: dict[str, tuple[str, int]] = {}
    for name, size in sizes.items():
        label = model.rename.get(name, name)
        if label not in slots:
            raise GraphError(f"{place} writes {label!r}{did_you_mean(label, slots)} Slots: {names(slots)}")
        slot = slots[label]
        if not isinstance(slot, State):
            raise GraphError(f"{place} writes {label!r}, which is {_article(slot)}; models write states only")
        if size != slot.size:
            raise GraphError(f"{place} writes {label!r} with {size} elements; the slot has {slot.size}")
        if label in dict(writes.values()):
            raise GraphError(f"{place} writes {label!r} twice; change rename")
        writes[name] = (label, size)
    return writes


def _instructions(x: Mapping[str, Any], y: Mapping[str, Any]) -> int:
    """Return the number of steps from symbols to expressions."""
    return int(ca.Function("y", list(x.values()), list(y.values())).n_instructions())


def _holds_nan(returned: Any) -> bool:
    """Whether NaN stands as a constant in what a model returned for SX."""
    values = returned.values() if isinstance(returned, Mapping) else [returned]
    try:
        column = ca.vertcat(*[ca.vec(_column(value, ca.SX)) for value in values])
    except Exception:  # not an expression: refused with a reason later
        return False
    function = ca.Function("trace", [], [column], {"allow_free": True})
    constants = [k for k in range(function.n_instructions()) if function.instruction_id(k) == ca.OP_CONST]
    return any(math.isnan(function.instruction_constant(k)) for k in constants)


def _check_symbols(results: list[Any], inputs: list[Any], place: str, remedy: str) -> None:
    foreign = ca.Function("trace", inputs, results, {"allow_free": True}).get_free()
    if foreign:
        raise GraphError(f"{place} uses the symbol {foreign[0]}, which is none of its inputs; {remedy}")


def _call_propagator(
    function: Any, reads: Mapping[str, str], x: Mapping[str, ca.MX], sigma: Mapping[str, ca.MX], place: str
) -> dict[str, Gaussian]:
    inputs = {}
    for name, label in reads.items():
        n = x[label].numel()
        inputs[name] = Gaussian(x[label], sigma.get(label, ca.MX(n, n)))
    try:
        returned = function.propagate(inputs)
    except SymgraphError as error:
        raise GraphError(f"{place}: {error}") from error
    except Exception as error:
        raise GraphError(f"{place} raised {type(error).__name__} in propagate: {error}") from error
    if not isinstance(returned, Mapping) or not all(isinstance(g, Gaussian) for g in returned.values()):
        raise GraphError(f"{place}: propagate returned {_short(returned)}; it must return {{label: Gaussian}}")
    if set(returned) != set(function.writes):
        raise GraphError(f"{place}: propagate returned {names(returned)}, its writes are {names(function.writes)}")
    symbolic = {}
    for name, g in returned.items():
        if isinstance(g.mean, ca.SX) or isinstance(g.covariance, ca.SX):
            raise GraphError(f"{place}: propagate returned SX for {name!r}; compute with the MX that it is given")
        mean = g.mean if isinstance(g.mean, ca.MX) else ca.MX(ca.DM(g.mean))
        covariance = g.covariance if isinstance(g.covariance, ca.MX) else ca.MX(ca.sparsify(ca.DM(g.covariance)))
        symbolic[name] = Gaussian(mean, covariance)
    return symbolic


def _column(value: Any, kind: Any) -> Any:
    """Turn what a model returned for a slot into a dense (n, 1) column (a matrix stays one, for the message)."""
    if isinstance(value, (list, tuple)) or (isinstance(value, np.ndarray) and value.dtype == object):
        value = ca.vertcat(*value)
    return ca.densify(kind(value))


def _full(covariance: Any) -> Any:
    """Make a covariance dense, or leave it without non-zeros."""
    return ca.densify(covariance) if covariance.nnz() else covariance


def _article(slot: Slot) -> str:
    return "an action" if type(slot).__name__ == "Action" else f"a {type(slot).__name__.lower()}"


def _identifier(name: str) -> str:
    """Turn any label into a name that CasADi takes: letters, digits, single underscores."""
    return "f_" + re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") if name else "f"


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
