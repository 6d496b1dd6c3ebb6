"""What torch itself says a module computes, and what symgraph makes of it: values, Jacobians, Hessians."""

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
import torch
from torch.utils import _pytree as pytree
from torch_zoo import inputs, reference

import symgraph as sg
from symgraph.compile.compiled import CompiledKernel
from symgraph.compile.toolchain import find_compiler

WIDE = 100.0  # of actions, so that no point is at a bound


@dataclass(frozen=True)
class Derivatives:
    """value (m,), jacobian (m, n), hessian (m, n, n) of flattened outputs by flattened inputs."""

    value: np.ndarray
    jacobian: np.ndarray
    hessian: np.ndarray

    def errors(self, other):
        """The largest differences of each."""
        return tuple(
            float(np.abs(getattr(self, part) - getattr(other, part)).max(initial=0.0))
            for part in ("value", "jacobian", "hessian")
        )


class Subject:
    """An entry of the zoo as a model, with a task whose value is any output: J = wᵀy(x), w a state."""

    def __init__(self, entry):
        self.entry = entry
        self.module = entry.make()
        with reference(self.module) as twin:
            made = [part for part in pytree.tree_leaves(twin(*inputs(entry, 0))) if isinstance(part, torch.Tensor)]
        self.sizes = [int(np.prod(shape)) for shape in entry.shapes]
        self.outputs = [int(part.numel()) for part in made]
        self.n, self.m = sum(self.sizes), sum(self.outputs)
        reads = [{f"x{i}": shape} for i, shape in enumerate(entry.shapes)]
        writes = [{f"y{i}": size} for i, size in enumerate(self.outputs)]
        self.model = sg.learned.from_torch(self.module, reads, writes, name=entry.name)

    def point(self, seed):
        return np.concatenate([x.flatten().numpy() for x in inputs(self.entry, seed)])

    def by_torch(self, x):
        with reference(self.module) as twin:
            twin.requires_grad_(False)

            def flat(column):
                parts = [p.reshape(s) for p, s in zip(torch.split(column, self.sizes), self.entry.shapes, strict=True)]
                made = pytree.tree_leaves(twin(*parts))
                return torch.cat([part.reshape(-1) for part in made if isinstance(part, torch.Tensor)])

            column = torch.from_numpy(x)
            jacobian = torch.func.jacrev(flat)
            return Derivatives(
                flat(column).numpy(), jacobian(column).numpy(), torch.func.jacrev(jacobian)(column).numpy()
            )

    @cached_property
    def graph(self):
        slots = {f"x{i}": sg.Action(size, low=-WIDE, high=WIDE) for i, size in enumerate(self.sizes)}
        slots |= {f"y{i}": sg.State(size) for i, size in enumerate(self.outputs)} | {"w": sg.State(self.m)}
        graph = sg.Graph(slots, start="before")
        graph.edge("before", "after", self.model)
        body = "lambda w, {0}: ca.dot(w, ca.vertcat({0}))".format(", ".join(f"y{i}" for i in range(len(self.outputs))))
        graph.reward("after", eval(body, {"ca": ca}))
        return graph

    def actions(self, x):
        parts = np.split(x, np.cumsum(self.sizes)[:-1])
        return {f"x{i}": part for i, part in enumerate(parts)}

    def interpreted(self, x):
        """Through `Objective`, in CasADi's interpreter."""
        objective = sg.Objective(sg.unroll(self.graph), compiled=False)
        units = [({"w": unit}, self.actions(x)) for unit in np.eye(self.m)]
        value = np.array([objective.value(*unit) for unit in units])
        slopes = [
            np.concatenate([np.atleast_1d(part) for part in objective.gradient(*unit).values()]) for unit in units
        ]
        return Derivatives(value, np.array(slopes), np.array([objective.hessian(*unit) for unit in units]))

    def compiled(self, x):
        """By kernels in machine code: of wᵀy, and of its slope in a direction, whose gradient is a row of a Hessian."""
        parameters = self.model.parameters
        column, hot = ca.MX.sym("x", self.n), ca.MX.sym("s", 0)
        w, direction = ca.MX.sym("w", self.m), ca.MX.sym("d", self.n)
        weights = [ca.MX.sym(f"p{i}", *p.symbol.shape) for i, p in enumerate(parameters)]
        parts = ca.vertsplit(column, np.cumsum([0, *self.sizes]).tolist())
        function, _ = self.model._members[0]
        value = ca.dot(w, ca.vertcat(*function.call([*parts, *weights], True, False)))
        slope = ca.dot(direction, ca.gradient(value, column))
        numbers = [p.value.ravel(order="F") for p in parameters]

        def rows(expression, bound, given):
            names = [column, hot, *bound, *weights]
            options = {"is_diff_in": [True] + [False] * (len(names) - 1)}
            kernel = CompiledKernel(ca.Function("f", names, [expression], options), find_compiler())
            for vectors in given:
                bounded = kernel.bind([*vectors, *numbers], np.full(self.n, -WIDE), np.full(self.n, WIDE))
                values, gradients = bounded.evaluate(x[None], np.zeros((1, 0)))
                yield values[0], gradients[0]

        outputs = list(rows(value, [w], [[unit] for unit in np.eye(self.m)]))
        pairs = [[unit, along] for unit in np.eye(self.m) for along in np.eye(self.n)]
        hessian = np.array([gradient for _, gradient in rows(slope, [w, direction], pairs)])
        return Derivatives(
            np.array([v for v, _ in outputs]),
            np.array([g for _, g in outputs]),
            hessian.reshape(self.m, self.n, self.n),
        )

    def generated(self, x, folder):
        """Value and Jacobian by the C that `export_c` writes; that has no Hessians."""
        planner = sg.CPlanner(sg.export_c(sg.Objective(sg.unroll(self.graph)), folder, name="exported"))
        units = [({"w": unit}, self.actions(x)) for unit in np.eye(self.m)]
        value = np.array([planner.value(*unit) for unit in units])
        slopes = [np.concatenate([np.atleast_1d(part) for part in planner.gradient(*unit).values()]) for unit in units]
        return value, np.array(slopes)
