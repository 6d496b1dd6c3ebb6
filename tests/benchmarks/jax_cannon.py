"""The cannon task as a JAX user would write it by hand: the yardstick of test_cannon_plan.py.

Tuned for speed under the demand of no wrong cannon and at most 1e-9 below the optimum: double precision, one
jitted call a plan, both cannons and all starts side by side by vmap, a start in each of equal strips of
theta, one array in and one out, and JAX's synchronous dispatch, since handing so small a call to another
thread costs more than the call. Two optimizers: ADADELTA as in the paper, ending in Newton steps, and Newton
steps alone, which one unknown makes cheap.
"""

from collections.abc import Callable, Mapping
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_cpu_enable_async_dispatch", False)

GRAVITY = 9.8  # [m/s^2]
TIME_WEIGHT = 1e-3  # [m^2/s^2]
THETA_LIMIT = 1.57  # [rad]
CANNONS = ("lower", "upper")
LABELS = ("speed", "target", "lower_muzzle", "upper_muzzle")

Shot = tuple[float, str, float]  # theta [rad], cannon, reward [m^2]
Planner = Callable[[Mapping[str, object], int], Shot]


def reward(theta, muzzle, target, speed):
    distance = target[0] - muzzle[0]
    hit_time = distance / (speed * jnp.cos(theta))
    hit_height = muzzle[1] + distance * jnp.tan(theta) - GRAVITY / 2 * hit_time**2
    return -((hit_height - target[1]) ** 2) - TIME_WEIGHT * hit_time**2


def newton(value, theta, steps):
    """Ascend by Newton steps on |curvature|, keeping the best of three step lengths or staying put."""
    slope = jax.grad(value)
    curvature = jax.grad(slope)
    shares = jnp.array([1.0, 0.25, 0.05])

    def step(_, theta):
        full = jnp.clip(slope(theta) / (jnp.abs(curvature(theta)) + 1e-300), -0.3, 0.3)
        trials = jnp.clip(theta + shares * full, -THETA_LIMIT, THETA_LIMIT)
        values = jax.vmap(value)(trials)
        winner = jnp.argmax(values)
        return jnp.where(values[winner] >= value(theta), trials[winner], theta)

    return lax.fori_loop(0, steps, step, theta)


def adadelta(value, theta, steps, polish_steps, rho=0.9, epsilon=1e-4):
    """Ascend by ADADELTA, keep the best iterate, polish it by Newton steps."""
    value_and_slope = jax.value_and_grad(value)

    def step(_, carry):
        theta, best_theta, best_value, mean_slope2, mean_move2 = carry
        now, slope = value_and_slope(theta)
        best_theta = jnp.where(now > best_value, theta, best_theta)
        best_value = jnp.maximum(now, best_value)
        mean_slope2 = rho * mean_slope2 + (1 - rho) * slope**2
        move = jnp.sqrt((mean_move2 + epsilon) / (mean_slope2 + epsilon)) * slope
        mean_move2 = rho * mean_move2 + (1 - rho) * move**2
        theta = jnp.clip(theta + move, -THETA_LIMIT, THETA_LIMIT)
        return theta, best_theta, best_value, mean_slope2, mean_move2

    _, best_theta, *_ = lax.fori_loop(0, steps, step, (theta, theta, -jnp.inf, 0.0, 0.0))
    return newton(value, best_theta, polish_steps)


def planner(ascend, starts: int) -> Planner:
    """Multi-start planner around ascend(value, theta) -> theta, with so many starts per cannon."""

    @jax.jit
    def best_shot(state, seed):  # state: (7,) as in LABELS
        speed, target, muzzles = state[0], state[1:3], state[3:].reshape(2, 2)
        drawn = jax.random.uniform(jax.random.key(seed), (len(CANNONS), starts))
        theta = THETA_LIMIT * (2 * (jnp.arange(starts) + drawn) / starts - 1)

        def run(muzzle, theta):
            value = partial(reward, muzzle=muzzle, target=target, speed=speed)
            theta = ascend(value, theta)
            return theta, value(theta)

        theta, value = jax.vmap(jax.vmap(run, in_axes=(None, 0)))(muzzles, theta)
        value = jnp.where(jnp.isfinite(value), value, -jnp.inf)
        winner = jnp.argmax(value)
        return jnp.stack([theta.ravel()[winner], winner // starts, value.ravel()[winner]])

    def plan(state: Mapping[str, object], seed: int) -> Shot:
        packed = np.hstack([state[label] for label in LABELS])
        theta, cannon, value = np.asarray(best_shot(packed, np.int64(seed)))
        return float(theta), CANNONS[int(cannon)], float(value)

    return plan


PLANNERS = {
    "JAX, Newton": planner(partial(newton, steps=12), starts=8),
    "JAX, ADADELTA": planner(partial(adadelta, steps=40, polish_steps=8), starts=8),
}
