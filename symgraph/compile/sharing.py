"""How the threads of a team share a program: what does not depend on each other is done at the same time.

A network's mean and its error, and the networks of several branches, go through their layers side by side. Operations
are put in levels, each behind as many costly ones as depend on each other; those of a level that meet in the next one
belong together. Each such group is done by one thread, by that which made what it needs where loads allow it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

from symgraph.compile.differentiate import called
from symgraph.compile.program import CALLS, Kind, Operation, Program
from symgraph.compile.schedule import is_view

PARTS = 4  # into which a program is divided; each thread of a team does some of them
COSTLY = 400  # numbers that an operation multiplies or moves, from which on it may stand for itself
ENOUGH = 300_000  # that products cost, from which on threads that wait for each other still gain
ALONE = 0.7  # of a level's cost, from which on a call is shared instead of made beside others
UNEVEN = 1.05  # times the mean: so much may one thread have to do, where it made what is needed
GAIN = 1.5  # of two threads, from which on they share evaluations rather than points

_WITH_WEIGHTS = ("product", "packed product", "packed pair", "pack")
_COSTLY = (*CALLS, *_WITH_WEIGHTS, "transpose", "external")


Share = tuple[float, list[Operation], int]  # what a group of operations costs, the group, the part it is of


class Shares:
    """A program in parts.

    Attributes:
        operations: in an order that is possible, level by level.
        part: of each operation, in that order; None for a call that all threads make, and share what is called.
    """

    def __init__(self, program: Program, costs: Costs) -> None:
        self._costs = costs
        levels: dict[Operation, int] = {}
        for operation in program.operations:
            makers = [arg.maker for arg in operation.args if arg.maker is not None]
            levels[operation] = max((levels[maker] + costs.is_costly(maker) for maker in makers), default=0)
        place = {operation: i for i, operation in enumerate(program.operations)}
        # What costs little comes first, or it would wait for costly operations of its level that it does not need.
        self.operations = sorted(
            program.operations, key=lambda operation: (levels[operation], costs.is_costly(operation), place[operation])
        )
        self.part: dict[Operation, int | None] = {}
        self._time = 0.0
        for groups in self._by_level(levels):
            self._divide(groups)
        self.part = {operation: self.part[operation] for operation in self.operations}

    @property
    def gain(self) -> float:
        """How much less time two threads take, were it not for meetings."""
        return sum(self._costs.of(operation) for operation in self.operations) / max(self._time, 1.0)

    def _by_level(self, levels: dict[Operation, int]) -> Iterator[list[list[Operation]]]:
        """Yield costly operations of a level, and all up to the next ones, in groups of those that meet."""
        root: dict[Operation, Operation] = {}

        def find(operation: Operation) -> Operation:
            while root[operation] is not operation:
                root[operation] = root[root[operation]]
                operation = root[operation]
            return operation

        stage = {o: levels[o] + self._costs.is_costly(o) for o in self.operations}
        for operation in self.operations:
            root[operation] = operation
            if self._costs.is_costly(operation) or operation.code == "gather":  # which only moves what is made
                continue
            for maker in (arg.maker for arg in operation.args):
                if maker is not None and stage[maker] == stage[operation] and maker.code not in CALLS:
                    root[find(maker)] = find(operation)
        stages: dict[int, dict[Operation, list[Operation]]] = defaultdict(lambda: defaultdict(list))
        for operation in self.operations:
            stages[stage[operation]][find(operation)].append(operation)
        for _, groups in sorted(stages.items()):
            yield list(groups.values())

    def _divide(self, groups: list[list[Operation]]) -> None:
        """Give each group of a level to the part that made what it needs, or where loads differ to another one."""
        together = 0.0
        chosen: list[Share] = []
        costs = [sum(map(self._costs.of, group)) for group in groups]
        callees = [called(group[0]) if self._costs.is_shared(group[0]) else () for group in groups]
        alike: dict[tuple[Program, ...], float] = defaultdict(float)
        for cost, programs in zip(costs, callees, strict=True):
            alike[programs] += cost
        for cost, group, programs in zip(costs, groups, callees, strict=True):
            # Calls of one function, one after the other, find its weights near at hand.
            if programs and alike[programs] > ALONE * sum(costs):
                self.part |= dict.fromkeys(group)
                together += cost / self._costs.shares(max(programs, key=self._costs.of_program)).gain
            else:
                chosen.append((cost, group, self._nearest(group)))
        chosen = _balanced(chosen)
        for _, group, part in chosen:
            self.part |= dict.fromkeys(group, part)
        self._time += together + max(_loads(chosen, 2))

    def _nearest(self, group: list[Operation]) -> int:
        """Return the part that made most of what a group needs."""
        made = [0] * PARTS
        for operation in group:
            for arg in operation.args:
                part = self.part.get(arg.maker) if arg.maker is not None else None
                if part is not None and arg.kind > Kind.BOUND:
                    made[part] += arg.size
        return max(range(PARTS), key=lambda part: (made[part], -part))


def _balanced(chosen: list[Share]) -> list[Share]:
    """Move groups to other parts where loads are not even, for two threads and for one for each part."""
    total = sum(cost for cost, _, _ in chosen)
    loads = [0.0] * PARTS
    balanced = []
    for cost, group, nearest in sorted(chosen, key=lambda share: -share[0]):
        part = nearest
        if cost >= COSTLY:
            halves = sum(loads[::2]), sum(loads[1::2])
            half = nearest % 2
            if halves[half] + cost > UNEVEN * total / 2 and halves[1 - half] < halves[half]:
                half = 1 - half
            near = nearest % 2 == half and loads[nearest] + cost <= UNEVEN * total / PARTS
            part = nearest if near else min(range(half, PARTS, 2), key=loads.__getitem__)
        loads[part] += cost
        balanced.append((cost, group, part))
    return balanced


def _loads(chosen: list[Share], threads: int) -> list[float]:
    """Return what each thread does of a level, where thread i does part i and each `threads`-th after it."""
    loads = [0.0] * threads
    for cost, _, part in chosen:
        loads[part % threads] += cost
    return loads


class Costs:
    """What operations and programs cost, in numbers that are multiplied or moved for each point."""

    def __init__(self) -> None:
        self._programs: dict[Program, float] = {}
        self._weights: dict[Program, float] = {}
        self._shares: dict[Program, Shares] = {}

    def of(self, operation: Operation) -> float:
        if operation.code in ("product", "weighted product", "packed product", "packed pair"):
            m, k = operation.detail[:2]
            return float(m * k * (2 if operation.code == "packed pair" else operation.detail[2]))
        if operation.code in CALLS:
            return self._times(operation) * max(map(self.of_program, called(operation)))
        return 0.0 if is_view(operation) else 4.0 * sum(output.size for output in operation.outputs)

    def of_program(self, program: Program) -> float:
        if program not in self._programs:
            self._programs[program] = sum(map(self.of, program.operations))
        return self._programs[program]

    def is_costly(self, operation: Operation) -> bool:
        return operation.code in _COSTLY and self.of(operation) >= COSTLY

    def shares(self, program: Program) -> Shares:
        """Return a program in parts."""
        if program not in self._shares:
            self._shares[program] = Shares(program, self)
        return self._shares[program]

    def of_weights(self, program: Program) -> float:
        """Return what products cost in a program and all that it calls."""
        if program not in self._weights:
            self._weights[program] = sum(
                self._times(operation) * max(map(self.of_weights, called(operation)))
                if operation.code in CALLS
                else self.of(operation) * (operation.code in _WITH_WEIGHTS)
                for operation in program.operations
            )
        return self._weights[program]

    def is_worth_sharing(self, program: Program) -> bool:
        """Whether threads gain by sharing a program: most of it are products, many of which do not need each other."""
        weights = self.of_weights(program)
        return weights >= max(ENOUGH, self.of_program(program) / 2) and self.shares(program).gain >= GAIN

    @staticmethod
    def _times(operation: Operation) -> int:
        return int(operation.detail[1]) if operation.code == "repeat" else 1

    def is_shared(self, operation: Operation) -> bool:
        """Whether threads gain by sharing what is called."""
        return operation.code in CALLS and self.is_worth_sharing(max(called(operation), key=self.of_program))
