"""The Gymnasium environment: the official checks, the reward, the metrics."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sims.pouring.environment import PouringEnv, reward_of


@pytest.mark.parametrize(
    "setup",
    [
        {"material": "wat", "mouth": 0.25},
        {"target": (0.1, 0.4), "receiver_size": ((0.22, 0.38), 0.4, (0.14, 0.22)), "blend": True},
    ],
)
def test_it_passes_the_official_checks_without_a_warning(setup):
    env = gymnasium.make("Pouring-v0", render_mode="rgb_array", **setup).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env)
    assert env.render().shape == (480, 480, 3)
    env.close()


def test_it_is_registered_and_reports_the_usual_metrics():
    env = gymnasium.make("Pouring-v0", material="wat", mouth=0.25)
    env.reset(seed=0)
    action = {label: np.full(space.shape, 0.4, np.float32) for label, space in env.action_space.items()}
    action |= {"skill": 1, "pour_position": np.array([0.43, 0.05], np.float32)}
    seen, reward, terminated, truncated, info = env.step(action)
    assert env.observation_space.contains(seen)
    assert terminated
    assert not truncated
    assert info["success"]
    assert info["fraction_in_receiver"] > 0.5
    assert info["spilled_particles"] == 100 * info["fraction_spilled"]
    assert reward == pytest.approx(reward_of(float(seen["poured"][0]) - 0.3, info["spilled_particles"] * 0.1), abs=1e-4)
    env.close()


def test_the_reward_is_the_papers():
    assert reward_of(-0.1, 0.0) == pytest.approx(-1.0)
    assert reward_of(0.1, 0.0) == pytest.approx(-0.01)
    assert reward_of(0.0, 0.2) == pytest.approx(-0.4)


def test_an_unknown_render_mode_is_named():
    with pytest.raises(ValueError, match="'human' is not known"):
        PouringEnv(render_mode="human")
