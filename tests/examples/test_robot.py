"""The robot of `examples/robot` does every subtask: nothing outside `robots` needs Fetch, a torso or a head."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import mjhab
from benchmarks.grasp import grasp_table
from benchmarks.sim import SimSpec, measure_engine
from mjhab.cli.main import main
from mjhab.core.registration.plugins import load_plugin
from mjhab.envs.observations.state import state_dim
from mjhab.episodes.spawn_sets import SpawnSet
from mjhab.robots.registry import ROBOTS, robot_named
from mjhab.robots.robot import Robot
from tests.refusals import refused

EXAMPLE = Path(__file__).parents[2] / "examples" / "robot" / "boxy.py"
SUBTASKS = ("pick", "place", "navigate", "open", "close")


@pytest.fixture(scope="module")
def boxy() -> Iterator[Robot]:
    assert load_plugin(EXAMPLE).error == ""
    yield robot_named("boxy")
    ROBOTS.remove("boxy")


def test_it_is_a_robot_with_what_tasks_need(boxy: Robot) -> None:
    assert boxy.columns.torso is None and not boxy.head_columns and boxy.action.dim == 10
    turn = boxy.chain.tip_pose(boxy.rest)[1][0]
    np.testing.assert_allclose(turn[:, 0], (0.0, 0.0, -1.0), atol=1e-3)
    assert ROBOTS.source("boxy") == str(EXAMPLE)


@pytest.mark.parametrize("subtask", SUBTASKS)
def test_every_subtask_spawns_steps_draws_and_is_rewarded(
    boxy: Robot, subtask: str
) -> None:
    target = "024_bowl" if subtask in ("pick", "place") else ""
    env = mjhab.make(
        robot="boxy",
        task="set_table",
        subtask=subtask,
        target=target,
        obs_mode="rgbd",
        camera_size=16,
        reward_mode="normalized_dense",
    )
    obs, _ = env.reset(seed=0)
    # A way to a goal begins with its object in the hand.
    held = subtask == "place" or bool(env.tables.arrays.must_hold[0, 0])
    action = np.zeros(env.action_space.shape, np.float32)
    action[:, boxy.action.gripper] = -1.0
    for _ in range(5):
        obs, reward, terminated, truncated, info = env.step(action)
    assert obs["state"].shape == (1, state_dim(boxy)) and np.isfinite(obs["state"]).all()
    assert (
        obs["sensor_data/boxy_hand/rgb"].std() > 5
        and obs["sensor_data/boxy_head/depth"].any()
    )
    assert 0.0 < reward[0] < 1.0 and not terminated[0] and not truncated[0]
    assert bool(info["is_grasped"][0]) is held and env.nan_resets[0] == 0
    env.close()


def test_the_expert_reaches_for_a_bowl_with_it(boxy: Robot) -> None:
    env = mjhab.make(robot="boxy", task="set_table", subtask="pick", target="024_bowl")
    expert = mjhab.make_expert(env)
    obs, info = env.reset(seed=0)
    start = np.linalg.norm(
        obs["extra/obj_pose_wrt_base"][0, :3] - obs["extra/tcp_pose_wrt_base"][0, :3]
    )
    nearest = start
    for _ in range(60):
        obs, _, _, _, info = env.step(expert.act(obs, info))
        hand = obs["extra/tcp_pose_wrt_base"][0, :3]
        nearest = min(
            nearest, float(np.linalg.norm(obs["extra/obj_pose_wrt_base"][0, :3] - hand))
        )
    assert nearest < 0.5 * start


@pytest.mark.usefixtures("boxy")
def test_a_spawn_set_is_of_its_robot(tmp_path: Path) -> None:
    path = tmp_path / "place.npz"
    asked = ("--subtask", "place", "--target", "024_bowl", "--count", "2", "--pool", "1")
    assert main(["spawns", "make", "--robot", "boxy", *asked, "--out", str(path)]) == 0
    made = SpawnSet.read(path)
    assert made.recipe.robot == "boxy" and made.describe()["robot"] == "boxy"

    options = {"task": "set_table", "subtask": "place", "target": "024_bowl"}
    env = mjhab.make(robot="boxy", spawns=str(path), **options)
    _, info = env.reset(seed=0, options={"episode": [1]})
    qpos = env.state.robot_q[0]
    np.testing.assert_allclose(qpos, made.columns["qpos"][1][: len(qpos)], atol=1e-6)
    assert info["is_grasped"][0]
    env.close()
    with refused(
        where="place.npz",
        said="starts of robot 'boxy', the environment has robot 'fetch'",
    ):
        mjhab.make(spawns=str(path), **options)


@pytest.mark.usefixtures("boxy")
def test_the_grasp_bench_and_the_engine_bench_take_it() -> None:
    rows = grasp_table(seconds=0.5, objects=("004_sugar_box",), robot="boxy")
    assert [row["object"] for row in rows] == ["004_sugar_box"] and not rows[0]["dropped"]
    measured = measure_engine(
        SimSpec(worlds=1, threads=1, steps=2, rounds=1, robot="boxy")
    )
    assert measured["env_sps"] > 0


def test_a_robot_whose_files_are_missing_says_where_to_get_them() -> None:
    """With robosuite installed the robot is made of its files; without it the error tells the command."""
    if importlib.util.find_spec("robosuite") is None:
        with pytest.raises(
            mjhab.core.errors.MjhabError, match="-m pip install --no-deps robosuite"
        ):
            mjhab.make(robot="panda_omron", task="set_table")
        return
    panda = robot_named("panda_omron")
    pos, turn = panda.chain.tip_pose(panda.rest)
    np.testing.assert_allclose(turn[0, :, 0], (0.0, 0.0, -1.0), atol=1e-6)
    assert pos[0, 2] == pytest.approx(1.318, abs=0.02)
    env = mjhab.make(robot="panda_omron", task="set_table", subtask="open")
    obs, _ = env.reset(seed=0)
    obs, *_ = env.step(np.zeros(env.action_space.shape, np.float32))
    assert obs["state"].shape == (1, 38) and np.isfinite(obs["state"]).all()
