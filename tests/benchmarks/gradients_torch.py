"""Value and gradient of pouring_like.py in PyTorch, in three ways that share one objective written for rows of points.

`batched` takes the gradient of the sum over all points, with the slopes of `rectify` by hand. `functional` is what
torch.func offers for gradients point by point, vmap(grad_and_value(J)); each operation passes two more layers of
dispatch. `compiled` is that after torch.compile, which takes up to a minute for each number of points.
"""

import math
from functools import partial

import numpy as np
import torch
from benchmarks.pouring_like import SKILLS, prepared
from torch.func import grad_and_value, vmap
from torch.utils._pytree import tree_map

NODES, NODE_WEIGHTS = np.polynomial.hermite_e.hermegauss(5)
NODE_WEIGHTS = NODE_WEIGHTS / NODE_WEIGHTS.sum()


def gain_and_density(alpha):
    return 0.5 + 0.5 * torch.erf(math.sqrt(0.5) * alpha), torch.exp(-0.5 * alpha * alpha) * (1 / math.sqrt(2 * math.pi))


def rectify(mean, variance):
    """Mean and variance of max(0, x) for x ~ N(mean, variance), and what the slopes are made of."""
    sd = torch.sqrt(variance + 1e-16)
    gain, density = gain_and_density(mean / sd)
    rectified = mean * gain + sd * density
    spread = variance * gain + (mean - rectified) * rectified
    return rectified, spread.clamp(min=0.0), gain, density / sd


class Rectify(torch.autograd.Function):
    """`rectify` with its slopes by hand."""

    @staticmethod
    def forward(ctx, mean, variance):
        rectified, spread, gain, density = rectify(mean, variance)
        ctx.save_for_backward(rectified, gain, density)
        return rectified, spread

    @staticmethod
    def backward(ctx, by_mean, by_variance):
        rectified, gain, density = ctx.saved_tensors
        return (
            by_mean * gain + by_variance * (2 * rectified * (1 - gain)),
            by_mean * (0.5 * density) + by_variance * (gain - rectified * density),
        )


def network(layers, mean, variance, rectify):
    for w, v, b in layers[:-1]:
        mean, variance, *_ = rectify(mean @ w.T + b, variance @ v.T)
    w, v, b = layers[-1]
    return mean @ w.T + b, variance @ v.T


def expected_square(mean, variance, constants):
    """E[(softplus(h) + 1e-4)²] for h ~ N(mean, variance)."""
    h = mean[..., None] + torch.sqrt(variance + 1e-16)[..., None] * constants["nodes"]
    return (torch.nn.functional.softplus(h, threshold=40.0) + 1e-4) ** 2 @ constants["node_weights"]


def stochastic(weights, mean, variance, constants, rectify):
    error = expected_square(*network(weights["error"], mean, variance, rectify), constants) * weights["square_scale"]
    mean, variance = network(weights["mean"], mean, variance, rectify)
    return mean, variance + error


def square_above_zero(mean, variance):
    sd = torch.sqrt(variance + 1e-16)
    gain, density = gain_and_density(mean / sd)
    return (mean * mean + variance) * gain + mean * sd * density


def approach(actions, x):
    """From actions (P, 8) to rewards on the way (P,), features (P, 18) and context (P, 2)."""
    a = actions.unbind(-1)
    g1, g2 = torch.tanh(a[0]) * x[0] + x[1], a[1] * x[2] - 0.1 * a[0] ** 2
    p1, p2, p3 = x[3] + torch.sin(a[2]) * g1, x[4] + torch.cos(a[2]) * g2, x[5] + a[3] * x[6]
    d = torch.sqrt((p1 - x[7]) ** 2 + (p2 - x[8]) ** 2 + 1e-4)
    l1, l2 = p1 + 0.3 * a[4] * d, p3 - 0.2 * a[5] * d
    q, th = torch.exp(-0.5 * (l1**2 + l2**2)), torch.atan2(p2, 1 + p1**2)
    u1, u2 = a[6] * q + th, a[7] * (1 - q)
    f1, f2 = torch.tanh(u1 + l1), torch.tanh(u2 - l2)
    rewards = -0.05 * (actions[:, :4] ** 2).sum(-1) - 0.02 * (actions[:, 4:6] ** 2).sum(-1) - 0.05 * d**2
    computed = torch.stack([g1, g2, p1, p2, p3, d, l1, l2, q, th, u1, u2, f1, f2], -1)
    features = torch.cat([computed, x[9:13].expand(len(actions), 4)], -1)
    return rewards, features, torch.stack([f1, x[13].expand(len(actions))], -1)


def objective(actions, x, weights, constants, rectify):
    """Return J (P,) of actions (P, 8)."""
    rewards, features, context = approach(actions, x)
    given, flows, variances = (features, 0.01 + 0.02 * features**2), [], []
    for skill in SKILLS:
        flow, variance = stochastic(weights[f"flow_{skill}"], *given, constants, rectify)
        flows.append(torch.cat([flow, context], -1))
        variances.append(variance)
    y, v = stochastic(weights["amount"], torch.cat(flows), torch.cat(variances), constants, rectify)
    loss = 10 * square_above_zero(x[14] - y[:, 0], v[:, 0]) + square_above_zero(y[:, 0] - x[14], v[:, 0])
    loss = loss + 3 * square_above_zero(y[:, 1], v[:, 1]) + 0.01 * (y[:, 2] ** 2 + v[:, 2])
    return rewards - loss.reshape(len(SKILLS), -1).mean(0)


by_hand = partial(objective, rectify=Rectify.apply)


def batched(actions, value=by_hand, **given):
    values = value(actions.requires_grad_(), **given)
    return values.detach(), torch.autograd.grad(values.sum(), actions)[0]


def functional(actions, **given):
    def value(action):
        return objective(action[None], rectify=rectify, **given)[0]

    gradients, values = vmap(grad_and_value(value))(actions)
    return values, gradients


def compiled():
    return torch.compile(functional, dynamic=False)


def evaluator(weights, state, dtype=np.float64, way=batched):
    """Return the function from actions (P, 8) to J (P,) and its gradients (P, 8), all as numpy arrays of the dtype."""
    torch.set_num_threads(1)

    def tensor(array):
        return torch.from_numpy(np.array(array, dtype))

    constants = {"nodes": tensor(NODES), "node_weights": tensor(NODE_WEIGHTS)}
    given = {"x": tensor(state["x"]), "weights": tree_map(tensor, prepared(weights)), "constants": constants}

    def evaluate(actions):
        values, gradients = way(tensor(actions), **given)
        return values.numpy(), gradients.numpy()

    return evaluate
