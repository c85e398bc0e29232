"""The robot panda_omron does every subtask: run by `make test-panda`, with the files of robosuite."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

import mjhab
from mjhab.data.record.verify import verify
from mjhab.data.store.checking import check
from mjhab.data.store.places import episodes
from mjhab.envs.observations.state import state_dim
from mjhab.evaluation.recorded import recorded_env
from mjhab.robots.registry import robot_named

ROBOT = "panda_omron"
SUBTASKS = ("pick", "place", "navigate", "open", "close")
CAMERAS = ("panda_omron_head", "panda_omron_hand")


def target_of(subtask: str) -> str:
    """The bowl where an object is handled: the gripper cannot hold the apple."""
    return "024_bowl" if subtask in ("pick", "place") else ""


@pytest.mark.parametrize("subtask", SUBTASKS)
def test_every_subtask_spawns_steps_draws_and_is_rewarded(subtask: str) -> None:
    env = mjhab.make(
        robot=ROBOT,
        task="set_table",
        subtask=subtask,
        target=target_of(subtask),
        obs_mode="rgbd",
        camera_size=16,
        reward_mode="normalized_dense",
    )
    robot = robot_named(ROBOT)
    obs, info = env.reset(seed=0)
    held = subtask == "place" or bool(env.tables.arrays.must_hold[0, 0])
    action = np.zeros(env.action_space.shape, np.float32)
    action[:, robot.action.gripper] = -1.0
    for _ in range(5):
        obs, reward, terminated, truncated, info = env.step(action)
        assert 0.0 < reward[0] < 1.0 and not terminated[0] and not truncated[0]
    assert obs["state"].shape == (1, state_dim(robot)) and np.isfinite(obs["state"]).all()
    for camera in CAMERAS:
        assert obs[f"sensor_data/{camera}/rgb"].std() > 5
        assert obs[f"sensor_data/{camera}/depth"].any()
    assert bool(info["is_grasped"][0]) is held and env.nan_resets[0] == 0
    env.close()


@pytest.mark.parametrize("subtask", SUBTASKS)
def test_the_expert_is_recorded_labelled_and_replayed(
    subtask: str, tmp_path: Path
) -> None:
    mjhab.generate(
        out=tmp_path,
        task="set_table",
        subtask=subtask,
        target=target_of(subtask) or None,
        episodes=2,
        images="rgbd",
        camera_size=16,
        reward_mode="normalized_dense",
        worlds=1,
        env={"robot": ROBOT},
    )
    assert check(tmp_path).clean
    found = list(episodes(tmp_path))
    assert len(found) == 2
    for episode in found:
        (told,) = episode.record.subtasks
        assert told.kind == subtask and told.label and told.success_once
        assert episode.run.config["env"]["robot"] == ROBOT
        assert np.ptp(episode.array("reward/total")) > 0
        for camera in CAMERAS:
            assert episode.frame(camera, "rgb", episode.steps).std() > 5
    replayed = verify(tmp_path, partial(recorded_env, num_envs=2, threads=1))
    assert (replayed.episodes, replayed.exact) == (2, 2)
