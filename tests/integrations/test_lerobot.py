"""The environment that LeRobot sees: its observations, attributes and info, without lerobot."""

from __future__ import annotations

import gymnasium
import numpy as np

from mjhab.integrations.lerobot import LeRobotEnv
from tests.refusals import refused

OPTIONS = {"subtask": "close", "target": "kitchen_counter/drawer3", "camera_size": 16}


def test_it_gives_what_lerobot_reads() -> None:
    worlds = gymnasium.vector.SyncVectorEnv(
        [lambda: LeRobotEnv(**OPTIONS)] * 2,
        autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP,
    )
    obs, _ = worlds.reset(seed=[3, 4])
    assert worlds.observation_space.contains(obs)
    image = obs["pixels"]["fetch_head"]
    assert image.shape == (2, 16, 16, 3) and image.std() > 0
    assert obs["agent_pos"].shape == (2, 34) and obs["environment_state"].shape == (2, 11)
    assert not np.array_equal(obs["agent_pos"][0], obs["agent_pos"][1])
    told = worlds.call("task_description")
    assert all("top right drawer" in text for text in told)
    assert worlds.call("_max_episode_steps") == (500, 500)
    _, _, terminated, truncated, info = worlds.step(np.zeros((2, 13), np.float32))
    assert not (terminated | truncated).any() and info["is_success"].tolist() == [
        False,
        False,
    ]
    assert worlds.call("render")[0].ndim == 3
    # The seed of a reset names its episode.
    again, _ = LeRobotEnv(**OPTIONS).reset(seed=4)
    np.testing.assert_array_equal(again["agent_pos"], obs["agent_pos"][1])
    worlds.close()


def test_actions_of_another_size_and_nan_are_refused() -> None:
    env = LeRobotEnv("ee", subtask="close", camera_size=16)
    assert env.action_space.shape == (9,)
    env.reset(seed=0)
    with refused(said="actions have 13 numbers, not 9"):
        env.step(np.zeros(13))
    with refused(said="has nan for ee_x"):
        env.step(np.full(9, np.nan))
    env.close()
