"""ManiSkill's own reader takes our export: run by `make test-maniskill`, in an environment that has mani_skill."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from mani_skill.trajectory.dataset import (  # pyright: ignore[reportMissingImports]
    ManiSkillTrajectoryDataset,
)
from mani_skill.trajectory.merge_trajectory import (  # pyright: ignore[reportMissingImports]
    merge_trajectories,
)
from mani_skill.trajectory.utils import (  # pyright: ignore[reportMissingImports]
    dict_to_list_of_dicts,
    list_of_dicts_to_dict,
)

from mjhab.data.store.images import ImageFormat
from tests.data.export.exporting import to_maniskill
from tests.data.fake_world import SIZE, FakeEnv
from tests.data.make import record

FAILED = 8
"""Index of an episode of the fake environment that fails; the next ones succeed."""


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exported")
    env = FakeEnv(subtask="pick", images=True)
    record(folder / "picks.h5", [FAILED, 9, 10], env, images=ImageFormat())
    return to_maniskill(folder / "picks.h5", folder / "out").files[0]


def test_all_episodes_and_the_successful_ones_alone(exported: Path) -> None:
    told = json.loads(exported.with_suffix(".json").read_text())["episodes"]
    steps = {each["success"]: 0 for each in told}
    for each in told:
        steps[each["success"]] += each["elapsed_steps"]
    assert steps[True] and steps[False]
    everything = ManiSkillTrajectoryDataset(str(exported))
    assert len(everything) == steps[True] + steps[False]
    successes = ManiSkillTrajectoryDataset(str(exported), success_only=True)
    assert len(successes) == steps[True]
    ends = successes.terminated | successes.truncated
    assert ends.sum() == 2 and successes.success[ends].all()


def test_states_are_read_and_files_merged(exported: Path, tmp_path: Path) -> None:
    with h5py.File(exported) as file:
        group: Any = file["traj_0"]
        states = dict_to_list_of_dicts(group["env_states"])
        assert len(states) == len(group["actions"]) + 1
        assert states[0]["actors"]["024_bowl-0"].shape == (13,)
        back = list_of_dicts_to_dict(states)["actors"]["024_bowl-0"]
        np.testing.assert_array_equal(back, group["env_states/actors/024_bowl-0"])
    merged = tmp_path / "merged.h5"
    merge_trajectories(str(merged), [str(exported)] * 2)
    one = ManiSkillTrajectoryDataset(str(exported))
    assert len(ManiSkillTrajectoryDataset(str(merged))) == 2 * len(one)
    assert one.env_id == "PickSubtaskTrain-v0"
    assert one.env_kwargs["robot_uids"] == "fetch"


def test_an_item_has_observation_and_action(exported: Path) -> None:
    item = ManiSkillTrajectoryDataset(str(exported), success_only=True)[0]
    assert item["action"].shape == (13,)
    depth = np.asarray(item["obs"]["sensor_data"]["fetch_head"]["depth"])
    assert depth.shape == (SIZE, SIZE, 1) and depth.dtype == np.int16
