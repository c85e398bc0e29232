"""Commands of absolute positions to joints that were turned round: the shortest way, or back, as the original does."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mjhab.robots.controllers import make_controller
from mjhab.robots.fetch.robot import ROBOT

TURN = 2 * math.pi


@pytest.mark.parametrize("mode", ["pd_joint_pos", "pd_joint_pos_vel"])
def test_a_position_is_reached_by_the_shortest_turn(mode: str) -> None:
    wrist = ROBOT.joints.index("wrist_roll_joint")
    elbow = ROBOT.joints.index("elbow_flex_joint")
    at = ROBOT.arm_columns.index(wrist)
    controller = make_controller(mode)
    q = ROBOT.rest[None].copy()
    q[0, wrist] = 3.0 + TURN
    action = np.zeros((1, controller.dim), np.float32)
    action[0, at] = -3.0
    action[0, ROBOT.arm_columns.index(elbow)] = 1.0
    assert controller.command(action, q)[0, wrist] == pytest.approx(-3.0)
    controller.shortest = True
    aims = controller.command(action, q)
    assert aims[0, wrist] == pytest.approx(-3.0 + 2 * TURN, abs=1e-6)
    assert aims[0, elbow] == pytest.approx(1.0)


@pytest.mark.parametrize("mode", ["pd_joint_delta_pos", "pd_joint_vel", "pd_joint_pos"])
def test_holding_still_keeps_a_turned_joint_where_it_is(mode: str) -> None:
    wrist = ROBOT.joints.index("wrist_roll_joint")
    controller = make_controller(mode)
    controller.shortest = True
    q = ROBOT.rest[None].copy()
    q[0, wrist] = 1.0 + 2 * TURN

    class State:
        robot_q = q

    aims = controller.command(controller.still(State), q)  # type: ignore[arg-type]
    wanted = 0.0 if mode == "pd_joint_vel" else q[0, wrist]
    assert aims[0, wrist] == pytest.approx(wanted, abs=1e-6)
