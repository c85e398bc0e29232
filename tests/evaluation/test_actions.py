"""Recorded actions as those of other control modes: they command the same positions, whatever the state."""

from __future__ import annotations

import numpy as np
import pytest

from mjhab.evaluation.datasets.actions import _in_mode
from mjhab.robots.controllers import make_controller
from mjhab.robots.fetch.robot import ROBOT

COUNT = 40


def poses(random: np.random.Generator) -> np.ndarray:
    """Joint positions (N, J) around the rest posture, away from the stops of the joints."""
    drawn = ROBOT.rest + random.uniform(-0.3, 0.3, (COUNT, len(ROBOT.rest)))
    low, high = np.array(ROBOT.joint_limits).T
    free = ~np.isfinite(low)
    low[free] = drawn.min(axis=0)[free]
    high[free] = drawn.max(axis=0)[free]
    middle = (low + high) / 2
    return middle + 0.7 * (np.clip(drawn, low, high) - middle)


@pytest.mark.parametrize(
    ("mode", "joints", "most_m"),
    [
        ("pd_joint_pos", 1e-6, 1e-6),
        ("pd_ee_delta_pose", np.inf, 2e-3),
        ("pd_ee_pose", np.inf, 2e-3),
    ],
)
def test_converted_actions_command_the_same(
    mode: str, joints: float, most_m: float
) -> None:
    random = np.random.default_rng(1)
    q = poses(random)
    # A small part of the range: turns of many joints together exceed what an end-effector mode does in a control step.
    actions = random.uniform(-0.1, 0.1, (COUNT, 13)).astype(np.float32)
    recorded = make_controller("pd_joint_delta_pos", COUNT).command(actions, q)
    other = make_controller(mode, COUNT)
    other.reset(np.ones(COUNT, bool), _State(q))
    changed = _in_mode(other, actions, q)
    assert changed.dtype == np.float32 and changed.shape == (COUNT, other.dim)
    commanded = other.command(changed, q)
    arm = list(ROBOT.arm_columns)
    assert np.abs(commanded[:, arm] - recorded[:, arm]).max() < joints
    here, _ = ROBOT.arm_chain.tip_pose(commanded[:, arm])
    there, _ = ROBOT.arm_chain.tip_pose(recorded[:, arm])
    assert np.linalg.norm(here - there, axis=1).max() < most_m
    rest = [column for column in range(len(ROBOT.joints)) if column not in arm]
    np.testing.assert_array_equal(commanded[:, rest], recorded[:, rest])


class _State:
    def __init__(self, q: np.ndarray) -> None:
        self.robot_q = q
