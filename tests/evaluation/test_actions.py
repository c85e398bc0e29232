"""Recorded actions as those of other control modes: they command the same positions, whatever the state."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import mjhab
from mjhab.evaluation.datasets import actions
from mjhab.evaluation.datasets.actions import (
    ConvertedReplay,
    _as_deltas,
    _in_mode,
    replay_converted,
)
from mjhab.evaluation.datasets.specs import ReplaySpec
from mjhab.robots.controllers import make_controller
from mjhab.robots.fetch.robot import ROBOT
from tests.refusals import command

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
    moves = random.uniform(-0.1, 0.1, (COUNT, 13)).astype(np.float32)
    recorded = make_controller("pd_joint_delta_pos", COUNT).command(moves, q)
    other = make_controller(mode, COUNT)
    other.reset(np.ones(COUNT, bool), _State(q))
    changed = _in_mode(other, moves, q)
    assert changed.dtype == np.float32 and changed.shape == (COUNT, other.dim)
    commanded = other.command(changed, q)
    arm = list(ROBOT.arm_columns)
    assert np.abs(commanded[:, arm] - recorded[:, arm]).max() < joints
    here, _ = ROBOT.arm_chain.tip_pose(commanded[:, arm])
    there, _ = ROBOT.arm_chain.tip_pose(recorded[:, arm])
    assert np.linalg.norm(here - there, axis=1).max() < most_m
    rest = [column for column in range(len(ROBOT.joints)) if column not in arm]
    np.testing.assert_array_equal(commanded[:, rest], recorded[:, rest])


@pytest.mark.parametrize("mode", ["pd_ee_target_delta_pose", "pd_ee_delta_pose"])
def test_actions_of_the_hand_become_deltas_of_joints(mode: str) -> None:
    """What they command, also where a command depends on the one before; intended actions change no memory."""
    random = np.random.default_rng(2)
    steps = 12
    moves = random.uniform(-0.06, 0.06, (steps, 12)).astype(np.float32)
    source = make_controller(mode, 1)
    q = np.tile(ROBOT.rest, (steps, 1))
    wanted = np.empty_like(q)
    source.reset(np.ones(1, bool), _State(q[:1]))
    for t in range(steps):
        wanted[t] = source.command(moves[t][None].astype(float), q[t][None])[0]
        if t + 1 < steps:
            # Servos lag behind.
            q[t + 1] += 0.7 * (wanted[t] - q[t])
    executed, intended = _as_deltas(
        make_controller(mode, 1), (moves, np.zeros_like(moves)), q, np.zeros(steps, bool)
    )
    arm = list(ROBOT.arm_columns)
    commanded = make_controller("pd_joint_delta_pos", steps).command(executed, q)
    np.testing.assert_allclose(commanded[:, arm], wanted[:, arm], atol=1e-6)
    np.testing.assert_array_equal(executed[:, len(arm) :], moves[:, 6:])
    assert not intended[:, len(arm) :].any()
    assert np.abs(intended - executed)[:, : len(arm)].max() > 0.01


def test_converted_actions_are_replayed_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = mjhab.generate(
        "zero",
        home="builtin_m0_00",
        subtask="close",
        episodes=2,
        horizon=4,
        num_envs=2,
        threads=1,
        out=tmp_path / "set",
    )
    found = replay_converted(
        ReplaySpec.of(made.path, verify=True, actions="pd_joint_pos", worlds=2)
    )
    assert found == ConvertedReplay(2, 0, 0, 0)
    monkeypatch.setattr(
        actions, "_succeed", lambda env, batch, mode: [e.record.index > 0 for e in batch]
    )
    assert (
        command("replay", made.path, "--verify", "--actions", "pd_ee_pose", "--json") == 0
    )
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told == {
        "actions": "pd_ee_pose",
        "episodes": 2,
        "recorded": 0,
        "replayed": 1,
        "both": 0,
    }


class _State:
    def __init__(self, q: np.ndarray) -> None:
        self.robot_q = q
