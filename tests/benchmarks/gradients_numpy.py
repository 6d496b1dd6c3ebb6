"""Value and gradient of pouring_like.py in numpy, the reverse sweep by hand.

Points are rows. A name with a `d` in front is the slope of J by what follows. Forward functions return beside their
results what their reverse needs.
"""

import math
from functools import partial

import numpy as np
from benchmarks.pouring_like import SKILLS, prepared
from scipy.special import ndtr

NODES, NODE_WEIGHTS = np.polynomial.hermite_e.hermegauss(5)
NODE_WEIGHTS = NODE_WEIGHTS / NODE_WEIGHTS.sum()


def standardised(mean, variance):
    """Return s, Φ(m/s) and φ(m/s)."""
    sd = np.sqrt(variance + 1e-16)
    alpha = mean / sd
    gain = ndtr(alpha)
    alpha *= alpha
    alpha *= -0.5
    density = np.exp(alpha, out=alpha)
    density *= 1 / math.sqrt(2 * math.pi)
    return sd, gain, density


def rectify(mean, variance):
    """E = mΦ + sφ and V = vΦ + (m - E)E of max(0, x); dE/dm = Φ, dE/dv = φ/2s, dV/dm = 2E(1 - Φ), dV/dv = Φ - Eφ/s."""
    sd, gain, density = standardised(mean, variance)
    rectified = mean * gain
    rectified += sd * density
    spread = variance * gain
    mean -= rectified
    mean *= rectified
    spread += mean
    np.maximum(spread, 0.0, out=spread)
    density /= sd
    return rectified, spread, (rectified, gain, density)


def rectify_reverse(kept, d_rectified, d_spread):
    rectified, gain, density = kept
    d_mean = d_rectified * gain
    by_spread = 1 - gain
    by_spread *= rectified
    by_spread *= d_spread
    by_spread *= 2
    d_mean += by_spread
    d_variance = rectified * density
    np.subtract(gain, d_variance, out=d_variance)
    d_variance *= d_spread
    density *= d_rectified
    density *= 0.5
    d_variance += density
    return d_mean, d_variance


def network(layers, mean, variance):
    kept = []
    for w, v, b in layers[:-1]:
        before = mean @ w.T
        before += b
        mean, variance, slopes = rectify(before, variance @ v.T)
        kept.append(slopes)
    w, v, b = layers[-1]
    return mean @ w.T + b, variance @ v.T, kept


def network_reverse(layers, kept, d_mean, d_variance):
    for (w, v, _), slopes in zip(layers[:0:-1], kept[::-1], strict=True):
        d_mean, d_variance = rectify_reverse(slopes, d_mean @ w, d_variance @ v)
    w, v, _ = layers[0]
    return d_mean @ w, d_variance @ v


def expected_square(mean, variance):
    """E[(softplus(h) + 1e-4)²] for h ~ N(mean, variance), and its slopes by mean and variance."""
    sd = np.sqrt(variance + 1e-16)
    h = mean[..., None] + sd[..., None] * NODES
    smaller = np.exp(-np.abs(h))
    deviation = np.maximum(h, 0.0) + np.log1p(smaller) + 1e-4
    slope = 2 * deviation * np.where(h > 0, 1.0, smaller) / (1 + smaller) * NODE_WEIGHTS
    return deviation**2 @ NODE_WEIGHTS, slope.sum(-1), slope @ NODES / (2 * sd)


def square_above_zero(mean, variance):
    """(m² + v)Φ + msφ with its slopes 2E and Φ."""
    sd, gain, density = standardised(mean, variance)
    return (mean**2 + variance) * gain + mean * sd * density, 2 * (mean * gain + sd * density), gain


def stochastic(weights, mean, variance):
    """Return mean and variances of a network's outputs but for the error's, then the error's; and what is kept."""
    y, v, mean_kept = network(weights["mean"], mean, variance)
    h, h_variance, error_kept = network(weights["error"], mean, variance)
    square, by_h, by_h_variance = expected_square(h, h_variance)
    scale = weights["square_scale"]
    return y, v, square * scale, (mean_kept, error_kept, by_h * scale, by_h_variance * scale)


def stochastic_reverse(weights, kept, d_y, d_v, d_error):
    mean_kept, error_kept, by_h, by_h_variance = kept
    d_mean, d_variance = network_reverse(weights["mean"], mean_kept, d_y, d_v)
    through_error = network_reverse(weights["error"], error_kept, d_error * by_h, d_error * by_h_variance)
    return d_mean + through_error[0], d_variance + through_error[1]


def judged(y, v, target):
    """Return the expected loss of amounts (P, 4) with variances v, and its slopes by both."""
    short, d_short, d_short_v = square_above_zero(target - y[:, 0], v[:, 0])
    excess, d_excess, d_excess_v = square_above_zero(y[:, 0] - target, v[:, 0])
    spilled, d_spilled, d_spilled_v = square_above_zero(y[:, 1], v[:, 1])
    loss = 10 * short + excess + 3 * spilled + 0.01 * (y[:, 2] ** 2 + v[:, 2])
    none = np.zeros_like(loss)
    d_y = np.stack([d_excess - 10 * d_short, 3 * d_spilled, 0.02 * y[:, 2], none], 1)
    return loss, d_y, np.stack([10 * d_short_v + d_excess_v, 3 * d_spilled_v, none + 0.01, none], 1)


def networks(features, context, x, weights):
    """Return the loss (P,) that the features (P, 18) and the context (P, 2) lead to, and its slopes by both."""
    count, variance = len(features), 0.01 + 0.02 * features**2
    flows, spreads, kept = [], [], []
    for skill in SKILLS:
        flow, spread, error, own = stochastic(weights[f"flow_{skill}"], features, variance)
        flows.append(np.hstack([flow, context]))
        spreads.append(spread + error)
        kept.append(own)
    y, v, error, own = stochastic(weights["amount"], np.vstack(flows), np.vstack(spreads))
    loss, d_y, d_v = judged(y, v + error, x[14])
    share = 1 / len(SKILLS)
    d_mean, d_spread = stochastic_reverse(weights["amount"], own, share * d_y, share * d_v, share * d_v)
    d_features, d_context = np.zeros_like(features), np.zeros_like(context)
    for i, skill in enumerate(SKILLS):
        rows = slice(i * count, (i + 1) * count)
        flow, d_context_here = np.split(d_mean[rows], [-context.shape[1]], axis=1)
        d_context += d_context_here
        slopes = flow, d_spread[rows], d_spread[rows]
        d_own, d_variance = stochastic_reverse(weights[f"flow_{skill}"], kept[i], *slopes)
        d_features += d_own + 0.04 * features * d_variance
    return share * loss.reshape(len(SKILLS), -1).sum(0), d_features, d_context


def value_and_gradient(actions, x, weights):
    """Return J (P,) and its gradients (P, 8) at actions (P, 8)."""
    a, count = actions.T, len(actions)
    tanh, sin, cos = np.tanh(a[0]), np.sin(a[2]), np.cos(a[2])
    g1, g2 = tanh * x[0] + x[1], a[1] * x[2] - 0.1 * a[0] ** 2
    p1, p2, p3 = x[3] + sin * g1, x[4] + cos * g2, x[5] + a[3] * x[6]
    e1, e2, c = p1 - x[7], p2 - x[8], 1 + p1**2
    d = np.sqrt(e1**2 + e2**2 + 1e-4)
    l1, l2 = p1 + 0.3 * a[4] * d, p3 - 0.2 * a[5] * d
    q, th = np.exp(-0.5 * (l1**2 + l2**2)), np.arctan2(p2, c)
    u1, u2 = a[6] * q + th, a[7] * (1 - q)
    f1, f2 = np.tanh(u1 + l1), np.tanh(u2 - l2)
    rewards = -0.05 * (a[:4] ** 2).sum(0) - 0.02 * (a[4:6] ** 2).sum(0) - 0.05 * d**2
    computed = np.stack([g1, g2, p1, p2, p3, d, l1, l2, q, th, u1, u2, f1, f2], 1)
    features = np.hstack([computed, np.broadcast_to(x[9:13], (count, 4))])
    context = np.stack([f1, np.broadcast_to(x[13], count)], 1)
    loss, d_features, d_context = networks(features, context, x, weights)

    dg1, dg2, dp1, dp2, dp3, dd, dl1, dl2, dq, dth, du1, du2, df1, df2 = -d_features.T[:14]
    k1, k2 = (df1 - d_context[:, 0]) * (1 - f1**2), df2 * (1 - f2**2)
    du1, du2 = du1 + k1, du2 + k2
    dq, dth = dq + a[6] * du1 - a[7] * du2, dth + du1
    dl1, dl2 = dl1 + k1 - dq * q * l1, dl2 - k2 - dq * q * l2
    dd = dd + 0.3 * a[4] * dl1 - 0.2 * a[5] * dl2 - 0.1 * d
    dth = dth / (c**2 + p2**2)
    dp1, dp2, dp3 = dp1 + dl1 + dd * e1 / d - 2 * p1 * p2 * dth, dp2 + dd * e2 / d + c * dth, dp3 + dl2
    dg1, dg2 = dg1 + sin * dp1, dg2 + cos * dp2
    gradient = [
        dg1 * x[0] * (1 - tanh**2) - 0.2 * a[0] * dg2 - 0.1 * a[0],
        dg2 * x[2] - 0.1 * a[1],
        cos * g1 * dp1 - sin * g2 * dp2 - 0.1 * a[2],
        dp3 * x[6] - 0.1 * a[3],
        0.3 * d * dl1 - 0.04 * a[4],
        -0.2 * d * dl2 - 0.04 * a[5],
        q * du1,
        (1 - q) * du2,
    ]
    return rewards - loss, np.stack(gradient, 1)


def evaluator(weights, state):
    """Return the function from actions (P, 8) to J (P,) and its gradients (P, 8)."""
    return partial(value_and_gradient, x=state["x"], weights=prepared(weights))
