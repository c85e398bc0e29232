from __future__ import annotations

import asyncio
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks import teleop
from mjhab.core.action_notes import HUMAN
from mjhab.core.rotations import quat_mul
from mjhab.data.select.interventions import intervention_steps
from mjhab.data.store.places import episodes
from mjhab.data.store.shard import ShardWriter
from mjhab.viewer.drawn.handle import PoseHandle
from mjhab.viewer.sources.hand import SILENCE_SECONDS, HandControl, tcp_in_arm_frame
from mjhab.viewer.sources.hand_input import (
    BUTTONS,
    GRIPPER_BUTTON,
    GRIPPER_KEY,
    HOLD_BUTTONS,
    HOLD_KEY,
    KEYS,
    MOTIONS,
    HandInput,
    read_input,
)
from tests.refusals import refused

_HAND = HandControl()
SETTLING_STEPS = 10
"""Episodes begin with a posture that is not at rest."""


def keys(*held: str) -> str:
    return json.dumps({"keys": list(held), "axes": [], "buttons": []})


def test_keys_and_sticks_say_the_same() -> None:
    assert read_input(keys("KeyW")) == HandInput({"forward": 1.0})
    assert read_input(keys("KeyW", "KeyS")) == HandInput()
    pad = json.dumps({"keys": [], "axes": [0.0, -1.0], "buttons": []})
    assert read_input(pad) == HandInput({"forward": 1.0})
    resting = json.dumps(
        {"keys": [], "axes": [0.05, -0.1, 0.1, 0.0], "buttons": [0] * 17}
    )
    assert read_input(resting) == HandInput()
    buttons = [0.0] * 17
    buttons[7] = 0.5
    buttons[GRIPPER_BUTTON] = 1.0
    told = read_input(json.dumps({"keys": [], "axes": [], "buttons": buttons}))
    assert told == HandInput({"z": 0.5}, gripper=True)
    buttons[HOLD_BUTTONS[1]] = 1.0
    told = read_input(json.dumps({"keys": [HOLD_KEY], "axes": [], "buttons": []}))
    assert told == HandInput(hold=True)
    told = read_input(json.dumps({"keys": [], "axes": [], "buttons": buttons}))
    assert told == HandInput({"z": 0.5}, gripper=True, hold=True)
    assert {motion for motion, _ in (*KEYS.values(), *BUTTONS.values())} <= set(MOTIONS)


@settings(deadline=None)
@given(
    st.text(max_size=60)
    | st.recursive(st.none() | st.floats() | st.text(max_size=5), st.lists)
)
def test_no_message_breaks_it(value: Any) -> None:
    _HAND.hear(value if isinstance(value, str) else json.dumps(value))
    _HAND.hear(json.dumps({"keys": value, "axes": value, "buttons": [value]}))


def test_a_number_without_end_lets_go() -> None:
    hand = HandControl()
    hand.hear(keys("KeyW"))
    hand.hear('{"axes": [1' + "0" * 400 + "]}")
    assert hand._input == HandInput()


@pytest.fixture(scope="module")
def running() -> Any:
    import mjhab

    made = mjhab.make(subtask="pick", autoreset="disabled", threads=1)
    yield made
    made.close()


def drive(env: Any, *held: str, steps: int = 15) -> tuple[np.ndarray, np.ndarray]:
    """Positions (3,) of gripper and base, in the frame of the base at the start, after and before."""
    env.reset(seed=0, options={"episode": [0]})
    hand = HandControl()
    hand.begin(env, 0)
    view = env.view(0)
    for _ in range(SETTLING_STEPS):
        env.step(hand.action(env, 0)[None])
    start, base = view.tcp_pose[:3], view.q[:3]
    for _ in range(steps):
        hand.hear(keys(*held))
        env.step(hand.action(env, 0)[None])
    turn = np.array(
        [[np.cos(base[2]), np.sin(base[2])], [-np.sin(base[2]), np.cos(base[2])]]
    )
    moved = view.tcp_pose[:3] - start
    return np.append(turn @ moved[:2], moved[2]), np.append(
        turn @ (view.q[:2] - base[:2]), view.q[2] - base[2]
    )


def test_nothing_held_stands_still(running: Any) -> None:
    hand, base = drive(running)
    assert np.abs(hand).max() < 0.005 and np.abs(base).max() < 0.005


@pytest.mark.parametrize(
    ("key", "axis", "sign"), [("KeyS", 0, -1), ("KeyA", 2, 1), ("KeyD", 2, -1)]
)
def test_the_base_goes_where_the_keys_say(
    running: Any, key: str, axis: int, sign: int
) -> None:
    _, base = drive(running, key)
    assert sign * base[axis] > 0.1


@pytest.mark.parametrize(
    ("key", "axis", "sign"),
    [("KeyI", 0, 1), ("KeyJ", 1, 1), ("KeyL", 1, -1), ("KeyU", 2, 1)],
)
def test_the_gripper_goes_where_the_keys_say(
    running: Any, key: str, axis: int, sign: int
) -> None:
    hand, base = drive(running, key, steps=6)
    assert sign * hand[axis] > 0.03
    others = np.delete(hand, axis)
    assert np.abs(others).max() < 0.5 * abs(hand[axis])
    assert np.abs(base).max() < 0.01


def test_the_gripper_opens_and_closes_in_turn(running: Any) -> None:
    running.reset(seed=0, options={"episode": [0]})
    hand = HandControl()
    hand.begin(running, 0)
    column = running.controller.gripper
    seen = [hand.action(running, 0)[column]]
    for held in ((GRIPPER_KEY,), (GRIPPER_KEY,), (), (GRIPPER_KEY,)):
        hand.hear(keys(*held))
        seen.append(hand.action(running, 0)[column])
    assert seen == [1.0, -1.0, -1.0, -1.0, 1.0]


def test_the_gripper_goes_to_a_pose(running: Any) -> None:
    running.reset(seed=0, options={"episode": [0]})
    robot = running.layout.robot
    view = running.view(0)
    hand = HandControl()
    hand.begin(running, 0)
    goal = hand.pose
    np.testing.assert_allclose(
        tcp_in_arm_frame(robot, view.q, view.tcp_pose), goal, atol=1e-4
    )
    goal[:3] += (-0.08, 0.0, -0.08)
    goal[3:] = quat_mul(np.array([np.cos(0.1), 0.0, np.sin(0.1), 0.0]), goal[3:])
    # Any length of the quaternion is taken.
    hand.aim(goal * np.repeat([1.0, 2.0], [3, 4]))
    for _ in range(25):
        before = hand.pose
        action = hand.action(running, 0)
        running.step(action[None])
        np.testing.assert_array_equal(hand.pose, before)
    there = tcp_in_arm_frame(robot, view.q, view.tcp_pose)
    np.testing.assert_allclose(there, goal, atol=3e-3)
    # A key ends it.
    hand.hear(keys("KeyU"))
    hand.action(running, 0)
    assert 0.005 < hand.pose[2] - goal[2] < 0.02


def test_a_pose_out_of_reach_commands_no_more_than_actions_reach(running: Any) -> None:
    running.reset(seed=0, options={"episode": [0]})
    robot = running.layout.robot
    arm = list(robot.arm_columns)
    hand = HandControl()
    hand.begin(running, 0)
    goal = hand.pose
    goal[:3] += (3.0, -2.0, 1.0)
    hand.aim(goal)
    saturated = 0
    for _ in range(25):
        q = running.state.robot_q[0, arm]
        action = hand.action(running, 0)
        commanded = hand._arm.get_state(0)["arm_target"]
        # Nothing is clipped: what is executed is what was commanded.
        wanted = q + robot.limits.joint_delta * action[: len(arm)]
        np.testing.assert_allclose(commanded, wanted, atol=1e-6)
        assert (np.array(commanded) >= hand._arm._arm.low - 1e-9).all()
        saturated += np.abs(action[: len(arm)]).max() > 0.999
        running.step(action[None])
    assert saturated


def test_a_key_brings_the_arm_to_rest(running: Any) -> None:
    """And no action is larger than what is executed; then the gripper stays there."""
    running.reset(seed=0, options={"episode": [0]})
    robot = running.layout.robot
    arm = list(robot.arm_columns)
    hand = HandControl()
    hand.begin(running, 0)
    goal = hand.pose
    goal[:3] += (0.1, -0.2, 0.1)
    hand.aim(goal)
    for _ in range(15):
        running.step(hand.action(running, 0)[None])

    def away() -> float:
        return float(np.abs(running.state.robot_q[0, arm] - robot.rest[arm]).max())

    assert away() > 0.3
    for _ in range(40):
        hand.hear(keys("KeyV"))
        q = running.state.robot_q[0, arm]
        action = hand.action(running, 0)
        wanted = q + robot.limits.joint_delta * action[: len(arm)]
        np.testing.assert_allclose(
            hand._arm.get_state(0)["arm_target"], wanted, atol=1e-6
        )
        running.step(action[None])
    assert away() < 0.02
    hand.hear(keys())
    for _ in range(5):
        running.step(hand.action(running, 0)[None])
    assert away() < 0.02


@pytest.mark.parametrize(
    "pose", [np.zeros(6), np.zeros(7), np.full(7, np.nan), np.ones((1, 7))]
)
def test_what_is_no_pose_is_refused(pose: np.ndarray) -> None:
    with refused("pose", expected="finite"):
        HandControl().aim(pose)


def test_the_handle_tells_poses_in_the_frame_of_the_arm() -> None:
    told: list[np.ndarray] = []
    gizmo = SimpleNamespace(position=np.zeros(3), wxyz=np.zeros(4), visible=False)
    gizmo.on_update = lambda call: setattr(gizmo, "call", call)
    scene: Any = SimpleNamespace(add_transform_controls=lambda *_, **__: gizmo)
    handle = PoseHandle(scene, told.append)
    # The arm's frame is turned by a quarter about z.
    root = np.array([1.0, 2.0, 0.5, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
    pose = np.array([0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    handle.show(root, pose)
    assert gizmo.visible
    np.testing.assert_allclose(gizmo.position, [1.0, 2.5, 0.5], atol=1e-9)
    gizmo.position = np.array([1.0, 2.7, 0.6])
    asyncio.run(gizmo.call(SimpleNamespace(phase="update")))
    np.testing.assert_allclose(told[-1], [0.7, 0.0, 0.1, 1, 0, 0, 0], atol=1e-9)
    # Who drags it is not disturbed; afterwards it goes along with the robot.
    handle.show(root, pose)
    assert gizmo.position[1] == 2.7
    asyncio.run(gizmo.call(SimpleNamespace(phase="end")))
    handle.show(root, pose)
    assert gizmo.position[1] == 2.5
    handle.show(root, None)
    asyncio.run(gizmo.call(SimpleNamespace(phase="update")))
    assert not gizmo.visible and len(told) == 2


def test_a_scripted_person_drives_a_demonstration_that_replays(
    running: Any, tmp_path: Path
) -> None:
    with ShardWriter(tmp_path / "a.h5") as writer:
        shown, driven = teleop.drive(running, 0, 0, writer)
    assert shown and driven
    (episode,) = episodes(tmp_path / "a.h5")
    assert episode.run.policy == HUMAN
    assert {episode.actors[number] for number in episode.array("actor")} == {HUMAN}
    assert not intervention_steps(episode).any()
    assert teleop.replayed(running, episode)


def test_silence_lets_go(running: Any) -> None:
    running.reset(seed=0, options={"episode": [0]})
    now = [0.0]
    hand = HandControl(clock=lambda: now[0])
    hand.begin(running, 0)
    hand.hear(keys("KeyW"))
    names = [entry.name for entry in running.action_table]
    forward = names.index("base_forward")
    assert hand.action(running, 0)[forward] > 0.5
    now[0] += SILENCE_SECONDS
    assert hand.action(running, 0)[forward] == 0.0


def test_other_control_modes_are_refused() -> None:
    import mjhab

    env: Any = mjhab.make(
        subtask="pick", control_mode="pd_ee_delta_pose", autoreset="disabled", threads=1
    )
    env.reset(seed=0)
    with refused("control_mode", "pd_ee_delta_pose", expected="by hand"):
        HandControl().begin(env, 0)
    env.close()
