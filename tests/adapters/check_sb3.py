"""stable-baselines3 trains in a mjhab environment: run by `make test-sb3`, in an environment that has it."""

from __future__ import annotations

import numpy as np
import pytest
import stable_baselines3  # pyright: ignore[reportMissingImports]
from stable_baselines3.common.preprocessing import (  # pyright: ignore[reportMissingImports]
    is_image_space,
)
from stable_baselines3.common.torch_layers import (  # pyright: ignore[reportMissingImports]
    NatureCNN,
)
from torch import nn

import mjhab
from mjhab.core.errors import UsageError
from mjhab.envs.wrappers import FlattenStatePixels, FrameStack, NormalizeImages
from mjhab.integrations.sb3 import to_sb3

DEPTH = "sensor_data/fetch_hand/depth"
RGB = "sensor_data/fetch_hand/rgb"
SEG = "sensor_data/fetch_hand/seg"
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


def test_the_monitor_logs_returns_and_lengths() -> None:
    env = to_sb3(mjhab.make_train(**OPTIONS))
    ppo = stable_baselines3.PPO("MlpPolicy", env, n_steps=HORIZON, batch_size=4)
    ppo.learn(4 * HORIZON)
    episodes = list(ppo.ep_info_buffer)
    assert len(episodes) == 4 and {episode["l"] for episode in episodes} == {HORIZON}
    assert len(ppo.ep_success_buffer) == 4


def test_images_are_bytes_for_a_cnn() -> None:
    """Depth is 255 (1 - tanh m): a CNN of stable-baselines3 trains on it, beside the state."""
    inner = mjhab.make_train(**OPTIONS, obs_mode="rgbd", camera_size=(36, 48))
    keys = ("state", DEPTH, RGB)
    env = to_sb3(inner, keys)
    env.seed(3)
    seen = env.reset()
    raw, _ = inner.reset(seed=[3, 4])
    for key in (DEPTH, RGB):
        assert is_image_space(env.observation_space[key])
        assert env.observation_space[key].shape == (36, 48, 1 if key == DEPTH else 3)
        assert seen[key].dtype == np.uint8
    metres = raw[DEPTH].astype(float) / 1000
    assert np.abs(seen[DEPTH] - 255 * (1 - np.tanh(metres))).max() < 0.51
    assert (seen[RGB] == raw[RGB]).all()
    ppo = stable_baselines3.PPO("MultiInputPolicy", env, n_steps=4, batch_size=8)
    nets = ppo.policy.features_extractor.extractors
    assert [type(nets[key]) for key in keys] == [nn.Flatten, NatureCNN, NatureCNN]
    before = [value.clone() for value in nets[DEPTH].parameters()]
    ppo.learn(8)
    after = list(nets[DEPTH].parameters())
    assert any((a != b).any() for a, b in zip(before, after, strict=True))


def test_one_image_alone_and_stacked_frames() -> None:
    env = FrameStack(mjhab.make_train(**OPTIONS, obs_mode="depth", camera_size=36), 3)
    wrapped = to_sb3(env, (DEPTH,))
    assert wrapped.observation_space.shape == (36, 36, 3)
    obs = wrapped.reset()
    assert obs.shape == (2, 36, 36, 3) and (obs[..., 0] == obs[..., 2]).all()
    moved, *_ = wrapped.step(np.full((2, 13), 0.5, np.float32))
    assert (moved[..., 0] == obs[..., 2]).all()
    assert (moved[..., 2] != obs[..., 2]).any()
    stable_baselines3.PPO("CnnPolicy", wrapped, n_steps=4, batch_size=8).learn(8)


def test_what_no_network_takes_is_told() -> None:
    small = mjhab.make_train(**OPTIONS, obs_mode="rgbd+seg", camera_size=32)
    for key in (DEPTH, RGB):
        with pytest.raises(UsageError, match=r"32 x 32 px.*36 px or more"):
            to_sb3(small, ("state", key))
    own = to_sb3(small, (DEPTH,), smallest_side=32)
    assert own.observation_space.shape == (32, 32, 1)
    with pytest.raises(UsageError, match="ids"):
        to_sb3(small, (SEG,), smallest_side=32)
    with pytest.raises(UsageError, match="leave out NormalizeImages"):
        to_sb3(NormalizeImages(small), (DEPTH,))
    with pytest.raises(UsageError, match="FlattenStatePixels"):
        to_sb3(FlattenStatePixels(small), ("pixels",))


def test_bad_input_is_told() -> None:
    with pytest.raises(UsageError, match="same_step"):
        to_sb3(mjhab.make_train(**OPTIONS, autoreset="disabled"))
    with pytest.raises(UsageError, match="Did you mean"):
        to_sb3(mjhab.make_train(**OPTIONS), ("stat",))
