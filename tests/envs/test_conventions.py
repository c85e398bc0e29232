"""What environments of either profile observe of boxes and of joints that were turned round."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjhab.core.conventions.names import PUBLISHED, Conventions
from mjhab.envs import make
from mjhab.envs.wrappers import FlattenStatePixels, FrameStack
from mjhab.experts.arm.motion import rest_goal
from mjhab.robots.fetch.robot import ROBOT
from tests.real_data import real_data

BOXES = {
    "010_potted_meat_can": (87.3, -2.7),
    "008_pudding_box": (62.4, -27.6),
    "009_gelatin_box": (-13.1, -13.1),
    "004_sugar_box": (1.8, 1.8),
}
"""Headings [degrees] of the scans in the built-in homes and in ReplicaCAD with YCB objects."""
KEY = "extra/obj_pose_wrt_base"


def options(target: str, **more: Any) -> dict[str, Any]:
    return {
        "task": "tidy_house",
        "subtask": "pick",
        "target": target,
        "autoreset": "disabled",
        "threads": 1,
        "num_envs": 2,
        **more,
    }


def rotation(pose: np.ndarray) -> Rotation:
    return Rotation.from_quat(pose[[4, 5, 6, 3]])


def in_base(env: Any, world: int) -> Rotation:
    """Orientation of the observed object in the frame of the base, from the state of the simulator."""
    slot = int(env.focus.obj[world])
    base = Rotation.from_rotvec([0.0, 0.0, float(env.state.robot_q[world, 2])])
    pose = np.asarray(env.state.object_pose[world, slot], float)
    return base.inv() * rotation(pose)


@pytest.mark.parametrize("pack", ["builtin", "replica_cad"])
@pytest.mark.parametrize("target", BOXES)
def test_each_profile_observes_its_own_axes(target: str, pack: str) -> None:
    assets = "builtin" if pack == "builtin" else str(real_data("replica_cad"))
    heading = BOXES[target][pack != "builtin"]
    more = {
        "assets": assets,
        "home": "builtin_m0_00" if pack == "builtin" else "v3_sc1_*",
    }
    for profile, turn in (("mjhab", 0.0), ("ms_hab", heading)):
        env = make(**options(target, profile=profile, **more))
        env.reset(seed=0)
        obs, *_ = env.step(np.zeros((2, 13), np.float32))
        for world in range(2):
            seen = rotation(obs[KEY][world])
            wanted = in_base(env, world) * Rotation.from_rotvec(
                [0.0, 0.0, math.radians(turn)]
            )
            # Headings are known to a tenth of a degree here.
            assert math.degrees((wanted.inv() * seen).magnitude()) < 0.06
        own = env.config.conventions
        np.testing.assert_array_equal(env.state_as(own), obs["state"])
        other = env.state_as(PUBLISHED if profile == "mjhab" else Conventions())
        assert other.dtype == np.float32
        apart = rotation(other[0, 31:38]).inv() * rotation(obs["state"][0, 31:38])
        assert math.degrees(apart.magnitude()) == pytest.approx(abs(heading), abs=0.06)
        env.close()


def test_the_wrappers_of_the_original_show_what_the_environment_observes() -> None:
    env = make(
        **options(
            "010_potted_meat_can", profile="ms_hab", obs_mode="depth", camera_size=16
        )
    )
    told, _ = FlattenStatePixels(FrameStack(env, 3)).reset(seed=0)
    np.testing.assert_array_equal(told["state"], env.state_as(PUBLISHED))
    env.close()


def test_a_joint_that_was_turned_round_is_observed_within_half_a_turn_in_our_profile() -> (
    None
):
    column = ROBOT.joints.index("wrist_roll_joint")
    assert ROBOT.endless[column] and sum(ROBOT.endless) == 3
    seen = {}
    for profile in ("mjhab", "ms_hab"):
        env: Any = make(**options("024_bowl", profile=profile))
        env.reset(seed=0)
        turned = env.get_state(0)
        at = np.asarray(env.sim.addresses.robot_q)[column]
        turned["sim"]["qpos"][at] += 4 * math.pi
        env.set_state(0, turned)
        obs, *_ = env.step(np.zeros((2, 13), np.float32))
        q = float(env.state.robot_q[0, column])
        assert q > 4 * math.pi - 1.0
        seen[profile] = float(obs["agent/qpos"][0, column - 3]) - q
        env.close()
    assert seen["mjhab"] == pytest.approx(-4 * math.pi, abs=1e-5)
    assert seen["ms_hab"] == pytest.approx(0.0, abs=1e-5)


@pytest.mark.parametrize("profile", ["mjhab", "ms_hab"])
def test_the_expert_goes_to_a_rest_that_counts(profile: str) -> None:
    column = ROBOT.joints.index("wrist_roll_joint")
    env: Any = make(**options("024_bowl", profile=profile))
    env.reset(seed=0)
    turned = env.get_state(0)
    at = np.asarray(env.sim.addresses.robot_q)[column]
    turned["sim"]["qpos"][at] = ROBOT.rest[column] + 2 * math.pi
    env.set_state(0, turned)
    goal = rest_goal(env.view(0))[column]
    turns = 1 if profile == "mjhab" else 0
    assert goal == pytest.approx(ROBOT.rest[column] + 2 * math.pi * turns)
    env.close()
