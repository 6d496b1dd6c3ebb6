"""Closed forms of derivatives: where the reverse sweep does better than going back step by step."""

from __future__ import annotations

import hashlib

import casadi as ca

# By what the function is, so that one that was sent to another process has its rule there.
_ADJOINTS: dict[str, ca.Function] = {}
_DIGESTS: dict[
    int, tuple[ca.Function, str]
] = {}  # by CasADi's object, which is kept so that no other one takes its place


def set_adjoint(function: ca.Function, adjoint: ca.Function) -> None:
    """Give a function of scalars its own reverse derivative, for kernels' gradients; CasADi's stays what it was.

    Args:
        function: x₁ … → y₁ …
        adjoint: x₁ …, y₁ …, and the adjoints of y₁ … → those of x₁ …
    """
    _ADJOINTS[_digest(function)] = adjoint


def adjoint_of(function: ca.Function) -> ca.Function | None:
    """Return a function's own reverse derivative, if it was given one."""
    return _ADJOINTS.get(_digest(function)) if function.is_a("SXFunction") else None


def rules_in(function: ca.Function) -> list[str]:
    """Return the rules of all that a function calls, in a form that tells them apart."""
    found = {}
    for called in (function, *function.find_functions()):
        inner = called.info()["f"] if called.class_name() == "Map" else called
        rule = adjoint_of(inner)
        if rule is not None:
            found[_digest(inner)] = rule.serialize()
    return [part for pair in sorted(found.items()) for part in pair]


def _digest(function: ca.Function) -> str:
    key = hash(function)
    if key not in _DIGESTS:
        _DIGESTS[key] = function, hashlib.sha256(function.serialize().encode()).hexdigest()
    return _DIGESTS[key][1]
