"""Families of smooth functions that know their own derivatives, as numpy code and as CasADi expressions."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

# name -> (s, s', s'')
SHAPES: dict[str, tuple[Callable, Callable, Callable]] = {
    "affine": (lambda z: z, lambda z: 1.0, lambda z: 0.0),
    "sin": (np.sin, np.cos, lambda z: -np.sin(z)),
    "cos": (np.cos, lambda z: -np.sin(z), lambda z: -np.cos(z)),
    "tanh": (np.tanh, lambda z: 1 - np.tanh(z) ** 2, lambda z: -2 * np.tanh(z) * (1 - np.tanh(z) ** 2)),
    "exp": (np.exp, np.exp, np.exp),
}


@dataclass(frozen=True)
class Smooth:
    """y_i = s_i(w_i.x + b_i) + x' Q_i x: affine, bilinear, quadratic and curved functions in one family."""

    reads: Mapping[str, int]
    writes: Mapping[str, int]
    shapes: tuple[str, ...]  # s: one per output
    weights: np.ndarray  # w: (m, n)
    offsets: np.ndarray  # b: (m,)
    quadratics: np.ndarray  # Q: (m, n, n), symmetric

    def derivatives(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        w, q = self.weights, self.quadratics
        z = w @ x + self.offsets
        curves = [[f(z_i) for f in SHAPES[shape]] for shape, z_i in zip(self.shapes, z, strict=True)]
        s, slope, curvature = np.array(curves).T
        qx = q @ x
        hessians = curvature[:, None, None] * w[:, :, None] * w[:, None, :] + 2 * q
        return s + qx @ x, slope[:, None] * w + 2 * qx, hessians

    def symbolic(self, ca: Any, x: Any) -> Any:
        curve = {"affine": lambda z: z, "sin": ca.sin, "cos": ca.cos, "tanh": ca.tanh, "exp": ca.exp}
        rows = []
        for shape, w, b, q in zip(self.shapes, self.weights, self.offsets, self.quadratics, strict=True):
            row = curve[shape](ca.dot(ca.DM(w), x) + b)
            rows.append(row + ca.dot(x, ca.mtimes(ca.DM(q), x)) if q.any() else row)
        return ca.vertcat(*rows)


@dataclass(frozen=True)
class Softmax:
    """p = exp(Wx + b) / sum exp(Wx + b): branch probabilities that sum to one."""

    reads: Mapping[str, int]
    writes: Mapping[str, int]  # branch -> 1
    weights: np.ndarray  # W: (m, n)
    offsets: np.ndarray  # b: (m,)

    def derivatives(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        e = np.exp(self.weights @ x + self.offsets)
        p = e / e.sum()
        # v_k = w_k - sum_j p_j w_j: grad p_k = p_k v_k, hess p_k = p_k (v_k v_k' - sum_j p_j v_j v_j')
        v = self.weights - p @ self.weights
        spread = np.einsum("j,ja,jb->ab", p, v, v)
        return p, p[:, None] * v, p[:, None, None] * (np.einsum("ka,kb->kab", v, v) - spread)

    def symbolic(self, ca: Any, x: Any) -> Any:
        e = ca.exp(ca.mtimes(ca.DM(self.weights), x) + ca.DM(self.offsets))
        return e / ca.sum1(e)


@dataclass(frozen=True)
class Broken:
    """A model without a finite value where it is evaluated, as a model of an unselected branch may be."""

    reads: Mapping[str, int]
    writes: Mapping[str, int]
    kind: str
    pole: float  # first element of what it reads

    KINDS = ("root", "overflow", "pole")

    def derivatives(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        m, n = sum(self.writes.values()), len(x)
        y = np.nan if self.kind == "root" else np.inf
        return np.full(m, y), np.full((m, n), np.nan), np.full((m, n, n), np.nan)

    def symbolic(self, ca: Any, x: Any) -> Any:
        y = {
            "root": lambda: ca.sqrt(-1 - x[0] ** 2),
            "overflow": lambda: ca.exp(1e3 + x[0] ** 2),
            "pole": lambda: 1 / (x[0] - self.pole),
        }[self.kind]()
        return ca.vertcat(*[y] * sum(self.writes.values()))
