"""ManiSkill's own reader takes our export: run by `make test-maniskill`, in an environment that has mani_skill."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from mani_skill.trajectory.dataset import (  # pyright: ignore[reportMissingImports]
    ManiSkillTrajectoryDataset,
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


def test_an_item_has_observation_and_action(exported: Path) -> None:
    item = ManiSkillTrajectoryDataset(str(exported), success_only=True)[0]
    assert item["action"].shape == (13,)
    depth = np.asarray(item["obs"]["sensor_data"]["fetch_head"]["depth"])
    assert depth.shape == (SIZE, SIZE, 1) and depth.dtype == np.int16
