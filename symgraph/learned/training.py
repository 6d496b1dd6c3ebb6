"""Training: several copies of a network side by side, one on all samples and others that each leave a fold out.

The copies that leave samples out say how well the network predicts what it has not seen: they decide when to stop,
unless weights decay, and their errors are what an error model must learn, since errors on the training samples
themselves are far too small.
"""

from __future__ import annotations

import hashlib
import math
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from symgraph.errors import MissingExtraError
from symgraph.progress import Progress
from symgraph.slots import Array

if TYPE_CHECKING:
    import torch

FOLDS = 5
ENOUGH_HELD_OUT = 1000  # held-out samples beyond which further folds only cost time
COLUMNS = 384  # samples in a step times copies: more of the ones leaves room for fewer of the others
LEARNING_RATE = 6e-3
EVERY = 10  # steps between two looks at the held-out samples
AVERAGING = 0.9  # of the moving average of the weights, which is what is kept
MOST_SCORED = 4000  # held-out samples looked at on the way

Float32 = npt.NDArray[np.float32]
# outputs (M, B, m) and targets (B, m) → losses (M, B)
Loss = Callable[["torch.Tensor", "torch.Tensor"], "torch.Tensor"]


@dataclass
class Copies:
    """The weights of M copies of a network, the one that is used first.

    Attributes:
        weights: for each layer (M, in, out).
        biases: for each layer (M, 1, out).
    """

    weights: list[Float32]
    biases: list[Float32]

    @property
    def count(self) -> int:
        return len(self.weights[0])

    def first(self, count: int) -> Copies:
        """Return the first copies."""
        return Copies([w[:count] for w in self.weights], [b[:count] for b in self.biases])


@dataclass
class Folds:
    """Which fold a sample belongs to, for good: a copy must never have been trained on what it is to be judged by.

    Samples are known by their content, so that the order in which they are given does not matter and equal samples
    share a fold.
    """

    known: dict[bytes, int] = field(default_factory=dict)

    def assign(self, *columns: Array) -> npt.NDArray[np.int64]:
        """Return the fold (N,) of each sample, dealing new ones to the folds with the fewest samples."""
        digests = _digests(columns)
        times = Counter(digests)
        sizes = np.bincount([self.known[d] for d in digests if d in self.known], minlength=FOLDS)
        # In the order of their digests, which is as good as random.
        for digest in sorted(times.keys() - self.known.keys()):
            self.known[digest] = int(sizes.argmin())
            sizes[self.known[digest]] += times[digest]
        return np.array([self.known[d] for d in digests], dtype=np.int64)

    def count_first(self, count: int, *columns: Array) -> int:
        """Return how many of the samples are among the first `count` that got a fold."""
        first = set(islice(self.known, count))
        return sum(digest in first for digest in _digests(columns))


def _digests(columns: Sequence[Array]) -> list[bytes]:
    rows = np.ascontiguousarray(np.hstack(columns)) + 0.0  # -0.0 becomes 0.0, which it equals
    return [hashlib.blake2b(row.tobytes(), digest_size=8).digest() for row in rows]


def active_folds(samples: int) -> int:
    """Return how many folds are left out in turn: fewer where one holds enough samples to judge by."""
    return min(FOLDS, math.ceil(FOLDS * ENOUGH_HELD_OUT / samples))


def default_steps(samples: int, widest: int) -> int:
    """Return the most steps of a fit from scratch: 150 up to 120 samples, 250 for 200, 2,500 for 2,000, at most 6,000.

    Layers of less than 100 units learn more slowly, in steps that cost less: they get up to five times as many.
    Jumps are learned late: with a third of these steps, the error on 2,000 samples of one is half as large again.
    """
    return round(min(6000, max(150, 1.25 * samples)) * min(5.0, max(1.0, 100 / max(1, widest))))


@dataclass(frozen=True)
class Training:
    """What came of a training.

    Attributes:
        copies: the weights where the held-out loss was least, with decay the last.
        outputs: (N, m) of the copies that had not seen the sample, NaN where every copy had.
        loss: the mean held-out loss there.
        steps: how many were made.
    """

    copies: Copies
    outputs: Array
    loss: float
    steps: int


def train(
    copies: Copies,
    x: Array,
    targets: Array,
    folds: npt.NDArray[np.int64],
    loss: Loss,
    steps: int,
    rng: np.random.Generator,
    progress: Progress,
    *,
    decay: float = 0.0,
    linear: bool = False,
) -> Training:
    """Minimise a loss by Adam with a falling rate, all copies in one step.

    Without decay the weights are kept that predict held-out samples best on the way. With a decay λ the loss of a copy
    is mean loss + λ ‖w‖² / (m N), with N samples and m outputs: for squares, the most probable weights under a Gaussian
    prior. The last weights are kept then: λ is what keeps noise out of them.

    Gradients go back through the layers by hand: with few samples an automatic one costs several times the sums.

    Args:
        copies: where to start; copy 1 + k leaves out fold k.
        x: (N, n) whitened inputs.
        targets: (N, m).
        folds: (N,) fold of each sample.
        loss: of each copy and sample.
        steps: at most; without decay fewer when the held-out loss no longer falls.
        rng: draws the samples of each step.
        progress: is told of the steps.
        decay: λ, of all weights but biases.
        linear: whether the copies come from `begin_linear`: what only hands the linear function on stays as it is. If
            it could grow, slopes before it could shrink, and nothing would hold the function back.

    Source: Kingma & Ba, Adam, ICLR 2015.
    """
    torch = import_torch()
    n, held_out_copies = len(x), copies.count - 1
    inputs, wanted = (torch.from_numpy(np.asarray(a, dtype=np.float32)) for a in (x, targets))
    learns = np.ones((copies.count, n), dtype=np.float32)
    for k in range(held_out_copies):
        learns[1 + k, folds == k] = 0.0
    learning = torch.from_numpy(learns)
    judged = np.flatnonzero(folds < held_out_copies)
    if len(judged) > MOST_SCORED:
        judged = np.sort(rng.choice(judged, MOST_SCORED, replace=False))
    scored = _Scored([judged[folds[judged] == k] for k in range(held_out_copies)], inputs, wanted)

    parts = [a for pair in zip(copies.weights, copies.biases, strict=True) for a in pair]
    shapes = [part.shape for part in parts]
    # All weights in one vector: one call of Adam moves them, one average follows.
    flat = torch.cat([torch.from_numpy(part).flatten() for part in parts])
    average, best, slope = flat.clone(), flat.clone(), torch.zeros_like(flat)
    tensors, averages, slopes = (_views(one, shapes) for one in (flat, average, slope))
    m = shapes[-1][-1]
    rates, moves = torch.zeros_like(flat), torch.ones_like(flat)  # of decay; 0 for weights that stay
    rate = 2 * decay / (m * learning.sum(1).clamp(min=1.0))
    for layer, (decays, free) in enumerate(zip(_views(rates, shapes)[::2], _views(moves, shapes)[::2], strict=True)):
        decays += rate[:, None, None]
        if linear and layer:
            free[:, :m, :m] = 0.0
    batch = min(n, max(32, COLUMNS // copies.count))
    order, at = rng.permutation(n), 0
    with _one_thread(), torch.no_grad():
        least, least_step, made = scored.loss(averages, loss), 0, 0
        flat.grad = slope
        optimizer = torch.optim.Adam([flat], lr=LEARNING_RATE, betas=(0.9, 0.99), fused=True)
        for step in range(steps):
            if at + batch > n:
                order, at = rng.permutation(n), 0
            chosen = torch.from_numpy(order[at : at + batch])
            at += batch
            # Up within ten steps, then down along half a cosine.
            share = min(1.0, (step + 1) / 10) * 0.5 * (1 + math.cos(math.pi * step / steps))
            optimizer.param_groups[0]["lr"] = LEARNING_RATE * share
            weight = learning[:, chosen]
            weight /= weight.sum(1, keepdim=True).clamp(min=1.0)
            _gradient(tensors, slopes, inputs[chosen], wanted[chosen], weight, loss)
            if decay:
                slope.addcmul_(rates, flat)
            if linear:
                slope.mul_(moves)
            optimizer.step()
            average.lerp_(flat, 1 - AVERAGING)
            made = step + 1
            if made % EVERY == 0 or made == steps:
                progress.update(made, steps)
                now = scored.loss(averages, loss)
                if decay or now < least:
                    least, least_step = now, made
                    best.copy_(average)
                elif made - least_step > max(60, steps // 3):
                    break
        tensors = _views(best, shapes)
        outputs = np.full((n, shapes[-1][-1]), np.nan)
        for k in range(held_out_copies):
            left_out = np.flatnonzero(folds == k)
            one = [tensor[1 + k : 2 + k] for tensor in tensors]
            outputs[left_out] = _forward(one, inputs[torch.from_numpy(left_out)])[-1][0].numpy()
    arrays = [tensor.numpy() for tensor in tensors]
    return Training(Copies(arrays[0::2], arrays[1::2]), outputs, least, made)


class _Scored:
    """Held-out samples in a row for each copy, so that one pass judges all copies.

    Rows are of equal length: in the shorter ones some samples stand twice, and count once.
    """

    def __init__(self, rows: Sequence[npt.NDArray[np.intp]], inputs: torch.Tensor, wanted: torch.Tensor) -> None:
        torch = import_torch()
        longest = max(map(len, rows), default=0)
        index, share = np.zeros((len(rows), longest), dtype=np.int64), np.zeros((len(rows), longest), dtype=np.float32)
        for k, one in enumerate(rows):
            index[k], share[k, : len(one)] = np.resize(one, longest), 1.0
        at = torch.from_numpy(index)
        self._share = torch.from_numpy(share / max(1.0, share.sum()))
        self._inputs, self._wanted = inputs[at], wanted[at]

    def loss(self, tensors: Sequence[torch.Tensor], loss: Loss) -> float:
        """Return the mean loss of samples under the copies that have not seen them; 0 if there are none."""
        if not self._share.numel():
            return 0.0
        outputs = _forward([tensor[1:] for tensor in tensors], self._inputs)[-1]
        return float((loss(outputs, self._wanted) * self._share).sum())


def _views(flat: torch.Tensor, shapes: Sequence[tuple[int, ...]]) -> list[torch.Tensor]:
    """Return the weights and biases that stand in one vector."""
    ends = np.cumsum([math.prod(shape) for shape in shapes]).tolist()
    return [flat[a:b].view(shape) for a, b, shape in zip([0, *ends], ends, shapes, strict=False)]


def _forward(tensors: Sequence[torch.Tensor], x: torch.Tensor) -> list[torch.Tensor]:
    """Return what enters each layer, and the outputs (M, B, m), for inputs (B, n) or (M, B, n).

    Weights and biases alternate.
    """
    torch = import_torch()
    passed = [x.expand(tensors[0].shape[0], -1, -1)]
    for i in range(0, len(tensors), 2):
        hidden = torch.baddbmm(tensors[i + 1], passed[-1], tensors[i])
        passed.append(hidden.relu_() if i < len(tensors) - 2 else hidden)
    return passed


def _gradient(
    tensors: Sequence[torch.Tensor],
    slopes: Sequence[torch.Tensor],
    x: torch.Tensor,
    targets: torch.Tensor,
    weight: torch.Tensor,
    loss: Loss,
) -> None:
    """Write the gradient of the weighted losses, weight (M, B), into slopes, which alternate as tensors do."""
    torch = import_torch()
    passed = _forward(tensors, x)
    outputs = passed.pop().requires_grad_()
    with torch.enable_grad():
        (back,) = torch.autograd.grad((loss(outputs, targets) * weight).sum(), outputs)
    for i in range(len(tensors) - 2, -1, -2):
        entered = passed.pop()
        torch.bmm(entered.transpose(1, 2), back, out=slopes[i])
        torch.sum(back, 1, keepdim=True, out=slopes[i + 1])
        if i:
            back = torch.bmm(back, tensors[i].transpose(1, 2)).mul_(entered > 0)


def import_torch() -> Any:
    """Return torch, which only fitting needs.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import torch
    except ImportError as error:
        raise MissingExtraError("torch", "learned", "fitting a network") from error
    return torch


_fitting = threading.Lock()


@contextmanager
def _one_thread() -> Iterator[None]:
    """Compute on one core: the matrices are small, and the same sums in the same order give the same weights.

    The number of threads belongs to the process, so fits in several threads take turns.
    """
    torch = import_torch()
    with _fitting:
        before = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            yield
        finally:
            torch.set_num_threads(before)
