"""Control modes: what each number means, what it does in simulation, what is remembered between steps."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from mjhab.robots.controllers import (
    BASES,
    CONTROL_MODES,
    STATIONARY,
    check_actions,
    make_controller,
)
from mjhab.robots.fetch.model import FETCH_JOINTS, REST_QPOS
from mjhab.robots.fetch.robot import ROBOT
from mjhab.robots.model import add_robot, apply_drives
from mjhab.robots.parts import Drives
from tests.refusals import refused
from tests.robots.controllers.robot_bench import (
    ARM,
    BENT,
    BODY,
    REMEMBERING,
    WORLDS,
    bench,
    layout,
    simulator,
    still_state,
)

ARM_DIMS = dict.fromkeys(CONTROL_MODES, 7) | {
    "pd_joint_pos_vel": 14,
    "pd_joint_delta_pos_vel": 14,
    "pd_ee_delta_pos": 3,
    "pd_ee_target_delta_pos": 3,
    "pd_ee_delta_pose": 6,
    "pd_ee_delta_pose_align": 6,
    "pd_ee_target_delta_pose": 6,
    "pd_ee_delta_pose_maniskill": 6,
    "pd_ee_target_delta_pose_maniskill": 6,
    "pd_ee_pose": 6,
}
ABSOLUTE = ("pd_joint_pos", "pd_joint_pos_vel", "pd_ee_pose")


def test_every_mode_of_the_original_is_there():
    assert set(CONTROL_MODES) == {
        "pd_joint_delta_pos",
        "pd_joint_pos",
        "pd_ee_delta_pos",
        "pd_ee_delta_pose",
        "pd_ee_delta_pose_align",
        "pd_joint_target_delta_pos",
        "pd_ee_target_delta_pos",
        "pd_ee_target_delta_pose",
        "pd_ee_delta_pose_maniskill",
        "pd_ee_target_delta_pose_maniskill",
        "pd_ee_pose",
        "pd_joint_vel",
        "pd_joint_pos_vel",
        "pd_joint_delta_pos_vel",
        "pd_joint_delta_pos_stiff_body",
    }


@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("mode", CONTROL_MODES)
def test_table_and_bounds_of_every_mode(mode: str, base: str):
    controller = make_controller(mode, 2, base=base)
    assert (
        controller.dim
        == len(controller.table)
        == ARM_DIMS[mode] + 4 + (3 if base == "holonomic" else 2)
    )
    assert (
        controller.gripper == ARM_DIMS[mode]
        and controller.table[controller.gripper].name == "gripper"
    )
    assert controller.low.shape == controller.high.shape == (controller.dim,)
    assert len({row.name for row in controller.table}) == controller.dim
    for row, low, high in zip(
        controller.table, controller.low, controller.high, strict=True
    ):
        assert (low, high) == (
            (-1, 1) if row.normalized else (np.float32(row.low), np.float32(row.high))
        )
        assert (
            math.isfinite(low)
            and low < high
            and row.unit in ("m", "rad", "m/s", "rad/s")
            and row.frame
        )
    arm = [row.normalized for row in controller.table[: controller.gripper]]
    assert arm == [mode not in ABSOLUTE] * len(arm)
    names = [row.name for row in controller.table[controller.gripper + 1 :]]
    moves = (
        ["base_forward", "base_left", "base_yaw"]
        if base == "holonomic"
        else ["base_forward", "base_yaw"]
    )
    assert names == ["head_pan_joint", "head_tilt_joint", "torso_lift_joint", *moves]


@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("mode", CONTROL_MODES)
def test_stationary_parts_keep_their_numbers_and_ignore_them(mode: str, base: str):
    state = still_state(3)
    actions = np.random.default_rng(0).uniform(
        -1, 1, (3, make_controller(mode, base=base).dim)
    )
    body = make_controller(mode).gripper + 1
    columns = {
        "head": [body, body + 1],
        "torso": [body + 2],
        "base": list(range(body + 3, actions.shape[1])),
    }
    for part in STATIONARY:
        controller = make_controller(mode, 3, base=base, stationary=(part,))
        free = make_controller(mode, 3, base=base)
        for c in (controller, free):
            c.reset(np.ones(3, bool), state)
        zeroed = actions.copy()
        zeroed[:, columns[part]] = free.still(state)[:, columns[part]]
        given = actions.copy()
        np.testing.assert_allclose(
            controller.ctrl(given, state), free.ctrl(zeroed, state), atol=1e-7
        )
        np.testing.assert_array_equal(given, actions)
        assert controller.dim == free.dim


def original_default_mode(actions: np.ndarray, q: np.ndarray) -> np.ndarray:
    """What ``pd_joint_delta_pos`` is, joint by joint."""
    a = np.clip(actions, -1.0, 1.0).astype(np.float64)
    out = np.empty((len(a), 15))
    for joint, column in zip(
        (*ROBOT.arm_columns, 4, 6, 3), (*range(7), 8, 9, 10), strict=True
    ):
        out[:, joint] = q[:, joint] + 0.1 * a[:, column]
    out[:, 13] = out[:, 14] = -0.01 + 0.5 * (a[:, 7] + 1.0) * (0.05 + 0.01)
    out[:, 0] = 1.0 * a[:, 11] * np.cos(q[:, 2])
    out[:, 1] = 1.0 * a[:, 11] * np.sin(q[:, 2])
    out[:, 2] = 3.14 * a[:, 12]
    return out


def test_default_mode_is_unchanged_in_every_bit():
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1.3, 1.3, (64, ROBOT.action.dim)).astype(np.float32)
    q = rng.normal(size=(64, 15))
    want = original_default_mode(actions, q)
    assert (
        make_controller("pd_joint_delta_pos", 64).command(actions, q).tobytes()
        == want.tobytes()
    )
    assert len(make_controller().table) == ROBOT.action.dim


def test_drives_change_only_what_they_name():
    spec = mujoco.MjSpec()
    add_robot(spec, ROBOT)
    plain = spec.compile()
    other = spec.compile()
    fields = ("actuator_gainprm", "actuator_biasprm", "jnt_actfrcrange")
    apply_drives(other, ROBOT, Drives())
    for field in fields:
        np.testing.assert_array_equal(getattr(plain, field), getattr(other, field))
    apply_drives(
        other, ROBOT, Drives(velocity=("elbow_flex_joint",), stiff=("torso_lift_joint",))
    )
    assert other.actuator("elbow_flex_joint").biasprm[:3].tolist() == [0.0, 0.0, -100.0]
    assert other.actuator("elbow_flex_joint").gainprm[0] == 100.0
    assert other.actuator("torso_lift_joint").biasprm[:3].tolist() == [0.0, -1e5, -1e5]
    assert other.jnt_actfrcrange[other.joint("torso_lift_joint").id].tolist() == [
        -1e5,
        1e5,
    ]
    rest = [
        i
        for i, name in enumerate(ROBOT.joints)
        if name not in ("elbow_flex_joint", "torso_lift_joint")
    ]
    np.testing.assert_array_equal(
        plain.actuator_biasprm[rest], other.actuator_biasprm[rest]
    )
    apply_drives(other, ROBOT, Drives())
    for field in fields:
        np.testing.assert_array_equal(getattr(plain, field), getattr(other, field))
    with refused("joint", "elbow_flex", expected="elbow_flex_joint"):
        apply_drives(other, ROBOT, Drives(velocity=("elbow_flex",)))


def test_servos_belong_to_one_simulator():
    speed = simulator(Drives(velocity=ROBOT.group("arm")))
    home = layout().pack.homes[0].name
    assert speed.model(home).actuator("wrist_roll_joint").biasprm[1] == 0.0
    assert (
        simulator(Drives()).model(home).actuator("wrist_roll_joint").biasprm[1] == -1000.0
    )


@pytest.mark.parametrize("mode", CONTROL_MODES)
def test_still_actions_keep_the_robot_where_it_is(mode: str):
    b = bench(mode, yaw=0.4)
    before = b.state.robot_q.copy()
    for _ in range(10):
        b.step(b.controller.still(b.state))
    np.testing.assert_allclose(b.state.robot_q[:, :13], before[:, :13], atol=2e-4)


@pytest.mark.parametrize("mode", [m for m in CONTROL_MODES if m.startswith("pd_joint")])
def test_each_arm_number_moves_its_joint_and_no_other(mode: str):
    b = bench(mode)
    begin = b.arm().copy()
    actions = b.controller.still(b.state)
    change = 0.2 if mode in ABSOLUTE else 0.5
    for world in range(7):
        actions[world, world] += change
    for _ in range(6):
        b.step(actions)
    moved = b.arm() - begin
    for world in range(7):
        assert moved[world, world] > 0.04
        assert np.abs(np.delete(moved[world], world)).max() < 0.2 * moved[world, world]
    np.testing.assert_allclose(moved[7], 0.0, atol=1e-3)


@pytest.mark.parametrize("mode", CONTROL_MODES)
def test_gripper_head_and_torso_follow_in_every_mode(mode: str):
    posture = BENT.copy()
    posture[3] = 0.2
    b = bench(mode, posture)
    actions = b.controller.still(b.state)
    first = b.controller.gripper
    stiff = "stiff" in mode
    actions[0, first] = 1.0
    actions[1, first] = -1.0
    for i in range(3):
        actions[2 + i, first + 1 + i] += 0.3 if stiff else 1.0
    if stiff:
        actions[4, first + 3] = 0.35
    begin = b.state.robot_q.copy()
    for _ in range(12):
        b.step(actions)
    q = b.state.robot_q
    np.testing.assert_allclose(q[0, 13:], 0.05, atol=0.003)
    np.testing.assert_allclose(q[1, 13:], 0.0, atol=0.003)
    for world, joint in zip((2, 3, 4), BODY, strict=True):
        assert q[world, joint] - begin[world, joint] > 0.05
        others = [j for j in BODY if j != joint]
        np.testing.assert_allclose(q[world, others], begin[world, others], atol=5e-3)


def test_stiff_body_reaches_its_target_and_holds_what_is_stationary():
    b = bench("pd_joint_delta_pos_stiff_body", stationary=("head",))
    actions = np.zeros((WORLDS, b.controller.dim))
    actions[:, 8:10] = 0.5
    actions[:, 10] = 0.1
    for _ in range(100):
        b.step(actions)
    np.testing.assert_allclose(b.state.robot_q[:, 3], 0.1, atol=0.01)
    np.testing.assert_allclose(
        b.state.robot_q[:, [4, 6]], BENT[[4, 6]] * np.ones((WORLDS, 1)), atol=1e-3
    )


@pytest.mark.parametrize(
    "mode", ["pd_joint_delta_pos", "pd_joint_vel", "pd_ee_target_delta_pose"]
)
def test_base_drives_forward_turns_and_strafes_in_its_own_frame(mode: str):
    yaw = 0.7
    b = bench(mode, yaw=yaw, base="holonomic")
    actions = b.controller.still(b.state)
    actions[0, -3] = actions[1, -2] = actions[2, -1] = 1.0
    actions[3, -3:-1] = (0.5, -0.5)
    for _ in range(20):
        b.step(actions)
    begin = b.state.robot_q[:, :3].copy()
    for _ in range(10):
        b.step(actions)
    speed = (b.state.robot_q[:, :3] - begin) / 0.5
    c = math.cos(yaw)
    s = math.sin(yaw)
    np.testing.assert_allclose(speed[0], [c, s, 0], atol=0.02)
    np.testing.assert_allclose(speed[1], [-s, c, 0], atol=0.02)
    assert speed[2, 2] == pytest.approx(3.14, abs=0.05)
    np.testing.assert_allclose(speed[3], [0.5 * (c + s), 0.5 * (s - c), 0], atol=0.02)
    np.testing.assert_allclose(speed[4], 0.0, atol=1e-3)


def test_forward_base_equals_the_holonomic_one_without_its_sideways_number():
    rng = np.random.default_rng(1)
    q = rng.normal(size=(5, 15))
    actions = rng.uniform(-1, 1, (5, 14))
    actions[:, 12] = 0.0
    both = make_controller(base="holonomic").command(actions, q)
    np.testing.assert_array_equal(
        both, make_controller().command(np.delete(actions, 12, axis=1), q)
    )


def test_velocity_mode_reaches_its_speed():
    b = bench("pd_joint_vel")
    actions = np.zeros((WORLDS, b.controller.dim))
    for world in range(7):
        actions[world, world] = 0.5
    for _ in range(8):
        b.step(actions)
    speed = b.state.robot_qd[:, ARM]
    np.testing.assert_allclose(np.diag(speed[:7]), 0.5, atol=0.03)
    np.testing.assert_allclose(speed[7], 0.0, atol=1e-3)


def lag_behind_a_ramp(mode: str, speed: float = 0.5) -> float:
    b = bench(mode)
    start = b.arm()[:, 3].copy()
    for k in range(20):
        actions = b.controller.still(b.state)
        actions[:, :7] = BENT[ARM]
        actions[:, 3] = start + speed * 0.05 * (k + 1)
        if mode == "pd_joint_pos_vel":
            actions[:, 7:14] = 0.0
            actions[:, 10] = speed
        b.step(actions)
    return float(np.abs(actions[:, 3] - b.arm()[:, 3]).max())


def test_speed_targets_remove_the_lag_of_position_servos():
    assert lag_behind_a_ramp("pd_joint_pos") > 0.025
    assert lag_behind_a_ramp("pd_joint_pos_vel") < 0.016


@pytest.mark.parametrize("mode", CONTROL_MODES)
def test_under_load_targets_hold_and_measured_positions_sag(mode: str):
    b = bench(mode)
    dof = b.sim.addresses.robot_v[ROBOT.arm_columns[1]]
    b.sim.batch.bind("qfrc_applied")[:, dof] = 20.0
    actions = b.controller.still(b.state)
    heights = []
    for step in range(40):
        b.step(actions)
        if step in (19, 39):
            heights.append(b.arm()[:, 1].copy())
    first = heights[0] - BENT[7]
    second = heights[1] - BENT[7]
    if mode in REMEMBERING[:4] or mode in ABSOLUTE:
        np.testing.assert_allclose(first, 0.02, atol=2e-3)
        np.testing.assert_allclose(second, first, atol=1e-4)
    else:
        assert (first > 0.04).all() and (second > 1.5 * first).all()


@pytest.mark.parametrize("mode", REMEMBERING)
def test_partial_reset_touches_no_other_world_and_state_makes_a_round_trip(mode: str):
    rng = np.random.default_rng(3)
    state = still_state(3)
    moved = still_state(3, np.array(REST_QPOS))
    controller = make_controller(mode, 3, stationary=("torso",))
    controller.reset(np.ones(3, bool), state)
    actions = rng.uniform(-1, 1, (3, controller.dim))
    for _ in range(3):
        controller.ctrl(actions, state)
    saved = [controller.get_state(w) for w in range(3)]
    controller.reset(np.array([False, True, False]), moved)
    after = [controller.get_state(w) for w in range(3)]
    for key in saved[0]:
        assert (after[0][key] == saved[0][key]).all() and (
            after[2][key] == saved[2][key]
        ).all()
        joints = ARM if key == "arm_target" else BODY
        np.testing.assert_array_equal(after[1][key], np.array(REST_QPOS)[joints])
    other = make_controller(mode, 3, stationary=("torso",))
    for w in range(3):
        other.set_state(w, after[w])
    assert (
        controller.ctrl(actions, state).tobytes() == other.ctrl(actions, state).tobytes()
    )


@pytest.mark.parametrize("mode", [m for m in CONTROL_MODES if m not in REMEMBERING])
def test_modes_without_targets_have_no_state(mode: str):
    controller = make_controller(mode, 2)
    assert controller.get_state(1) == {}
    controller.set_state(1, {})


def test_state_of_another_mode_is_refused():
    with refused("controller state", expected="arm_target"):
        make_controller("pd_ee_pose", 2).set_state(0, {"body_target": np.zeros(3)})
    with refused("controller state", expected="body_target"):
        make_controller("pd_joint_delta_pos_stiff_body", 2).set_state(
            0, {"body_target": np.zeros(7)}
        )


@pytest.mark.parametrize("value", [1e300, -1e39, np.nan])
def test_actions_that_float32_cannot_hold_are_refused(value: float) -> None:
    controller = make_controller()
    actions = np.zeros((2, controller.dim))
    actions[1, 3] = value
    with refused("actions", expected="finite", advice="in dimension 3"):
        check_actions(actions, controller.table, 2)


def test_unknown_names_say_what_is_nearest():
    with refused("control mode", "pd_joint_delta_poss", expected="pd_joint_delta_pos"):
        make_controller("pd_joint_delta_poss", 1)
    with refused("base control", "holonom", expected="holonomic"):
        make_controller(base="holonom")
    with refused("stationary part", "torsoo", expected="torso"):
        make_controller(stationary=("torsoo",))
    with refused("stationary", "head", expected="tuple of parts"):
        make_controller(stationary="head")


def test_joint_names_of_the_table_are_joints():
    for row in make_controller("pd_joint_pos", base="holonomic").table:
        assert row.joint in FETCH_JOINTS
