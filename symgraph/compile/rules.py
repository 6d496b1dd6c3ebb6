"""Closed forms of derivatives: where the reverse sweep does better than going back step by step."""

from __future__ import annotations

import casadi as ca

# By hash, which is that of CasADi's object: wrappers of one object are not equal. The function is kept with it.
_ADJOINTS: dict[int, tuple[ca.Function, ca.Function]] = {}


def set_adjoint(function: ca.Function, adjoint: ca.Function) -> None:
    """Give a function of scalars its own reverse derivative, for kernels' gradients; CasADi's stays what it was.

    Args:
        function: x₁ … → y₁ …
        adjoint: x₁ …, y₁ …, and the adjoints of y₁ … → those of x₁ …
    """
    _ADJOINTS[hash(function)] = function, adjoint


def adjoint_of(function: ca.Function) -> ca.Function | None:
    """Return a function's own reverse derivative, if it was given one."""
    found = _ADJOINTS.get(hash(function))
    return None if found is None else found[1]


def adjoints() -> list[ca.Function]:
    """Return all that were given."""
    return [adjoint for _, adjoint in _ADJOINTS.values()]
