"""Objects in the gripper: many grasps per type, of all kinds, that hold in the environment too."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import mjhab.envs as envs
from mjhab.core.rotations import mat_from_quat
from mjhab.episodes.grasps.candidates import LyingObject, grasp_candidates
from mjhab.episodes.grasps.stable import (
    MAX_GRASPS,
    MAX_OFFSET_M,
    StableGrasps,
    shape_of,
    spread,
)
from mjhab.episodes.rosters import roster
from mjhab.layout.layout import Layout
from mjhab.robots.fetch.model import REST_QPOS
from mjhab.robots.fetch.robot import ROBOT as FETCH
from mjhab.scenes.builtin.objects import SIZES
from mjhab.scenes.packs import open_pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.scratch import Scratch
from tests.refusals import refused
from tests.tasks.build import config_of

APPLE = "013_apple"
BOWL = "024_bowl"


@pytest.fixture(scope="module")
def sim() -> CpuSimulator:
    return CpuSimulator(Layout(open_pack("builtin"), (APPLE, BOWL)), 1, 1)


def library(sim: CpuSimulator, harvested: bool = False) -> StableGrasps:
    return StableGrasps(sim, config_of(REST_QPOS), Scratch(sim), harvested)


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MJHAB_CACHE", str(tmp_path))
    return tmp_path


def test_another_hand_has_grasps_of_its_own():
    """A plugin that changes the sizes of its gripper is not given the grasps of before from the cache."""
    hand = FETCH.gripper
    narrow = dataclasses.replace(hand, usable=0.5 * hand.usable)
    closed = dataclasses.replace(FETCH.limits, gripper=(0.0, 0.05))
    robots = (
        FETCH,
        dataclasses.replace(FETCH, gripper=narrow),
        dataclasses.replace(FETCH, limits=closed),
    )
    layouts = (Layout(open_pack("builtin"), (BOWL,), robot) for robot in robots)
    sims = [CpuSimulator(layout, 1, 1) for layout in layouts]
    assert len({library(sim).folder for sim in sims}) == len(robots)


@pytest.mark.parametrize("kind", [APPLE, BOWL])
def test_grasps_are_many_and_come_from_everywhere(sim: CpuSimulator, kind: str):
    grasps = library(sim).grasps(kind)
    assert len(grasps) == MAX_GRASPS
    approach = np.array([mat_from_quat(g.pose[3:]).T[:, 0] for g in grasps])
    assert np.linalg.norm(approach.mean(axis=0)[:2]) < 0.4
    assert (np.linalg.norm([g.pose[:3] for g in grasps], axis=1) <= MAX_OFFSET_M).all()
    if kind == BOWL:
        # The rim: the middle of the bowl is a radius away from the fingers, which are almost closed.
        assert min(np.linalg.norm(g.pose[:3]) for g in grasps) > 0.05
        assert max(g.fingers for g in grasps) < 0.01


def test_spread_takes_the_best_first_and_then_what_is_different():
    shape = shape_of(open_pack("builtin").objects["005_tomato_soup_can"], {})
    candidates = grasp_candidates(
        LyingObject.of(
            shape, np.append(np.zeros(3), np.array([1.0, 0, 0, 0])), -shape.half[2]
        )
    )
    rows = list(spread(candidates, 16))
    assert rows[0] == 0 and len(set(rows)) == 16

    def closest(some: list[int]) -> float:
        axes = candidates.rot[some][:, :, :2].reshape(len(some), -1)
        gaps = np.linalg.norm(axes[:, None] - axes, axis=-1)
        return float(np.sort(gaps, axis=1)[:, 1].mean())

    assert closest(rows) > 2 * closest(list(range(16)))


def test_found_once_then_read_from_the_cache(
    sim: CpuSimulator, empty_cache: Path, monkeypatch: pytest.MonkeyPatch
):
    found = library(sim)
    first = found.grasps(APPLE)
    files = list(empty_cache.rglob(f"{APPLE}.npz"))
    assert len(files) == 1
    monkeypatch.setattr(Scratch, "try_grasp", lambda *args: pytest.fail("searched again"))
    again = library(sim)
    for one, two in zip(first, again.grasps(APPLE), strict=True):
        np.testing.assert_array_equal(one.pose, two.pose)
        assert one.fingers == two.fingers
    assert again.digest(APPLE) == found.digest(APPLE)


def test_harvested_grasps_are_tested_kept_and_used_on_request(
    sim: CpuSimulator, empty_cache: Path
):
    own = library(sim, harvested=True)
    best = own.grasps(APPLE)[0]
    added = own.add(APPLE, best.pose, best.fingers)
    assert added is not None
    np.testing.assert_allclose(added.pose, best.pose, atol=0.01)
    assert len(own.grasps(APPLE)) == MAX_GRASPS + 1
    assert len(library(sim).grasps(APPLE)) == MAX_GRASPS, (
        "starts that did not ask for them depend on them"
    )
    assert len(library(sim, harvested=True).grasps(APPLE)) == MAX_GRASPS + 1
    beside = best.pose + np.array([0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.0])
    assert own.add(APPLE, beside, best.fingers) is None
    assert len(own.added(APPLE)) == 1


@pytest.mark.parametrize(
    ("kind", "pose", "fingers", "words"),
    [
        ("013_aple", np.eye(1, 7, 3)[0], 0.03, "013_apple"),
        (APPLE, np.zeros(7), 0.03, "pose"),
        (APPLE, np.full(7, np.nan), 0.03, "pose"),
        (APPLE, np.eye(1, 7, 3)[0], 0.2, "0.05"),
    ],
)
def test_nonsense_is_not_added(
    sim: CpuSimulator, kind: str, pose: np.ndarray, fingers: float, words: str
):
    with refused(said=words):
        library(sim).add(kind, pose, fingers)


def test_every_type_stays_in_the_gripper_of_the_environment():
    env = envs.make(
        task="tidy_house", subtask="place", num_envs=9, autoreset="disabled", threads=1
    )
    chosen: dict[str, int] = {}
    for index in range(200):
        obj = env.starts.start(env.make_episode(0, index)).plan.subtasks[0].obj
        chosen.setdefault(obj.split("_:")[0], index)
        if len(chosen) == 9:
            break
    assert set(chosen) == set(roster("tidy_house")) and set(SIZES) - set(chosen) == {
        APPLE
    }
    env.reset(seed=0, options={"episode": list(chosen.values())})
    actions = np.zeros((9, len(env.action_table)), np.float32)
    actions[:, 7] = -1.0
    for _ in range(10):
        _, _, _, _, info = env.step(actions)
        assert info["is_grasped"].all()
        assert not info["robot_force"].any()
