"""Trajectories of whole tasks: which are written, and up to which step."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import h5py
import numpy as np
import pytest
import torch

from mjhab.compat.mshab.wrappers.record_chain import RecordEpisodeSequentialTask
from tests.refusals import refused

PLAN = 3
"""Subtasks of a plan."""


class Scripted(gymnasium.Env):
    """Worlds whose finished subtasks are told in advance, (T, W); a plan succeeds with its last one."""

    def __init__(self, finished: list[list[int]], subtask: str = "") -> None:
        self._finished = torch.tensor(finished)
        self.num_envs = self._finished.shape[1]
        self.arguments = SimpleNamespace(subtask=subtask)
        self.single_action_space = gymnasium.spaces.Box(-1, 1, (2,))
        self.task_plan = [None] * PLAN
        self.control_mode = "pd_joint_delta_pos"
        self._episode_seed = np.zeros(self.num_envs, np.int64)
        self.task_plan_idxs = torch.zeros(self.num_envs, dtype=torch.int64)
        self.build_config_idxs = self.init_config_idxs = [0] * self.num_envs
        self.spawn_selection_idxs = [None] * self.num_envs
        self.at = 0

    def get_state_dict(self) -> dict[str, Any]:
        return {"actors": {"bowl": torch.full((self.num_envs, 13), float(self.at))}}

    def _told(self) -> tuple[Any, dict[str, Any]]:
        finished = (
            self._finished[self.at - 1]
            if self.at
            else torch.zeros(self.num_envs, dtype=torch.int64)
        )
        success = finished >= PLAN
        info = {"subtask": finished, "success": success, "fail": success & ~success}
        return {"state": torch.full((self.num_envs, 1), float(self.at))}, info

    def reset(self, **_: Any) -> Any:
        self.at = 0
        obs, info = self._told()
        return obs, {**info, "reconfigure": True}

    def step(self, action: Any) -> Any:
        self.at += 1
        obs, info = self._told()
        return obs, torch.ones(self.num_envs), info["success"], info["fail"], info


def recorded(tmp_path: Path, finished: list[list[int]], **options: Any) -> list[int]:
    """Record one episode of every world; the lengths of those that are written."""
    env = RecordEpisodeSequentialTask(
        Scripted(finished), tmp_path, trajectory_name="a", save_video=False, **options
    )
    env.reset()
    for _ in finished:
        env.step(np.zeros((len(finished[0]), 2)))
    env.close()
    told = json.loads((tmp_path / "a.json").read_text())["episodes"]
    with h5py.File(tmp_path / "a.h5") as file:
        for each in told:
            group: Any = file[f"traj_{each['episode_id']}"]
            steps = each["elapsed_steps"]
            assert group["actions"].shape == (steps, 2)
            assert group["obs/state"][:, 0].tolist() == list(range(steps + 1))
            # Unlike those of single subtasks they hold `info`, the start included.
            assert group["info/subtask"].shape == (steps + 1,)
            assert group["info/subtask"][0] == 0
            assert group["env_states/actors/bowl"].shape == (steps + 1, 13)
            assert each["success"] == bool(group["success"][-1])
    return [each["elapsed_steps"] for each in told]


WORLDS = [[0, 0, 0], [0, 1, 0], [0, 1, 1], [0, 2, 2], [0, 2, 3], [0, 2, 3]]
"""Of the worlds, one finishes nothing, one two subtasks, the last one in step 4, and one the plan in step 5."""


def test_failures_are_written_up_to_their_last_finished_subtask(tmp_path: Path) -> None:
    assert recorded(tmp_path, WORLDS) == [3, 6]


@pytest.mark.parametrize(
    ("options", "lengths"),
    [
        ({"demo_filter": "success"}, [6]),
        ({"demo_filter": "min_success_subtasks", "min_success_subtasks": 2}, [3, 6]),
        ({"demo_filter": "min_success_subtasks", "min_success_subtasks": 3}, [6]),
        ({"max_trajectories": 1}, [3]),
    ],
)
def test_filters_choose_episodes(
    tmp_path: Path, options: dict[str, Any], lengths: list[int]
) -> None:
    assert recorded(tmp_path, WORLDS, **options) == lengths


def test_what_it_cannot_record_is_refused(tmp_path: Path) -> None:
    with refused(said="is for whole tasks"):
        RecordEpisodeSequentialTask(Scripted(WORLDS, "pick"), tmp_path)
    with refused("demo_filter", "best", "success"):
        RecordEpisodeSequentialTask(Scripted(WORLDS), tmp_path, demo_filter="best")
    with refused("min_success_subtasks"):
        RecordEpisodeSequentialTask(
            Scripted(WORLDS), tmp_path, demo_filter="min_success_subtasks"
        )
