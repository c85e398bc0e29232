"""The control mode of `examples/control_mode.py`: its bound holds, with numpy and torch, and an environment uses it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

import mjhab
from mjhab.core.registration.plugins import load_plugin
from mjhab.robots.controllers import CONTROL_MODES, make_controller
from mjhab.robots.controllers.arm import ArmRequest
from mjhab.robots.parts import ActionLimits
from mjhab.robots.registry import robot_named
from tests.refusals import refused

EXAMPLE = Path(__file__).parents[2] / "examples" / "control_mode.py"
MODE = "pd_joint_pos_smooth"


@pytest.fixture(autouse=True)
def smooth() -> Iterator[None]:
    plugin = load_plugin(EXAMPLE)
    assert plugin.error == ""
    assert plugin.registered == (f"control mode {MODE!r}",)
    yield
    CONTROL_MODES.remove(MODE)


def test_the_servos_follow_by_bounded_steps_with_numpy_and_torch() -> None:
    robot = robot_named()
    size = ActionLimits().joint_delta
    begin = robot.rest[list(robot.arm_columns)][None]
    goal = begin + np.array([0.25])
    for like in (begin, torch.from_numpy(begin)):
        arm = CONTROL_MODES[MODE].arm(ArmRequest(robot, 1, ActionLimits(), like))
        arm.reset(like[:, 0] == like[:, 0], like)
        wanted = like + 0.25
        moved = [np.asarray(arm.command(wanted, like)) - begin for _ in range(4)]  # pyright: ignore
        for command, bound in zip(moved, (size, 2 * size, 0.25, 0.25), strict=True):
            np.testing.assert_allclose(command, bound)
        np.testing.assert_allclose(np.asarray(arm.target), goal)


def test_an_environment_moves_its_arm_by_it() -> None:
    env = mjhab.make(
        task="set_table", subtask="pick", control_mode=MODE, autoreset="disabled"
    )
    env.reset(seed=0)
    arm = list(env.controller.robot.arm_columns)
    begin = env.state.robot_q[:, arm].copy()
    action = env.controller.still(env.state)
    action[:, 0] += 0.5
    steps = []
    for _ in range(12):
        before = env.state.robot_q[:, arm[0]].copy()
        env.step(action)
        steps.append(float((env.state.robot_q[:, arm[0]] - before)[0]))
    assert max(steps) < 0.2
    assert env.state.robot_q[0, arm[0]] - begin[0, 0] == pytest.approx(0.5, abs=0.05)
    env.close()


def test_a_mode_that_cannot_work_is_told() -> None:
    with refused("control mode", "pd_joint_pos_smoth", expected="pd_joint_pos_smooth"):
        make_controller("pd_joint_pos_smoth")
    with refused("control mode", "pd_joint_pos", expected="mjhab itself"):
        mjhab.register_control_mode(
            mjhab.ControlMode("pd_joint_pos", CONTROL_MODES[MODE].make_arm)
        )
    with refused("make_arm", 3, where="control mode 'x'"):
        mjhab.ControlMode("x", 3)  # pyright: ignore[reportArgumentType]
    with refused("name of the control mode", ""):
        mjhab.ControlMode("", print)  # pyright: ignore[reportArgumentType]
    mjhab.register_control_mode(mjhab.ControlMode("x", lambda request: 3))  # pyright: ignore
    try:
        with refused("what make_arm returns", 3, where="control mode 'x'"):
            make_controller("x")
    finally:
        CONTROL_MODES.remove("x")
