"""from_torch: a user's torch module as a model of a graph."""

from __future__ import annotations

import copy
import itertools
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Self

import casadi as ca
import numpy as np

from symgraph.compile.interpreted import FlatFunction
from symgraph.errors import GraphError, InputError, did_you_mean, names
from symgraph.learned.inputs import checked_option, checked_rows
from symgraph.learned.torch_modules.arguments import READS, WRITES, Tensors, matched, tensors_of
from symgraph.learned.torch_modules.weights import LiveWeight, Source
from symgraph.learned.training import import_torch
from symgraph.model import Parameter
from symgraph.progress import Progress
from symgraph.propagation import RULES
from symgraph.slots import Array, Gaussian

if TYPE_CHECKING:
    import torch

    Modules = torch.nn.Module | Sequence[torch.nn.Module]

MOST_CURVED = 200  # directions of a Hessian, whose expression takes seconds to build
SIGNS = 5  # random inputs at which deviations must not be negative
OVER_POINTS = ("unscented", "quadrature")  # rules that evaluate a module many times


class TorchModel:
    """A torch module, or an ensemble of them, in a graph; a `Propagator`. See `from_torch`.

    Attributes:
        name: shown in messages and pictures.
        reads: {label: number of elements}.
        writes: {label: number of elements}.
        propagation: how Gaussians pass; None is the default of plain functions.
        parameters: the weights, read from the modules whenever a plan is made.
    """

    def __init__(
        self,
        name: str,
        reads: Tensors,
        writes: Tensors,
        deviations: Mapping[str, str],
        members: Sequence[tuple[ca.Function, tuple[Parameter, ...]]],
    ) -> None:
        self.name = name
        self.reads = reads.sizes
        self.writes = {label: size for label, size in writes.sizes.items() if label not in deviations.values()}
        self._deviations = dict(deviations)
        self.propagation: str | None = None
        self._reads = reads
        self._writes = writes
        self._members = tuple(members)
        self._built: dict[tuple[int, str, tuple[str, ...]], ca.Function] = {}
        self._prediction: FlatFunction | None = None

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return tuple(parameter for _, parameters in self._members for parameter in parameters)

    def with_propagation(self, rule: str) -> Self:
        """Return a view under another rule, of the same modules.

        Args:
            rule: "mean", "linear", "second-order", "unscented" or "quadrature".

        Raises:
            InputError: no such rule.
        """
        view = copy.copy(self)
        view.propagation = checked_option(rule, RULES, f"{self.name}: propagation")
        view._built = self._built  # one function for all edges becomes one piece of machine code
        return view

    def propagate(self, inputs: Mapping[str, Gaussian]) -> dict[str, Gaussian]:
        """Return the Gaussians of what it writes, as expressions of its parameters; see `Propagator`."""
        for label, size in self.reads.items():
            if inputs[label].mean.numel() != size:
                raise GraphError(
                    f"{self.name} reads {label!r} with size {size}, the slot has size {inputs[label].mean.numel()}; "
                    f"make them the same (a selection has as many elements as it has choices)"
                )
        uncertain = tuple(label for label in self.reads if inputs[label].covariance.nnz())
        given = [inputs[label].mean for label in self.reads]
        given += [ca.densify(inputs[label].covariance) for label in uncertain]
        moments = []
        for i, (_, parameters) in enumerate(self._members):
            function = self._moments(i, self.propagation or "linear", uncertain)
            moments.append(function.call([ca.MX(part) for part in given] + [p.symbol for p in parameters]))
        mean, covariance = _mixed([(m, c) for m, c in moments])
        edges = itertools.accumulate(self.writes.values(), initial=0)
        parts = zip(self.writes, itertools.pairwise(edges), strict=True)
        return {label: Gaussian(mean[a:b], covariance[a:b, a:b]) for label, (a, b) in parts}

    def predict(self, x: Any) -> tuple[Array, Array]:
        """Return mean and covariance of the outputs at exact inputs.

        Args:
            x: (n,) or (N, n), in the order of `reads`.

        Returns:
            (m,) and (m, m), or (N, m) and (N, m, m), in the order of `writes`; a single module has covariances of 0.

        Raises:
            InputError: an array of another shape.
        """
        n, m = sum(self.reads.values()), sum(self.writes.values())
        x = x.detach().cpu() if hasattr(x, "detach") else x  # a tensor
        single = np.ndim(x) == 1
        rows = checked_rows([x] if single else x, n, f"{self.name}: x")
        if self._prediction is None:
            column = ca.MX.sym("x", n)
            edges = np.cumsum([0, *self.reads.values()]).tolist()
            inputs = zip(self.reads, ca.vertsplit(column, edges), strict=True)
            made = self.propagate(
                {label: Gaussian(part, ca.MX(*2 * part.shape[:1])) for label, part in inputs}
            ).values()
            moments = [ca.vertcat(*[g.mean for g in made]), ca.diagcat(*[g.covariance for g in made])]
            symbols = [column, *(p.symbol for p in self.parameters)]
            self._prediction = FlatFunction(ca.Function("predict", symbols, [ca.densify(part) for part in moments]))
        weights = [p.value.ravel(order="F") for p in self.parameters]
        found = [self._prediction([row, *weights]) for row in rows]
        mean, covariance = np.array([y for y, _ in found]), np.array([c.reshape(m, m) for _, c in found])
        return (mean[0], covariance[0]) if single else (mean, covariance)

    def _moments(self, member: int, rule: str, uncertain: tuple[str, ...]) -> ca.Function:
        """Return means of inputs, covariances of the uncertain ones, weights → mean and covariance of all outputs."""
        function, parameters = self._members[member]
        first = next(i for i, (other, _) in enumerate(self._members) if other is function)
        key = first, rule, uncertain
        if key not in self._built:
            directions = sum(self.reads[label] for label in uncertain)
            if rule == "second-order" and directions > MOST_CURVED:
                raise GraphError(
                    f"{self.name}: propagation 'second-order' over {directions} uncertain directions "
                    f"({names(uncertain)}) takes a Hessian of that size; ask for 'linear' or 'mean', or make fewer of "
                    f"them uncertain"
                )
            x = {label: ca.MX.sym(f"x{i}", size) for i, (label, size) in enumerate(self.reads.items())}
            sigma = {
                label: ca.MX.sym(f"s{i}", self.reads[label], self.reads[label]) for i, label in enumerate(uncertain)
            }
            weights = [ca.MX.sym(f"w{i}", *p.symbol.shape) for i, p in enumerate(parameters)]
            tensors = [ca.vertcat(*[x[label] for label in labels]) for labels in self._reads.labels]
            calls = rule in OVER_POINTS and bool(uncertain)  # one piece of code for all points
            made = function.call([*tensors, *weights], not calls, calls)
            y = ca.vertcat(*[made[i] for i, labels in enumerate(self._writes.labels) if labels])
            edges = np.cumsum([0, *self._writes.sizes.values()]).tolist()
            parts = dict(zip(self._writes.sizes, ca.vertsplit(y, edges), strict=True))
            variances = [parts[self._deviations[label]] ** 2 for label in self.writes if label in self._deviations]
            mean, covariance = RULES[rule](ca.vertcat(*[parts[label] for label in self.writes], *variances), x, sigma)
            mean, covariance = self._with_own(mean, covariance)
            inputs = [*x.values(), *sigma.values()]
            differentiable = [True] * len(inputs) + [False] * len(weights)
            self._built[key] = ca.Function(
                "moments", [*inputs, *weights], [ca.densify(mean), covariance], {"is_diff_in": differentiable}
            )
        return self._built[key]

    def _with_own(self, moments: ca.MX, covariance: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Take the expected variances that outputs have of their own from the end of the moments to the covariance."""
        m = sum(self.writes.values())
        mean, own = moments[:m], moments[m:]
        covariance = covariance[:m, :m]
        if not self._deviations:
            return mean, covariance
        parts, begin = [], 0
        for label, size in self.writes.items():
            count = size if label in self._deviations else 0
            parts.append(own[begin : begin + count] if count else ca.MX(size, 1))
            begin += count
        return mean, covariance + ca.diag(ca.vertcat(*parts))

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_built": {}, "_prediction": None}

    def __repr__(self) -> str:
        count = f", {len(self._members)} members" if len(self._members) > 1 else ""
        return f"TorchModel({self.name}: {', '.join(self.reads)} → {', '.join(self.writes)}{count})"


def _mixed(moments: Sequence[tuple[ca.MX, ca.MX]]) -> tuple[ca.MX, ca.MX]:
    """Return mean and covariance of a mixture of equal shares."""
    count = len(moments)
    if count == 1:
        return moments[0]
    mean = sum((m for m, _ in moments), ca.MX(0.0)) / count
    apart = ca.horzcat(*[m - mean for m, _ in moments])
    within = [c for _, c in moments if c.nnz()]
    covariance = ca.mtimes(apart, apart.T) / count
    return mean, covariance + sum(within, ca.MX(0.0)) / count if within else covariance


def from_torch(
    module: Modules,
    reads: Any,
    writes: Any,
    *,
    deviations: Mapping[str, str] | None = None,
    name: str | None = None,
) -> TorchModel:
    """Return a torch module as a model, exact to rounding, with first and second derivatives.

    The module is exported by `torch.export` in double precision and eval mode, and written anew as a CasADi expression
    of its inputs and its weights. The weights are read from the module whenever a plan is made: train it on, and the
    next plan uses what it has learned, without a build. What it computes with them is fixed when it is exported.
    Derivatives are those of the values: `detach` and backward methods of one's own do not count.

    A list of modules is an ensemble: of a Gaussian mixture with equal shares, mean and covariance are

        μ = Σₖ μₖ / K,   Σ = Σₖ (Σₖ + (μₖ - μ)(μₖ - μ)ᵀ) / K.

    Args:
        module: any `torch.nn.Module` whose control flow does not depend on values; or a list of them.
        reads: {label: number of elements n} of the inputs. They stand beside each other in one row (1, Σn), a batch of
            one. A shape such as (1, 5, 3) in the place of a number gives the label a tensor of its own, whose last
            index runs fastest. A module that takes several tensors gets a list of such dicts.
        writes: {label: number of elements} of what it returns, likewise; for several tensors a list of dicts, an empty
            one for what is not needed.
        deviations: {label: label in `writes` that holds its standard deviations σ}, for outputs that are uncertain by
            themselves. The second label is not written; E[σ²] is added to the variances of the first one.
        name: shown in messages and pictures; the module's class, if left out.

    Returns:
        a model with the rules of plain functions, `Model(…, propagation="unscented")`.

    Raises:
        InputError: labels or sizes that do not fit, or an operator that has no CasADi form; the message names the
            module, the operator, and what to do.
        MissingExtraError: torch is not installed.

    Source for ensembles: Lakshminarayanan et al., Simple and scalable predictive uncertainty estimation using deep
    ensembles, NeurIPS 2017.
    """
    torch = import_torch()
    modules: list[Any] = list(module) if isinstance(module, (list, tuple, torch.nn.ModuleList)) else [module]
    if not modules:
        raise InputError("from_torch: the list of modules is empty; give one or more")
    for one in modules:
        if not isinstance(one, torch.nn.Module):
            raise InputError(
                f"from_torch: {type(one).__name__} is no torch.nn.Module; give the module itself, put a function into "
                f"the forward method of one, or give the graph a plain function of CasADi columns"
            )
    name = type(modules[0]).__name__ if name is None else str(name)
    place = f"from_torch({name})"
    inputs, outputs = tensors_of(reads, f"{place}: reads", READS), tensors_of(writes, f"{place}: writes", WRITES)
    own = _checked_deviations(deviations, outputs, place)
    from symgraph.learned.torch_modules.exporting import agrees, lowered_module

    members: list[tuple[ca.Function, tuple[Parameter, ...]]] = []
    found = outputs
    with Progress(f"exporting {name}") as bar:
        for i, one in enumerate(modules):
            label = name if len(modules) == 1 else f"{name}[{i}]"
            bar.wait(f"exporting {label}")
            lowered = lowered_module(one, inputs.shapes, label)
            labels = matched(outputs, lowered.shapes, lowered.names, place)
            if members and labels != found:
                raise InputError(
                    f"{place}: members return their outputs in different orders; make them return the same"
                )
            found = labels
            source = Source(label, one, lowered, partial(agrees, lowered, one, inputs.shapes, label))
            weights = tuple(LiveWeight(source, weight, leads=not k) for k, weight in enumerate(lowered.weights))
            members.append((lowered.function, weights))
    model = TorchModel(name, inputs, found, own, members)
    _check_signs(model, found, own, place)
    return model


def _check_signs(model: TorchModel, writes: Tensors, deviations: Mapping[str, str], place: str) -> None:
    """Look at predicted deviations at random inputs: networks often return the logarithm of a variance."""
    rng = np.random.default_rng(0)
    for function, parameters in model._members if deviations else ():
        for _ in range(SIGNS):
            inputs = [rng.normal(size=function.size_in(i)) for i in range(function.n_in() - len(parameters))]
            made = function.call([*map(ca.DM, inputs), *(ca.DM(p.value) for p in parameters)])
            column = np.concatenate([np.array(made[i]).ravel() for i, labels in enumerate(writes.labels) if labels])
            edges = np.cumsum([0, *writes.sizes.values()])
            parts = dict(zip(writes.sizes, np.split(column, edges[1:-1]), strict=True))
            for label, other in deviations.items():
                if (parts[other] < 0).any():
                    raise InputError(
                        f"{place}: {other!r}, which is to hold the deviations of {label!r}, is "
                        f"{parts[other].min():.3g} at random inputs; of the logarithm of a variance return "
                        f"exp(0.5 · it), which is a deviation"
                    )


def _checked_deviations(given: Any, writes: Tensors, place: str) -> dict[str, str]:
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise InputError(f"{place}: deviations = {given!r}; give {{label: label of its standard deviations}}")
    for label, other in given.items():
        for name in (label, other):
            if name not in writes.sizes:
                raise InputError(
                    f"{place}: deviations name {name!r}{did_you_mean(name, writes.sizes)} Labels in writes: "
                    f"{names(writes.sizes)}"
                )
        if other in given or list(given.values()).count(other) > 1:
            raise InputError(f"{place}: {other!r} holds the deviations of {label!r}, and can be nothing else besides")
        if writes.sizes[label] != writes.sizes[other]:
            raise InputError(
                f"{place}: {label!r} has {writes.sizes[label]} elements, its deviations {other!r} have "
                f"{writes.sizes[other]}"
            )
    return dict(given)
