"""stable-baselines3 trains in a mjhab environment: run by `make test-sb3`, in an environment that has it."""

from __future__ import annotations

import numpy as np
import pytest
import stable_baselines3  # pyright: ignore[reportMissingImports]

import mjhab
from mjhab.core.errors import UsageError
from mjhab.integrations.sb3 import to_sb3

HORIZON = 6
OPTIONS = {
    "task": "set_table",
    "subtask": "close",
    "target": "kitchen_counter/drawer3",
    "home": "builtin_m0_00",
    "num_envs": 2,
    "horizon": HORIZON,
    "episode_pool": 2,
}


def test_time_that_is_up_is_told_with_the_last_observation() -> None:
    env = to_sb3(mjhab.make_train(**OPTIONS))
    env.seed(3)
    obs = env.reset()
    still = np.zeros((2, 13), np.float32)
    for step in range(1, HORIZON + 1):
        before = obs
        obs, reward, done, infos = env.step(still)
        assert done.all() == (step == HORIZON) and reward.dtype == np.float32
    assert all(info["TimeLimit.truncated"] for info in infos)
    for world, info in enumerate(infos):
        last = info["terminal_observation"]
        # One step from what was seen before it, and far from the first observation of the next episode.
        assert np.abs(last - before[world]).max() < np.abs(last - obs[world]).max()


def test_ppo_and_sac_train() -> None:
    env = to_sb3(mjhab.make_train(**OPTIONS))
    ppo = stable_baselines3.PPO("MlpPolicy", env, n_steps=8, batch_size=8, n_epochs=1)
    before = [value.clone() for value in ppo.policy.parameters()]
    ppo.learn(16)
    assert any(
        (a != b).any() for a, b in zip(before, ppo.policy.parameters(), strict=True)
    )
    sac = stable_baselines3.SAC(
        "MlpPolicy", env, learning_starts=8, batch_size=8, buffer_size=64
    )
    sac.learn(24)
    assert sac.replay_buffer.pos > 0


def test_several_keys_are_a_dict() -> None:
    env = to_sb3(mjhab.make_train(**OPTIONS), ("state", "agent/qpos"))
    assert set(env.reset()) == {"state", "agent/qpos"}


def test_bad_input_is_told() -> None:
    with pytest.raises(UsageError, match="same_step"):
        to_sb3(mjhab.make_train(**OPTIONS, autoreset="disabled"))
    with pytest.raises(UsageError, match="Did you mean"):
        to_sb3(mjhab.make_train(**OPTIONS), ("stat",))
