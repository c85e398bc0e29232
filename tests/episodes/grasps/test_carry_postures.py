"""Arms of successful Picks: what a Pick would accept, kept in the cache; objects stay in the hand when they start."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mjhab.envs as envs
from mjhab.config.env import EnvConfig
from mjhab.config.thresholds import task_config
from mjhab.core.seeding import stream
from mjhab.episodes.grasps import carry_postures
from mjhab.episodes.grasps.carry_postures import MAX_ARMS, CarryPostures, rest_postures
from mjhab.episodes.grasps.stable import MAX_OFFSET_M, StableGrasps
from mjhab.episodes.rosters import roster
from mjhab.episodes.starts import StartMaker
from mjhab.layout.layout import Layout
from mjhab.robots.fetch.model import REST_QPOS
from mjhab.robots.fetch.robot import ROBOT
from mjhab.scenes.packs import open_pack
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.mujoco.scratch import Scratch
from tests.refusals import refused
from tests.tasks.build import config_of

APPLE = "013_apple"
BOWL = "024_bowl"
CONFIG = config_of(REST_QPOS)
REST_ARM = np.array(REST_QPOS)[list(ROBOT.arm_columns)]
HELD_STEPS = 5
LEAST_HELD = 0.9
"""After so many control steps so many starts must still hold their object."""


@pytest.fixture(scope="module")
def sim() -> CpuSimulator:
    return CpuSimulator(Layout(open_pack("builtin"), (APPLE, BOWL)), 1, 1)


def library(sim: CpuSimulator) -> CarryPostures:
    return CarryPostures(StableGrasps(sim, CONFIG, Scratch(sim)))


def hand_at(arms: np.ndarray) -> np.ndarray:
    """(N, 3) tool centres in the world of arms (N, 7), the base at the origin, the rest of the robot at rest."""
    q = np.tile(REST_QPOS, (len(arms), 1))
    q[:, list(ROBOT.arm_columns)] = arms
    return ROBOT.chain.tip_pose(q)[0]


def check_postures(arms: np.ndarray) -> None:
    """They pass the posture test of Pick, and are not all the same."""
    assert np.abs(arms - REST_ARM).max() <= CONFIG.arm_tol_grasped
    rest_point = np.array(CONFIG.ee_rest_pos) + np.array([0.0, 0.0, CONFIG.base_height])
    assert np.linalg.norm(hand_at(arms) - rest_point, axis=1).max() <= CONFIG.ee_rest_tol
    assert arms.std(axis=0).min() > 0.05


def test_postures_are_those_that_pick_accepts() -> None:
    arms = rest_postures(ROBOT, stream(0, "test"), CONFIG, 200)
    assert len(arms) > 150
    check_postures(arms)


@pytest.mark.parametrize("kind", [APPLE, BOWL])
def test_arms_are_many_and_hold_their_object_near_the_hand(
    sim: CpuSimulator, kind: str
) -> None:
    arms = library(sim).arms(kind)
    assert len(arms) == MAX_ARMS
    check_postures(np.array([one.arm for one in arms]))
    assert max(np.linalg.norm(one.grasp.pose[:3]) for one in arms) <= MAX_OFFSET_M


def test_made_once_then_read_from_the_cache(
    sim: CpuSimulator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MJHAB_CACHE", str(tmp_path))
    monkeypatch.setattr(carry_postures, "MAX_ARMS", 3)
    first = library(sim)
    made = first.arms(APPLE)
    assert len(list(tmp_path.rglob(f"{APPLE}-arms-*.npz"))) == 1
    monkeypatch.setattr(Scratch, "try_grasp", lambda *args: pytest.fail("made again"))
    again = library(sim)
    for one, two in zip(made, again.arms(APPLE), strict=True):
        np.testing.assert_array_equal(one.arm, two.arm)
        np.testing.assert_array_equal(one.grasp.pose, two.grasp.pose)
    assert again.digest(APPLE) == first.digest(APPLE)
    with refused(said=APPLE):
        again.arms("013_aple")


@pytest.mark.parametrize(("task", "count"), [("set_table", 10), ("tidy_house", 16)])
def test_objects_are_still_held_after_some_steps(
    task: str, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Of each object no more than are drawn here: each takes 40 ms to be found.
    monkeypatch.setattr(carry_postures, "MAX_ARMS", 8)
    env: Any = envs.make(
        task=task,
        subtask="place",
        profile="ms_hab",
        num_envs=count,
        threads=2,
        autoreset="disabled",
        seed=3,
    )
    env.reset(options={"episode": list(range(count))})
    robot = env.state.robot_q
    off = np.abs(robot[:, list(ROBOT.arm_columns)] - REST_ARM)
    assert off.max() > 0.5 and off.max() <= CONFIG.arm_tol_grasped + 0.2 + 1e-6
    np.testing.assert_allclose(
        robot[:, [3, 4, 6]],
        np.tile(np.array(REST_QPOS)[[3, 4, 6]], (count, 1)),
        atol=1e-6,
    )
    for _ in range(HELD_STEPS):
        actions = env.controller.still(env.state)
        actions[:, env.controller.gripper] = -1.0
        env.step(actions)
    assert np.mean(env.signals.is_grasped) >= LEAST_HELD
    assert not env.fallback.any()


def test_harvested_grasps_are_not_for_the_published_rule() -> None:
    config = EnvConfig(task="tidy_house", subtask="place", spawn_rule="published")
    sim = CpuSimulator(Layout(open_pack("builtin"), roster("tidy_house")), 1, 1)
    with refused("harvested", True):
        StartMaker(sim, config, task_config(config, ROBOT), harvested=True)
