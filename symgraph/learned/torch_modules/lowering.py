"""Lowering: an exported graph of torch's core operators to a CasADi function of inputs and weights."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch.export.graph_signature import InputKind, OutputKind

from symgraph.errors import InputError, SymgraphError
from symgraph.learned.torch_modules.layers import COMPOSED, PLAIN
from symgraph.learned.torch_modules.lowered import Lowered, Weight
from symgraph.learned.torch_modules.reductions import REDUCTIONS
from symgraph.learned.torch_modules.refusals import (
    COMPLEX,
    EMBEDDING,
    NOISE,
    OTHERWISE,
    SIZES,
    advice_on,
    place_of,
)
from symgraph.learned.torch_modules.scalars import ELEMENTWISE
from symgraph.learned.torch_modules.symbols import (
    LINEAR,
    MOVES,
    Symbol,
    Unavailable,
    constant,
    gather,
    is_boolean,
    leaves,
    linear,
    mapped,
    moved,
)
from symgraph.learned.torch_modules.tape import Derived, Tape, is_operator

A = torch.ops.aten

# Named arguments that say how torch keeps numbers, not what they are.
STORAGE = {"dtype", "layout", "device", "pin_memory", "memory_format", "requires_grad"}


class Lowering:
    """Walks through a graph, one value for each node."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._tape = Tape()
        self._symbols: dict[int, tuple[Weight, Symbol]] = {}
        self._kept: list[str] = []
        self._coarsest = 0.0
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
                    known[node] = self._state(name, state[name], name in program.state_dict)
            elif node.op == "call_function":
                args, kwargs = (torch.fx.node.map_arg(part, known.__getitem__) for part in (node.args, node.kwargs))
                known[node] = _typed(self._tried(node.target, args, kwargs), node.meta.get("val"))
            elif node.op == "output":
                made = torch.fx.node.map_arg(node.args[0], known.__getitem__)
                results = [result for result, is_wanted in zip(made, wanted, strict=True) if is_wanted]
            else:  # "get_attr": what operators of higher order call
                known[node] = node.target
        outputs = [self.lift(result) for result in leaves(results) if not isinstance(result, (str, type(None)))]
        if not outputs:
            raise InputError(f"from_torch({self._name}): the module returns no tensor")
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
            _names(program.call_spec.out_spec),
            self._coarsest,
        )

    def _state(self, name: str, value: torch.Tensor, belongs: bool) -> Any:
        """Return a parameter or buffer: numbers that may change, or a constant."""
        if not belongs:  # a tensor that is no parameter and no buffer
            return value.detach()
        if value.is_floating_point() and (value.requires_grad or value.isfinite().all()):
            return self._tape.state(name, value.detach())
        if self._node.users:
            self._kept.append(name)
        return value.detach()

    def _tried(self, target: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
        try:
            return self.call(target, *args, **kwargs)
        except SymgraphError:
            raise
        except Exception as error:
            said = str(error).strip().splitlines()[-1:]
            raise self._refusal(
                f"calls {target} in a way that has no expression ({type(error).__name__}: {' '.join(said)})", OTHERWISE
            ) from error

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
        return _in_numbers(target, args, kwargs)

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
            if not numbers.isfinite().all():
                names = " + ".join(value.sources)
                raise self._refusal(f"makes numbers of {names!r} that are not finite", "weights must be finite")
            rows = numbers.shape[-1] if numbers.ndim else 1
            shape = rows, numbers.numel() // rows if rows else 0
            weight = Weight(value.sources, value.step, shape)
            column = ca.MX.sym("w", numbers.numel())
            self._symbols[value.step] = (
                weight,
                Symbol(column, tuple(numbers.shape), fixed=True, boolean=numbers.dtype == torch.bool),
            )
        return self._symbols[value.step][1]

    def _symbolic(self, target: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
        if target is A._to_copy.default:
            return self._cast(args[0], kwargs.get("dtype"))
        self._take_note_of(kwargs.get("dtype"))
        settings = {key: value for key, value in kwargs.items() if key not in STORAGE}
        if all(value.size == 0 for value in leaves((args, kwargs)) if isinstance(value, Symbol)):
            return _in_numbers(target, args, kwargs)  # of no number at all
        if target is A.add.Tensor and all(map(is_boolean, args)):
            target = A.logical_or.default
        if target in BITWISE and not all(map(is_boolean, args)):
            raise self._refusal(f"calls {target} on whole numbers", OTHERWISE)
        if target is A.scatter.value:
            x, dim, index, value = args
            return self.call(A.scatter.src, x, dim, index, torch.full(index.shape, float(value), dtype=torch.float64))
        if target in ELEMENTWISE:
            return self._elementwise(target, args, settings)
        if target is A.index_put.default and len(args) > 3 and args[3]:  # it adds
            return linear(target, self._placed(target, args), {})
        if target in MOVES:
            return moved(target, self._placed(target, args), {k: v for k, v in kwargs.items() if k not in STORAGE})
        if target is A.constant_pad_nd.default:
            return self._padded(*args)
        if target in LINEAR:
            return linear(target, self._placed(target, args), settings)
        if target in REDUCTIONS:
            return REDUCTIONS[target](*self._lifted(args), **settings)
        if target in PLAIN:
            return PLAIN[target](*self._lifted(args), **settings)
        if target in COMPOSED:
            first, *others = args
            first = first if first is None else self.lift(first)
            # Weights go on as they are, so that the tape takes what it can; but for masks, which layers look at.
            others, settings = (
                mapped(lambda a: self.lift(a) if isinstance(a, Derived) and is_boolean(a) else a, part)
                for part in (others, settings)
            )
            return COMPOSED[target](self.call, first, *others, **settings)
        if target in FILLED:
            return FILLED[target](*args, **settings)
        raise self._refusal(f"calls {target}", advice_on(target))

    def _lifted(self, args: Any) -> Any:
        """Return arguments, or named ones, with all tensors as expressions."""
        return mapped(lambda a: self.lift(a) if isinstance(a, (torch.Tensor, Derived)) else a, args)

    def _placed(self, target: Any, args: Sequence[Any]) -> list[Any]:
        """Return arguments with all tensors as expressions, but for those that say which numbers to take."""
        position = INDEXED.get(target)
        if position is not None and any(isinstance(a, (Symbol, Derived)) for a in leaves(args[position])):
            boolean = any(is_boolean(a) for a in leaves(args[position]))
            raise self._refusal(f"chooses by values ({target})", SIZES if boolean else EMBEDDING)
        return [a if i == position else self._lifted(a) for i, a in enumerate(args)]

    def _padded(self, x: Symbol, pad: Sequence[int], value: float = 0.0) -> Symbol:
        made = moved(A.constant_pad_nd.default, (x, pad), {})
        if value == 0:
            return made  # type: ignore[no-any-return]  # one tensor in, one out
        outside = A.constant_pad_nd.default(torch.zeros(x.shape), pad, 1.0) > 0
        return self._chosen(outside, constant(value), made)

    def _elementwise(self, target: Any, args: Sequence[Any], settings: dict[str, Any]) -> Any:
        condition = args[0]
        if target is A.where.self and isinstance(condition, torch.Tensor):
            return self._chosen(condition, *map(self.lift, args[1:]))
        given, settings = self._lifted(args), self._lifted(settings)
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
        if dtype == torch.bool:
            return self.call(A.ne.Scalar, x, 0)
        if dtype is not None and dtype.is_complex:
            raise self._refusal("makes complex numbers (aten._to_copy)", COMPLEX)
        if dtype is not None and not dtype.is_floating_point and not x.boolean:
            raise self._refusal(
                f"makes {str(dtype).removeprefix('torch.')} of real numbers (aten._to_copy)",
                "a rounded number has no slope; if it chooses among few things, make it a selection, whose one-hot "
                "column times a matrix is an embedding",
            )
        self._take_note_of(dtype)
        return x

    def _take_note_of(self, dtype: torch.dtype | None) -> None:
        if dtype is not None and dtype.is_floating_point and dtype != torch.float64:
            self._coarsest = max(self._coarsest, torch.finfo(dtype).eps)

    def _refusal(self, what: str, advice: str) -> InputError:
        return InputError(f"from_torch({self._name}): {place_of(self._node)} {what}: {advice}")


def _draws(target: Any, args: Sequence[Any], kwargs: Mapping[str, Any]) -> bool:
    """Whether an operator draws random numbers."""
    if target is A.scaled_dot_product_attention.default:
        return bool(args[4] if len(args) > 4 else kwargs.get("dropout_p", 0.0))
    if target is A.rrelu_with_noise_functional.default:
        return bool(args[4] if len(args) > 4 else kwargs.get("training", False))
    return torch.Tag.nondeterministic_seeded in getattr(target, "tags", ())


def _names(specification: Any) -> tuple[str, ...]:
    """Return the keys of a dict of tensors."""
    flat = specification.type is dict and specification.num_leaves == specification.num_children
    return tuple(map(str, specification.context)) if flat else ()


def _plain(given: Sequence[Any]) -> bool:
    return all(isinstance(value, (int, float)) for value in given)


def _in_numbers(target: Any, args: Any, kwargs: Any) -> Any:
    """Carry out an operator on constants, and on tensors without numbers."""

    def numbers(value: Any) -> Any:
        if isinstance(value, Symbol):
            return torch.zeros(value.shape, dtype=torch.float64)
        return value.value if isinstance(value, Derived) else value

    with torch.no_grad():
        return target(*mapped(numbers, args), **mapped(numbers, kwargs))


def _typed(made: Any, said: Any) -> Any:
    """Note of symbolic tensors whether torch holds them for booleans."""
    if isinstance(made, list):
        return [_typed(part, one) for part, one in zip(made, said, strict=False)] if said is not None else made
    if isinstance(made, Symbol) and isinstance(said, torch.Tensor):
        return replace(made, boolean=said.dtype == torch.bool)
    return made


# Which argument of an operator says what numbers to take.
INDEXED = {
    A.index.Tensor: 1,
    A.index_put.default: 1,
    A.take_along_dim.default: 1,
    A.index_select.default: 2,
    A.gather.default: 2,
    A.scatter.src: 2,
    A.scatter_add.default: 2,
    A.index_add.default: 2,
}

# Operators that mean something else for whole numbers.
BITWISE = {A.bitwise_not.default, A.bitwise_and.Tensor, A.bitwise_or.Tensor, A.bitwise_xor.Tensor}

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

# What is lowered as it is, and not taken apart by torch before.
KNOWN = {
    *ELEMENTWISE,
    *MOVES,
    *LINEAR,
    *REDUCTIONS,
    *PLAIN,
    *COMPOSED,
    *FILLED,
    A.constant_pad_nd.default,
    A.scatter.value,
}
