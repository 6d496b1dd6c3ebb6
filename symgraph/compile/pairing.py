"""Products with a matrix and with its squares, as means and variances are, together: weights are read once.

That is worth the trouble for points one at a time, which are bound by how fast weights can be read.
"""

from __future__ import annotations

import heapq
from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import casadi as ca

from symgraph.compile.program import Kind, Operation, Value

MANY_WEIGHTS = 4096  # fewer are near at hand


Group = tuple[Operation, ...]


class Weights(NamedTuple):
    """A matrix as it stands in a product: perhaps transposed, perhaps with its numbers squared."""

    matrix: Value
    transposed: bool
    squared: bool


def weights_of(value: Value) -> Weights:
    """Return what a left factor is made of."""
    maker = value.maker
    squared = False
    if maker is not None and maker.code == ca.OP_SQ:
        squared, value = True, maker.args[0]
        maker = value.maker
    if maker is not None and maker.code == "transpose":
        return Weights(maker.args[0], True, squared)
    return Weights(value, False, squared)


def in_pairs(operations: Sequence[Operation]) -> list[Group]:
    """Put a product with a matrix and the next one with its squares together, where neither needs the other.

    Args:
        operations: in order.

    Returns:
        the same operations in an order that is possible, alone or as (product, product with squares).
    """
    group_of: dict[Operation, Group] = {operation: (operation,) for operation in operations}
    for pair in _pairs(operations):
        group_of |= dict.fromkeys(pair, pair)
    place = {operation: i for i, operation in enumerate(operations)}
    makers = {o: {arg.maker for arg in o.args if arg.maker in place} for o in operations}
    readers = defaultdict(list)
    for operation in operations:
        for maker in makers[operation]:
            readers[maker].append(operation)
    waits_for = {group: sum(len(makers[operation]) for operation in group) for group in group_of.values()}
    ready = [(max(place[o] for o in group), group) for group, count in waits_for.items() if count == 0]
    heapq.heapify(ready)
    done: dict[Operation, None] = {}
    groups: list[Group] = []
    while len(done) < len(operations):
        if ready:
            _, group = heapq.heappop(ready)
            groups.append(group)
            done |= dict.fromkeys(group)
            after = [group_of[reader] for operation in group for reader in readers[operation]]
        else:  # one half of some pair needs the other one
            pair = next(group_of[o] for o in operations if o not in done and len(group_of[o]) > 1)
            after = [(operation,) for operation in pair]
            group_of |= {operation: (operation,) for operation in pair}
            waits_for |= {(o,): 1 + sum(maker not in done for maker in makers[o]) for o in pair}
        for group in after:
            waits_for[group] -= 1
            if waits_for[group] == 0:
                heapq.heappush(ready, (max(place[o] for o in group), group))
    return groups


def _pairs(operations: Sequence[Operation]) -> Iterator[Group]:
    waiting: dict[tuple[Value, bool, bool], deque[Operation]] = defaultdict(deque)
    for operation in operations:
        if operation.code != "product" or operation.args[0].kind > Kind.BOUND or operation.outputs[0].kind < Kind.LANE:
            continue
        m, k, n = operation.detail
        if n > 1 or m * k < MANY_WEIGHTS:
            continue
        matrix, transposed, squared = weights_of(operation.args[0])
        others = waiting[matrix, transposed, not squared]
        if others:
            yield (others.popleft(), operation) if squared else (operation, others.popleft())
        else:
            waiting[matrix, transposed, squared].append(operation)
