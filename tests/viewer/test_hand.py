from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjhab.viewer.sources.hand import (
    BUTTONS,
    GRIPPER_BUTTON,
    GRIPPER_KEY,
    KEYS,
    MOTIONS,
    SILENCE_SECONDS,
    HandControl,
    HandInput,
    read_input,
)
from tests.refusals import refused

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
    assert {motion for motion, _ in (*KEYS.values(), *BUTTONS.values())} <= set(MOTIONS)


@given(
    st.text(max_size=60)
    | st.recursive(st.none() | st.floats() | st.text(max_size=5), st.lists)
)
def test_no_message_breaks_it(value: Any) -> None:
    hand = HandControl()
    hand.hear(value if isinstance(value, str) else json.dumps(value))
    hand.hear(json.dumps({"keys": value, "axes": value, "buttons": [value]}))


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
