"""Random tasks with numbers to evaluate them at, for the oracle and, in CasADi, for symgraph."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import numpy as np
from hypothesis import strategies as st
from oracle import (
    Branch,
    Chance,
    Choose,
    Edge,
    Function,
    Group,
    Model,
    Reward,
    Slot,
    Task,
    branches_of,
    value,
)
from smooth_models import SHAPES, Broken, Smooth, Softmax

MIN_NODES, MAX_NODES = 5, 150  # of the unrolled tree, all choices counted
MAX_DEPTH = 5  # layers of the graph below the start; loops come on top
MAX_ACTION_NUMBERS = 6  # over all actions: differences are taken along each
MAX_VALUE = 100.0  # larger values would hide errors behind rounding


@dataclass(frozen=True)
class Problem:
    """A task and the numbers to evaluate it at."""

    task: Task
    graph_start: str  # the start that the graph declares; `task.start` is where this evaluation begins
    state: dict[str, Any]  # label -> number, array or (mean, covariance)
    actions: dict[str, Any]
    selections: dict[str, str]

    @property
    def point(self) -> np.ndarray:
        """All actions as one vector, in the order of the slots."""
        return np.concatenate([np.atleast_1d(self.actions[label]) for label in self.action_sizes])

    @property
    def action_sizes(self) -> dict[str, int]:
        return {label: slot.size for label, slot in self.task.slots.items() if slot.kind == "action"}

    def value_at(self, point: np.ndarray) -> float:
        """The oracle's value with the actions taken from one vector."""
        return value(self.task, self.state, self.split(point), self.selections)

    def split(self, point: np.ndarray) -> dict[str, np.ndarray]:
        ends = np.cumsum(list(self.action_sizes.values()))
        return dict(zip(self.action_sizes, np.split(point, ends[:-1]), strict=True))


def random_problem(seed: int, *, choice_matters: bool = False) -> Problem:
    """The problem of this seed: small enough to unroll, with a finite value that the actions change.

    Args:
        seed: any non-negative integer; the same seed gives the same problem.
        choice_matters: also ask that models broken in the unselected branches spoil some other selection.
    """
    for attempt in range(10_000):
        problem = _Maker(np.random.default_rng([seed, attempt])).problem()
        if problem is None:
            continue
        here = problem.value_at(problem.point)
        moved = problem.value_at(problem.point + 0.1)
        if not (np.isfinite([here, moved]).all() and abs(moved - here) > 1e-6 and abs(here) < MAX_VALUE):
            continue
        if choice_matters and not broken_matters(break_unselected(problem)):
            continue
        return problem
    raise RuntimeError(f"no problem found for seed {seed}")


def problems(*, choice_matters: bool = False) -> st.SearchStrategy[Problem]:
    return st.integers(0, 2**32 - 1).map(lambda seed: random_problem(seed, choice_matters=choice_matters))


def break_unselected(problem: Problem) -> Problem:
    """The same problem with a model in every unselected branch that makes every state NaN or infinite."""
    label, size = next(iter(problem.action_sizes.items()))
    states = {name: slot.size for name, slot in problem.task.slots.items() if slot.kind == "state"}
    count = 0

    def broken(branch: Branch) -> Branch:
        nonlocal count
        count += 1
        kind = Broken.KINDS[count % len(Broken.KINDS)]
        return Branch(branch.target, Model(Broken({label: size}, states, kind, problem.point[0])))

    groups = {
        node: tuple(
            replace(
                group,
                branches={
                    choice: branch if choice == problem.selections[group.selection] else broken(branch)
                    for choice, branch in group.branches.items()
                },
            )
            if isinstance(group, Choose)
            else group
            for group in there
        )
        for node, there in problem.task.groups.items()
    }
    return replace(problem, task=replace(problem.task, groups=groups))


def broken_matters(problem: Problem) -> bool:
    """Whether changing one selection makes the value NaN or infinite."""
    with np.errstate(all="ignore"):
        others = [
            problem.selections | {label: choice}
            for label, slot in problem.task.slots.items()
            for choice in slot.choices
        ]
        values = [value(problem.task, problem.state, problem.actions, other) for other in others]
    return not np.isfinite(values).all()


def paths(task: Task) -> Iterator[tuple[str, frozenset[str], bool]]:
    """Every node of the unrolled tree: its graph node, the slots written on the way, whether it is cut."""

    def visit(node: str, written: frozenset[str], visits: Mapping[str, int]) -> Iterator:
        if visits.get(node, 0) >= task.max_visits:
            yield node, written, True
            return
        yield node, written, False
        for group in task.groups.get(node, ()):
            for branch in branches_of(group):
                after = written | (_written(branch.model) if branch.model else set())
                yield from visit(branch.target, after, {**visits, node: visits.get(node, 0) + 1})

    return visit(task.start, frozenset(), {})


def models_of(group: Group) -> list[Model]:
    models = [branch.model for branch in branches_of(group) if branch.model is not None]
    if isinstance(group, Reward):
        models.append(group.model)
    if isinstance(group, Chance) and isinstance(group.probability, Model):
        models.append(group.probability)
    return models


def states_read_first(task: Task) -> set[str]:
    """The states that some path, of any choice, reads before writing them."""
    read = set()
    for node, written, cut in paths(task):
        for model in [] if cut else [m for group in task.groups.get(node, ()) for m in models_of(group)]:
            read |= {model.label(name) for name in model.function.reads} - written
    return {label for label in read if task.slots[label].kind == "state"}


def _written(model: Model) -> set[str]:
    return {model.label(name) for name in model.function.writes}


@dataclass
class _Maker:
    """One attempt at a random problem; `problem` returns None where the attempt is no use."""

    rng: np.random.Generator
    slots: dict[str, Slot] = field(default_factory=dict)
    late: frozenset[str] = frozenset()  # states that no start gives: they first appear on an edge
    idle: frozenset[str] = frozenset()  # labels that no model reads
    functions: list[Function] = field(default_factory=list)  # of edges; used again with other names
    rewards: list[Function] = field(default_factory=list)
    groups: dict[str, tuple[Group, ...]] = field(default_factory=dict)
    # node -> the late slots written on every way to it
    written: dict[str, frozenset[str]] = field(default_factory=dict)

    def problem(self) -> Problem | None:
        self.make_slots()
        start, graph_start = self.make_graph()
        max_visits = int(self.rng.integers(1, 4))
        cut_value = self.pick([0.0, self.rng.normal(), -1.0])
        task = Task(self.slots, self.groups, start, max_visits, cut_value)
        size = sum(not cut for _, _, cut in islice(paths(task), 3 * MAX_NODES))
        if not MIN_NODES <= size <= MAX_NODES:
            return None
        needed = states_read_first(task)
        state = {
            label: self.make_belief(slot.size)
            for label, slot in self.slots.items()
            if slot.kind == "state" and (label in needed or self.chance(0.4))
        }
        actions = {}
        for label, slot in self.slots.items():
            if slot.kind == "action":
                # Now and then outside the bounds, where the value is what it is.
                over = self.pick([0.0, 0.0, 0.0, 0.1])
                reach = self.rng.uniform(-over, 1 + over, slot.size)
                actions[label] = self.as_given(slot.low + reach * (slot.high - slot.low))
        selections = {label: self.pick(slot.choices) for label, slot in self.slots.items() if slot.choices}
        return Problem(task, graph_start, state, actions, selections)

    # Slots and numbers

    def make_slots(self) -> None:
        rng = self.rng
        slots = {f"x{i}": Slot("state", int(rng.integers(1, 4))) for i in range(rng.integers(2, 5))}
        late = [f"late{i}" for i in range(rng.integers(0, 3))]
        slots |= {label: Slot("state", int(rng.integers(1, 4))) for label in late}
        room = MAX_ACTION_NUMBERS
        for i in range(rng.integers(1, 4)):
            size = int(rng.integers(1, min(3, room - 2 + i) + 1))  # leaves one number for each action to come
            room -= size
            low = -rng.uniform(0.5, 1.5, size) if self.chance(0.5) else np.full(size, -1.0)
            slots[f"a{i}"] = Slot("action", size, low, low + rng.uniform(1.0, 2.0))
        for i in range(rng.integers(0, 3)):
            choices = tuple(f"way{j}" for j in range(rng.integers(2, 4)))
            slots[f"pick{i}"] = Slot("selection", len(choices), choices=choices)
        order = rng.permutation(list(slots))
        self.slots = {str(label): slots[label] for label in order}
        self.late = frozenset(late)
        if self.chance(0.3) and "a1" in slots:
            self.idle = frozenset({"a1"})

    def make_belief(self, size: int) -> Any:
        mean = self.rng.normal(size=size) * 0.7
        if self.chance(0.4):
            return self.as_given(mean)
        covariance = self.make_covariance(size)
        return (float(mean[0]), float(covariance[0, 0])) if size == 1 else (mean, covariance)

    def make_covariance(self, size: int) -> np.ndarray:
        """Full, sometimes singular, sometimes zero."""
        rank = self.pick([size, size, size, 1, 0])
        root = 0.4 * self.rng.normal(size=(size, rank))
        return root @ root.T

    def as_given(self, numbers: np.ndarray) -> Any:
        return float(numbers[0]) if len(numbers) == 1 and self.chance(0.8) else numbers

    def chance(self, probability: float) -> bool:
        return bool(self.rng.random() < probability)

    def pick(self, options: Any) -> Any:
        return options[self.rng.integers(len(options))]

    # The graph: layers of nodes with edges downwards and a few back up

    def make_graph(self) -> tuple[str, str]:
        rng = self.rng
        depth = int(rng.integers(1, MAX_DEPTH + 1))
        layers = [["start"]] + [[f"n{i}{c}" for c in "ab"[: rng.integers(1, 3)]] for i in range(1, depth + 1)]
        self.written["start"] = frozenset()
        for i, layer in enumerate(layers):
            for node in layer:
                if node not in self.written:
                    continue  # nothing leads here
                rewards = rng.choice(3, p=[0.35, 0.5, 0.15])
                groups: list[Group] = [self.make_reward(node) for _ in range(rewards)]
                if i < depth:
                    self.groups[node] = ()  # so that an edge may lead back to it
                    below = layers[i + 1] + (layers[i + 2] if i + 2 <= depth and self.chance(0.2) else [])
                    groups += [self.make_step(node, below) for _ in range(rng.choice([1, 2], p=[0.75, 0.25]))]
                rng.shuffle(groups)
                if groups:
                    self.groups[node] = tuple(groups)
        if self.chance(0.2):
            self.groups["before"] = (Edge(Branch("start", self.make_model("start"))),)
            return "start", "before"
        return "start", "start"

    def make_step(self, node: str, below: list[str]) -> Group:
        selections = [label for label, slot in self.slots.items() if slot.choices]
        kind = self.pick(["edge", "choose", "chance"] if selections else ["edge", "chance"])
        if kind == "edge":
            return Edge(self.make_branch(node, below))
        if kind == "choose":
            selection = self.pick(selections)
            return Choose(selection, {way: self.make_branch(node, below) for way in self.slots[selection].choices})
        names = ["hit", "miss", "lost"][: self.rng.integers(2, 4)]
        branches = {name: self.make_branch(node, below) for name in names}
        if self.chance(0.4):
            numbers = self.rng.dirichlet(np.ones(len(names))).tolist()
            return Chance(branches, dict(zip(names, numbers, strict=True)))
        reads, rename = self.make_reads(node)
        shape = (len(names), sum(reads.values()))
        weights, offsets = self.rng.normal(size=shape) / np.sqrt(shape[1]), self.rng.normal(size=shape[0])
        softmax = Softmax(reads, dict.fromkeys(names, 1), weights, offsets)
        return Chance(branches, Model(softmax, rename, self.make_rule()))

    def make_branch(self, node: str, below: list[str]) -> Branch:
        model = None if self.chance(0.2) else self.make_model(node)
        after = self.written[node] | (_written(model) & self.late if model else set())
        fate = self.rng.random()
        if fate < 0.1:
            return Branch("end", model)
        if fate < 0.3:
            # Only where the late slots that the models there rely on are written on this way too.
            back = [earlier for earlier in self.groups if self.written[earlier] <= after]
            if back:
                return Branch(self.pick(back), model)
        target = self.pick(below)
        self.written[target] = self.written.get(target, after) & after
        return Branch(target, model)

    # Models

    def make_model(self, node: str) -> Model:
        adapted = self.adapt(self.functions, node)
        if adapted is not None:
            function, rename = adapted
        else:
            reads, rename = self.make_reads(node)
            states = [label for label, slot in self.slots.items() if slot.kind == "state"]
            missing = sorted(self.late - self.written[node])
            targets = {self.pick(missing) if missing and self.chance(0.5) else self.pick(states)}
            if self.chance(0.4):
                targets.add(self.pick(states))
            own = {label: name for name, label in rename.items()}  # a slot read and written has one name
            writes = {}
            for label in sorted(targets):
                name = own.get(label) or (label if label in reads else self.own_name(label, "out"))
                writes[name] = self.slots[label].size
                if name != label:
                    rename[name] = label
            function = self.make_smooth(reads, writes, bend=0.1)
            self.functions.append(function)
        model = Model(function, rename, self.make_rule())
        if self.chance(0.3):
            label = self.pick(sorted(_written(model)))
            return replace(model, noise={label: self.make_covariance(self.slots[label].size)})
        return model

    def make_reward(self, node: str) -> Reward:
        adapted = self.adapt(self.rewards, node)
        if adapted is not None:
            function, rename = adapted
        else:
            reads, rename = self.make_reads(node)
            function = self.make_smooth(reads, {"reward": 1}, bend=0.5)
            self.rewards.append(function)
        return Reward(Model(function, rename, self.make_rule()))

    def make_reads(self, node: str) -> tuple[dict[str, int], dict[str, str]]:
        readable = self.readable(node)
        count = min(len(readable), self.rng.integers(1, 4))
        labels = [str(label) for label in self.rng.choice(readable, count, replace=False)]
        names = {label: self.own_name(label, "in") for label in labels}
        reads = {name: self.slots[label].size for label, name in names.items()}
        return reads, {name: label for label, name in names.items() if name != label}

    def readable(self, node: str) -> list[str]:
        return [label for label in self.slots if label not in self.idle | (self.late - self.written[node])]

    def own_name(self, label: str, suffix: str) -> str:
        return label if self.chance(0.5) else f"{label}_{suffix}"

    def adapt(self, functions: list[Function], node: str) -> tuple[Function, dict[str, str]] | None:
        """Sometimes one of these functions with other labels of the same sizes behind its names."""
        if not functions or self.chance(0.5):
            return None
        function = self.pick(functions)
        rename: dict[str, str] = {}
        for name, size in {**function.reads, **function.writes}.items():
            if name == "reward":
                continue
            fits = [
                label
                for label, slot in self.slots.items()
                if slot.size == size
                and label not in rename.values()
                and (name not in function.reads or label in self.readable(node))
                and (name not in function.writes or slot.kind == "state")
            ]
            if not fits:
                return None
            rename[name] = self.pick(fits)
        return function, {name: label for name, label in rename.items() if name != label}

    def make_rule(self) -> str | None:
        return self.pick([None, None, "mean", "linear", "second-order", "second-order"])

    def make_smooth(self, reads: dict[str, int], writes: dict[str, int], bend: float) -> Smooth:
        rng, m, n = self.rng, sum(writes.values()), sum(reads.values())
        shapes = tuple(self.pick(list(SHAPES)) for _ in range(m))
        weights = rng.normal(size=(m, n)) / np.sqrt(n)
        weights[[shape == "exp" for shape in shapes]] *= 0.4  # keeps loops from blowing up
        half = rng.normal(size=(m, n, n)) * (rng.random((m, 1, 1)) < 0.6)  # the rest has no quadratic term
        quadratics = bend / n * (half + half.transpose(0, 2, 1)) / 2
        return Smooth(reads, writes, shapes, weights, rng.normal(size=m) * 0.5, quadratics)


def to_symgraph(problem: Problem) -> tuple[Any, dict[str, Any], tuple[dict, dict, dict]]:
    """The graph, the arguments of `unroll` besides it, and the arguments of `Objective.value`."""
    import casadi as ca

    import symgraph as sg

    task = problem.task
    functions: dict[int, Callable] = {}  # one Python function for all the edges that share it
    models: dict[int, Any] = {}

    def python_function(function: Any) -> Callable:
        if id(function) not in functions:

            def body(*columns: Any) -> Any:
                y = function.symbolic(ca, ca.vertcat(*columns))
                if list(function.writes) == ["reward"]:
                    return y
                ends = np.cumsum([0, *function.writes.values()])
                return {name: y[int(ends[i]) : int(ends[i + 1])] for i, name in enumerate(function.writes)}

            # Labels are parameter names, so the function has to be written out with them.
            names = ", ".join(function.reads)
            functions[id(function)] = eval(f"lambda {names}: body({names})", {"body": body})
        return functions[id(function)]

    def model_of(model: Model | None) -> Any:
        if model is None:
            return None
        if id(model) not in models:
            options: dict[str, Any] = {}
            if model.rename:
                options["rename"] = dict(model.rename)
            if model.propagation:
                options["propagation"] = model.propagation
            if model.noise:
                options["noise"] = {label: number_or_array(noise) for label, noise in model.noise.items()}
            function = python_function(model.function)
            models[id(model)] = sg.Model(function, **options) if options else function
        return models[id(model)]

    def number_or_array(covariance: np.ndarray) -> Any:
        return covariance.item() if covariance.size == 1 else covariance

    def slot_of(slot: Slot) -> Any:
        if slot.kind == "state":
            return sg.State(slot.size)
        if slot.kind == "selection":
            return sg.Selection(list(slot.choices))
        low, high = (ends[0] if np.ptp(ends) == 0 else ends for ends in (slot.low, slot.high))
        return sg.Action(slot.size, low=low, high=high)

    def ends_of(branches: Mapping[str, Branch]) -> dict[str, tuple[str, Any]]:
        return {name: (branch.target, model_of(branch.model)) for name, branch in branches.items()}

    graph = sg.Graph({label: slot_of(slot) for label, slot in task.slots.items()}, start=problem.graph_start)
    for node, groups in task.groups.items():
        for group in groups:
            match group:
                case Edge(Branch(target, None)):
                    graph.edge(node, target)
                case Edge(Branch(target, model)):
                    graph.edge(node, target, model_of(model))
                case Choose(selection, branches):
                    graph.choose(node, selection, ends_of(branches))
                case Chance(branches, Model() as probability):
                    graph.chance(node, ends_of(branches), model_of(probability))
                case Chance(branches, probability):
                    graph.chance(node, ends_of(branches), dict(probability))
                case Reward(model):
                    graph.reward(node, model_of(model))

    options = {"max_visits": task.max_visits, "cut_value": task.cut_value}
    if task.start != problem.graph_start:
        options["start"] = task.start
    state = {
        label: sg.Gaussian(*given) if isinstance(given, tuple) else given for label, given in problem.state.items()
    }
    return graph, options, (state, problem.actions, problem.selections)
