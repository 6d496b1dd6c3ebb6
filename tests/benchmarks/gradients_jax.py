"""Value and gradient of pouring_like.py as a JAX user would write them by hand for speed.

What was measured to help: points as rows, so that layers are products of matrices; the two skills' networks side by
side, and amount once for the rows of both; erfc, which XLA writes out in vectors, where it calls the C library for each
erf of a double; the slopes of `rectify` by hand, which are cheap next to what it computes anyway; and 64 points at a
time, so that what the reverse sweep reads is still in the cache. Weights are arguments: new ones need no compilation.
"""

import math
import os
from functools import partial

# Read when JAX first computes. One thread, as symgraph's kernels have.
os.environ["XLA_FLAGS"] = (
    os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
)

import jax
import jax.numpy as jnp
import numpy as np
from benchmarks.pouring_like import FLOW, SKILLS, prepared
from jax import lax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_cpu_enable_async_dispatch", False)

CHUNK = 64  # points side by side
NODES, NODE_WEIGHTS = np.polynomial.hermite_e.hermegauss(5)
NODE_WEIGHTS = NODE_WEIGHTS / NODE_WEIGHTS.sum()


def gain_and_density(alpha):
    return 0.5 * lax.erfc(-math.sqrt(0.5) * alpha), jnp.exp(-0.5 * alpha * alpha) * (1 / math.sqrt(2 * math.pi))


@jax.custom_vjp
def rectify(mean, variance):
    """Mean and variance of max(0, x) for x ~ N(mean, variance)."""
    return rectify_and_keep(mean, variance)[0]


def rectify_and_keep(mean, variance):
    sd = jnp.sqrt(variance + 1e-16)
    gain, density = gain_and_density(mean / sd)
    rectified = mean * gain + sd * density
    spread = variance * gain + (mean - rectified) * rectified
    return (rectified, jnp.maximum(spread, 0.0)), (rectified, gain, density / sd)


def rectify_back(kept, slopes):
    rectified, gain, density = kept
    by_mean, by_variance = slopes
    return (
        by_mean * gain + by_variance * (2 * rectified * (1 - gain)),
        by_mean * (0.5 * density) + by_variance * (gain - rectified * density),
    )


rectify.defvjp(rectify_and_keep, rectify_back)


def network(layers, mean, variance):
    for w, v, b in layers[:-1]:
        mean, variance = rectify(mean @ w.T + b, variance @ v.T)
    w, v, b = layers[-1]
    return mean @ w.T + b, variance @ v.T


def expected_square(mean, variance):
    """E[(softplus(h) + 1e-4)²] for h ~ N(mean, variance)."""
    sd = jnp.sqrt(variance + 1e-16)
    terms = zip(NODES.tolist(), NODE_WEIGHTS.tolist(), strict=True)
    return sum(weight * (jnp.logaddexp(mean + node * sd, 0.0) + 1e-4) ** 2 for node, weight in terms)


def square_above_zero(mean, variance):
    sd = jnp.sqrt(variance + 1e-16)
    gain, density = gain_and_density(mean / sd)
    return (mean * mean + variance) * gain + mean * sd * density


def stochastic(weights, mean, variance):
    error = expected_square(*network(weights["error"], mean, variance)) * weights["square_scale"]
    mean, variance = network(weights["mean"], mean, variance)
    return mean, variance + error


def approach(a, x):
    """From actions, a row per action, to rewards on the way, features (P, 18) and context (P, 2)."""
    g1, g2 = jnp.tanh(a[0]) * x[0] + x[1], a[1] * x[2] - 0.1 * a[0] ** 2
    p1, p2, p3 = x[3] + jnp.sin(a[2]) * g1, x[4] + jnp.cos(a[2]) * g2, x[5] + a[3] * x[6]
    d = jnp.sqrt((p1 - x[7]) ** 2 + (p2 - x[8]) ** 2 + 1e-4)
    l1, l2 = p1 + 0.3 * a[4] * d, p3 - 0.2 * a[5] * d
    q, th = jnp.exp(-0.5 * (l1**2 + l2**2)), jnp.arctan2(p2, 1 + p1**2)
    u1, u2 = a[6] * q + th, a[7] * (1 - q)
    f1, f2 = jnp.tanh(u1 + l1), jnp.tanh(u2 - l2)
    rewards = -0.05 * (a[:4] ** 2).sum(0) - 0.02 * (a[4:6] ** 2).sum(0) - 0.05 * d**2
    given = [jnp.broadcast_to(x[i], d.shape) for i in range(9, 14)]
    features = jnp.stack([g1, g2, p1, p2, p3, d, l1, l2, q, th, u1, u2, f1, f2, *given[:4]], -1)
    return rewards, features, jnp.stack([f1, given[4]], -1)


def objective(actions, x, weights):
    """Return J (P,) of actions (P, 8)."""
    rewards, features, context = approach(actions.T, x)
    flows, variances = jax.vmap(stochastic, (0, None, None))(weights["flow"], features, 0.01 + 0.02 * features**2)
    mean = jnp.concatenate([flows, jnp.broadcast_to(context, (len(SKILLS), *context.shape))], -1)
    y, v = stochastic(weights["amount"], mean.reshape(-1, mean.shape[-1]), variances.reshape(-1, FLOW))
    loss = 10 * square_above_zero(x[14] - y[:, 0], v[:, 0]) + square_above_zero(y[:, 0] - x[14], v[:, 0])
    loss += 3 * square_above_zero(y[:, 1], v[:, 1]) + 0.01 * (y[:, 2] ** 2 + v[:, 2])
    return rewards - loss.reshape(len(SKILLS), -1).mean(0)


@jax.jit
def value_and_gradient(actions, x, weights):
    def some(actions):
        value, back = jax.vjp(partial(objective, x=x, weights=weights), actions)
        return value, back(jnp.ones_like(value))[0]

    if len(actions) <= CHUNK or len(actions) % CHUNK:
        return some(actions)
    values, gradients = lax.map(some, actions.reshape(-1, CHUNK, actions.shape[1]))
    return values.ravel(), gradients.reshape(actions.shape)


def evaluator(weights, state, dtype=np.float64):
    """Return the function from actions (P, 8) to J (P,) and its gradients (P, 8), all as numpy arrays of the dtype."""
    made = jax.tree.map(partial(jnp.asarray, dtype=dtype), prepared(weights))
    made["flow"] = jax.tree.map(lambda *both: jnp.stack(both), *(made.pop(f"flow_{skill}") for skill in SKILLS))
    x = jnp.asarray(state["x"], dtype)

    def evaluate(actions):
        values, gradients = value_and_gradient(np.asarray(actions, dtype), x, made)
        return np.asarray(values), np.asarray(gradients)

    return evaluate
