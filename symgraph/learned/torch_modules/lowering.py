"""Lowering: an exported graph of torch's core operators to a CasADi function of inputs and weights."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch.export.graph_signature import InputKind, OutputKind

from symgraph.errors import InputError
from symgraph.learned.torch_modules.layers import COMPOSED, PLAIN
from symgraph.learned.torch_modules.reductions import REDUCTIONS
from symgraph.learned.torch_modules.refusals import NOISE, advice_on, place_of
from symgraph.learned.torch_modules.scalars import ELEMENTWISE
from symgraph.learned.torch_modules.symbols import (
    LINEAR,
    MOVES,
    Symbol,
    Unavailable,
    constant,
    gather,
    leaves,
    linear,
    mapped,
    moved,
)
from symgraph.learned.torch_modules.tape import Derived, Tape, is_operator

A = torch.ops.aten

# Named arguments that say how torch keeps numbers, not what they are.
STORAGE = {"dtype", "layout", "device", "pin_memory", "memory_format", "requires_grad"}


@dataclass(frozen=True)
class Weight:
    """An input of the lowered function: what to read it from, and its shape in CasADi.

    Attributes:
        sources: names of the parameters and buffers that it follows from.
        step: of the tape.
        shape: (rows, columns).
    """

    sources: tuple[str, ...]
    step: int
    shape: tuple[int, int]


@dataclass(frozen=True)
class Lowered:
    """A module as a function.

    Attributes:
        function: inputs, each (n, 1), then weights → outputs, each (m, 1); in torch's order.
        shapes: of the outputs.
        tape: what torch computes from weights.
        weights: the function's inputs after those of the module.
        kept: names of buffers that became constants.
        halved: whether it computes with less than double precision somewhere inside.
    """

    function: ca.Function
    shapes: tuple[tuple[int, ...], ...]
    tape: Tape
    weights: tuple[Weight, ...]
    kept: tuple[str, ...]
    halved: bool


class Lowering:
    """Walks through a graph, one value for each node."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._tape = Tape()
        self._symbols: dict[int, tuple[Weight, Symbol]] = {}
        self._sources: dict[int, str] = {}
        self._kept: list[str] = []
        self._halved = False
        self._node: Any = None

    def run(self, program: Any, shapes: Sequence[tuple[int, ...]]) -> Lowered:
        """Return the function of an exported program.

        Raises:
            InputError: an operator that has no CasADi form, naming the module that it is in.
        """
        state: Mapping[str, Any] = {**program.state_dict, **program.constants}
        sources = {spec.arg.name: spec for spec in program.graph_signature.input_specs}
        wanted = [spec.kind is OutputKind.USER_OUTPUT for spec in program.graph_signature.output_specs]
        inputs: list[ca.MX] = []
        known: dict[Any, Any] = {}
        results: Any = None
        for node in program.graph.nodes:
            self._node = node
            if node.op == "placeholder":
                source = sources[node.name]
                if source.kind is InputKind.USER_INPUT:
                    shape = shapes[len(inputs)]
                    inputs.append(ca.MX.sym(node.name, math.prod(shape)))
                    known[node] = Symbol(inputs[-1], shape)
                elif source.kind is InputKind.TOKEN:  # keeps effects in order, of which there are none here
                    known[node] = None
                else:
                    name = source.target
                    known[node] = self._state(name, state[name].detach(), name in program.state_dict)
            elif node.op == "call_function":
                args, kwargs = (torch.fx.node.map_arg(part, known.__getitem__) for part in (node.args, node.kwargs))
                known[node] = self.call(node.target, *args, **kwargs)
            elif node.op == "output":
                made = torch.fx.node.map_arg(node.args[0], known.__getitem__)
                results = [result for result, is_wanted in zip(made, wanted, strict=True) if is_wanted]
            else:  # "get_attr": what operators of higher order call
                known[node] = node.target
        outputs = [self.lift(result) for result in leaves(results) if result is not None]
        weights = [self._symbols[step] for step in sorted(self._symbols)]
        arguments = [*inputs, *(symbol.column for _, symbol in weights)]
        matrices = [ca.MX.sym(f"w{i}", *weight.shape) for i, (weight, _) in enumerate(weights)]
        columns = ca.graph_substitute(
            [ca.densify(output.column) for output in outputs],
            arguments[len(inputs) :],
            [ca.vec(matrix) for matrix in matrices],
        )
        function = ca.Function(
            "module",
            [*inputs, *matrices],
            columns,
            # Nobody asks for derivatives by weights, and reverse sweeps would compute them.
            {"is_diff_in": [True] * len(inputs) + [False] * len(matrices)},
        )
        return Lowered(
            function,
            tuple(output.shape for output in outputs),
            self._tape,
            tuple(weight for weight, _ in weights),
            tuple(self._kept),
            self._halved,
        )

    def _state(self, name: str, value: torch.Tensor, belongs: bool) -> Any:
        """Return a parameter or buffer: numbers that may change, or a constant."""
        if not belongs:  # a tensor that is no parameter and no buffer
            return value
        if not value.is_floating_point() or (not value.isfinite().all() and not value.requires_grad):
            if self._node.users:
                self._kept.append(name)
            return value
        derived = self._tape.state(name, value)
        self._sources[derived.step] = name
        return derived

    def call(self, target: Any, *args: Any, **kwargs: Any) -> Any:
        """Carry out an operator: as an expression, on the tape, or at once where all is constant.

        Raises:
            InputError: it has no CasADi form.
        """
        if target in CHECKS:
            return None
        if target is torch.ops.higher_order.with_effects:
            token, inner, *others = args
            return [token, self.call(inner, *others, **kwargs)]
        if _draws(target, args, kwargs):
            raise self._refusal(f"draws random numbers ({target})", NOISE)
        given = leaves((args, kwargs))
        gone = next((value for value in given if isinstance(value, Unavailable)), None)
        if gone is not None and target is not operator.getitem:
            raise self._refusal(f"uses {gone.what}", "they do not change smoothly with the inputs; leave them out")
        if target is operator.getitem:
            return args[0][args[1]]
        if any(isinstance(value, Symbol) for value in given):
            return self._symbolic(target, args, kwargs)
        if not is_operator(target) and not _plain(given):
            raise self._refusal(f"calls {target}", advice_on(target))
        if any(isinstance(value, Derived) for value in given):
            return self._tape.call(target, args, kwargs)
        with torch.no_grad():
            return target(*args, **kwargs)

    def lift(self, value: Any) -> Symbol:
        """Return a tensor as an expression: of a weight's symbol, or a constant."""
        if isinstance(value, Unavailable):
            raise self._refusal(f"returns {value.what}", "they do not change smoothly with the inputs; leave them out")
        if isinstance(value, Symbol):
            return value
        if not isinstance(value, Derived):
            return constant(value)
        if value.step not in self._symbols:
            numbers = value.value
            rows = numbers.shape[-1] if numbers.ndim else 1
            shape = rows, numbers.numel() // rows if rows else 0
            weight = Weight(tuple(dict.fromkeys(self._ancestors(value.step))), value.step, shape)
            column = ca.MX.sym("w", numbers.numel())
            self._symbols[value.step] = weight, Symbol(column, tuple(numbers.shape), fixed=True)
        return self._symbols[value.step][1]

    def _ancestors(self, step: int) -> Iterator[str]:
        if step in self._sources:
            yield self._sources[step]
        for part in _steps_in(self._tape.steps[step][1:]):
            yield from self._ancestors(part)

    def _symbolic(self, target: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
        if target is A._to_copy.default:
            return self._cast(args[0], kwargs.get("dtype"))
        settings = {key: value for key, value in kwargs.items() if key not in STORAGE}
        if target in ELEMENTWISE:
            return self._elementwise(target, args, settings)
        if target is A.index_put.default and len(args) > 3 and args[3]:  # it adds
            return linear(target, *self._lifted(target, args, {}))
        if target in MOVES:
            return self._moved(target, args, kwargs)
        if target is A.constant_pad_nd.default:
            return self._padded(*args)
        if target in LINEAR:
            return linear(target, *self._lifted(target, args, settings))
        if target in REDUCTIONS:
            return REDUCTIONS[target](*self._lifted(target, args, {})[0], **settings)
        if target in PLAIN:
            return PLAIN[target](*self._lifted(target, args, {})[0], **settings)
        if target in COMPOSED:
            first, *others = args
            first = first if first is None else self.lift(first)
            return COMPOSED[target](self.call, first, *others, **settings)
        if target in FILLED:
            return FILLED[target](*args, **settings)
        raise self._refusal(f"calls {target}", advice_on(target))

    def _lifted(self, target: Any, args: Any, kwargs: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """Return arguments with all tensors of real numbers as expressions; those that choose must be constants."""

        def lifted(value: Any) -> Any:
            if isinstance(value, Derived) and not value.value.is_floating_point():
                advice = "indices and masks must be constants; keep them in buffers of whole numbers or booleans"
                raise self._refusal(f"chooses by what follows from weights ({target})", advice)
            if isinstance(value, Derived) or (isinstance(value, torch.Tensor) and value.is_floating_point()):
                return self.lift(value)
            return value

        return mapped(lifted, args), mapped(lifted, kwargs)

    def _moved(self, target: Any, args: Any, kwargs: dict[str, Any]) -> Any:
        given, named = self._lifted(target, args, kwargs)
        chosen = _index_arguments(target, given)
        if any(isinstance(value, Symbol) for value in leaves(chosen)):
            raise self._refusal(f"reads where its input says ({target})", advice_on(A.embedding.default))
        named = {key: value for key, value in named.items() if key not in ("dtype", "device", "layout", "pin_memory")}
        return moved(target, given, named)

    def _padded(self, x: Symbol, pad: Sequence[int], value: float = 0.0) -> Symbol:
        made = moved(A.constant_pad_nd.default, (x, pad), {})
        if value == 0:
            return made  # type: ignore[no-any-return]  # one tensor in, one out
        inside = A.constant_pad_nd.default(torch.zeros(x.shape, dtype=torch.float64), pad, 1.0)
        return self.call(A.add.Tensor, made, inside * value)  # type: ignore[no-any-return]  # likewise

    def _elementwise(self, target: Any, args: Sequence[Any], settings: dict[str, Any]) -> Any:
        condition = args[0]
        if target is A.where.self and isinstance(condition, torch.Tensor):
            return self._chosen(condition, *map(self.lift, args[1:]))
        given = [self.lift(a) if isinstance(a, (torch.Tensor, Derived)) else a for a in args]
        settings = {key: self.lift(a) if isinstance(a, (torch.Tensor, Derived)) else a for key, a in settings.items()}
        tensors = [a for a in (*given, *settings.values()) if isinstance(a, Symbol)]
        shape = np.broadcast_shapes(*(tensor.shape for tensor in tensors))
        size, fixed = math.prod(shape), all(tensor.fixed for tensor in tensors)

        def column(value: Any) -> Any:
            if not isinstance(value, Symbol):
                return value
            return value.column if value.size == 1 < size else value.expanded(shape).column

        made = ELEMENTWISE[target](*map(column, given), **{key: column(a) for key, a in settings.items()})
        if isinstance(made, list):
            return [Symbol(ca.MX(ca.densify(part)), shape, fixed) for part in made]
        return Symbol(ca.MX(ca.densify(made)), shape, fixed)

    def _chosen(self, condition: torch.Tensor, x: Symbol, y: Symbol) -> Symbol:
        """Return numbers of one or the other where it is a constant which: what is not chosen may be infinite."""
        shape = np.broadcast_shapes(tuple(condition.shape), x.shape, y.shape)
        condition = condition.expand(shape)
        places = [np.broadcast_to(np.arange(s.size).reshape(s.shape), shape) for s in (x, y)]
        where = np.where(condition.numpy(), places[0], x.size + places[1])
        return gather([x, y], where)

    def _cast(self, x: Any, dtype: torch.dtype | None) -> Any:
        x = self.lift(x)
        if dtype is None or dtype == torch.bool:
            return x if dtype is None else self.call(A.ne.Scalar, x, 0)
        if not dtype.is_floating_point:
            raise self._refusal(
                f"makes {str(dtype).removeprefix('torch.')} of real numbers (aten._to_copy)",
                "a rounded number has no slope; if it chooses among few things, make it a selection, whose one-hot "
                "column times a matrix is an embedding",
            )
        self._halved |= dtype != torch.float64
        return x

    def _refusal(self, what: str, advice: str) -> InputError:
        return InputError(f"from_torch({self._name}): {place_of(self._node)} {what}: {advice}")


def _draws(target: Any, args: Sequence[Any], kwargs: Mapping[str, Any]) -> bool:
    """Whether an operator draws random numbers."""
    if target is A.scaled_dot_product_attention.default:
        return bool(args[4] if len(args) > 4 else kwargs.get("dropout_p", 0.0))
    if target is A.rrelu_with_noise_functional.default:
        return bool(args[4] if len(args) > 4 else kwargs.get("training", False))
    return torch.Tag.nondeterministic_seeded in getattr(target, "tags", ())


def _plain(given: Sequence[Any]) -> bool:
    return all(isinstance(value, (int, float)) for value in given)


def _steps_in(tree: Any) -> Iterator[int]:
    if isinstance(tree, list):
        for branch in tree:
            yield from _steps_in(branch)
    elif isinstance(tree, dict):
        if "step" in tree:
            yield tree["step"]
        else:
            yield from _steps_in(list(tree.values()))


def _index_arguments(target: Any, args: Any) -> Any:
    """Return the arguments of an operator that say which numbers to take."""
    if target in (A.index.Tensor, A.index_put.default):
        return args[1]
    return args[2] if target in (A.index_select.default, A.gather.default, A.scatter.src) else []


# Operators that check what export has checked already.
CHECKS = {
    A._assert_tensor_metadata.default,
    A._assert_scalar.default,
    A._linalg_check_errors.default,
    A.sym_constrain_range_for_size.default,
    A.sym_constrain_range.default,
}

# Operators that only look at the shape of a symbolic tensor.
FILLED: dict[Any, Callable[..., Any]] = {
    A.full_like.default: lambda x, value: torch.full(x.shape, float(value), dtype=torch.float64),
    A.zeros_like.default: lambda x: torch.zeros(x.shape, dtype=torch.float64),
    A.ones_like.default: lambda x: torch.ones(x.shape, dtype=torch.float64),
    A.new_zeros.default: lambda x, shape: torch.zeros(shape, dtype=torch.float64),
    A.new_ones.default: lambda x, shape: torch.ones(shape, dtype=torch.float64),
    A.new_full.default: lambda x, shape, value: torch.full(shape, float(value), dtype=torch.float64),
    A.new_empty.default: lambda x, shape: torch.zeros(shape, dtype=torch.float64),
    A.sym_size.int: lambda x, dim: x.shape[dim],
    A.empty_like.default: lambda x: torch.zeros(x.shape, dtype=torch.float64),
}
