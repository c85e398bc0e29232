"""The Rewarder: what it gathers from the simulator's arrays, its modes and its memory."""

from __future__ import annotations

import dataclasses
from math import tanh
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mjhab.envs.parts.rewarding import (
    GoalDistance,
    Rewarder,
    RewardInputs,
    RewardRules,
    straight_distance,
)
from mjhab.robots.fetch.model import REST_QPOS
from mjhab.robots.fetch.robot import ROBOT
from mjhab.tasks.measure import active_entries, measure
from mjhab.tasks.plan import Subtask, SubtaskKind, TaskPlan, stack_plans
from mjhab.tasks.progress import start
from mjhab.tasks.scoring import RewardOptions
from tests.refusals import refused
from tests.tasks.build import config_of, resting, squeeze

PICK, PLACE, NAVIGATE, OPEN, CLOSE = range(5)
CONFIG = config_of(REST_QPOS)
GOAL = (1.0, 0.0, 0.5)
HANDLE = np.array([0.5, 0.4, 1.27])
"""0.4 m from the tool centre at rest."""
LAYOUT: Any = SimpleNamespace(
    robot=ROBOT,
    links=[
        SimpleNamespace(link=SimpleNamespace(joint="hinge")),
        SimpleNamespace(link=SimpleNamespace(joint="slide")),
    ],
)
SENSING: Any = SimpleNamespace(
    handle_pos=lambda state, world, link: state.handles[world, link]
)


def inputs_of(kinds: list[int], link: int = 1, **over: Any) -> RewardInputs:
    """Worlds that do one subtask each about object 1 of 3 and link 1 of 2 (a drawer), the robot at rest."""
    w = len(kinds)
    link_name = ("fridge/top_door", "kitchen_counter/drawer3")[link]
    plan = stack_plans(
        [
            TaskPlan("t", (Subtask(SubtaskKind(k), "bowl", link_name, GOAL),))
            for k in kinds
        ],
        CONFIG,
        doors={"fridge/top_door"},
    )
    state: dict[str, Any] = {
        "object_pose": np.zeros((w, 3, 7)),
        "object_vel": np.zeros((w, 3, 6)),
        "tcp_vel": np.zeros((w, 3)),
        "link_qd": np.zeros((w, 2)),
        "handles": np.full((w, 2, 3), 9.0),
    }
    state["object_pose"][:, 1, :3] = over.pop("obj", (0.5, 0.3, 1.27))
    state["handles"][:, link] = over.pop("handle", HANDLE)
    for name in set(over) & set(state):
        state[name] = np.broadcast_to(
            np.asarray(over.pop(name), float), state[name].shape
        )
    world = resting(
        1, w, REST_QPOS, **{"plan_obj_pos": state["object_pose"][:, 1:2, :3], **over}
    )
    progress = start(plan, CONFIG)
    active = active_entries(plan, progress.pointer, CONFIG)
    signals = measure(world, plan, progress, CONFIG, active)
    focus: Any = SimpleNamespace(
        kind=active.kind, obj=np.full(w, 1), link=np.full(w, link), active=active
    )
    sim: Any = SimpleNamespace(**state)
    return RewardInputs(sim, world, signals, focus, progress)


def rewarder(worlds: int, mode: str = "dense", **more: Any) -> Rewarder:
    return Rewarder(worlds, RewardRules(CONFIG, mode, **more), LAYOUT, SENSING)


def step(
    kind: int, way: GoalDistance = straight_distance, **over: Any
) -> dict[str, float]:
    made = rewarder(1, nav_distance=way)
    inputs = inputs_of([kind], **over)
    made.begin(np.array([True]), inputs)
    reward, terms = made.step(inputs)
    assert reward.dtype == np.float64
    assert reward[0] == pytest.approx(sum(t[0] for t in terms.values()))
    return {name: float(t[0]) for name, t in terms.items()}


def test_it_looks_at_the_object_in_focus() -> None:
    found = step(PICK, tcp_vel=(0.0, 3.0, 4.0))
    assert found["reach"] == pytest.approx(5 * (1 - tanh(0.9)))
    assert found["slow_hand"] == pytest.approx(1 - tanh(1.0))
    moving = np.zeros((1, 3, 6))
    moving[0, 1] = [0.0, 0.6, 0.8, 0.0, 0.0, 1.5]
    moving[0, 2] = 100.0
    found = step(PLACE, object_vel=moving)
    assert found["slow_object"] == pytest.approx(3 * (1 - tanh(2.5 / 5)))
    away = np.hypot(0.5, np.hypot(0.3, 0.77)), np.hypot(0.5, 0.77)
    assert found["transport"] == pytest.approx(
        6 * (1 - (tanh(away[0]) + tanh(away[1])) / 2)
    )


@pytest.mark.parametrize(("link", "ideal"), [(0, 2.0), (1, 1.0)])
def test_it_looks_at_the_handle_and_the_speed_of_the_link_in_focus(
    link: int, ideal: float
) -> None:
    speed = np.full((1, 2), 9.0)
    speed[0, link] = -ideal
    found = step(OPEN, link=link, link_qd=speed)
    assert found["reach"] == pytest.approx(3 * (1 - tanh(0.4))) and found["gentle"] == 3.0
    assert step(CLOSE, link=link, link_qd=speed)["gentle"] == 5.0
    assert step(OPEN, link=link, link_qd=speed * 1.01)["gentle"] == 0.0


def test_the_way_to_a_goal_is_straight_unless_told_otherwise() -> None:
    base: dict[str, Any] = {"base_pose": [-2.0, 4.0, 0.0], "tcp_pos": [-1.5, 4.0, 1.27]}
    assert step(NAVIGATE, **base)["approach"] == pytest.approx(8 * (1 - tanh(0.5)))
    assert step(NAVIGATE, lambda _: np.array([7.0]), **base)["approach"] == pytest.approx(
        8 * (1 - tanh(0.7))
    )
    assert step(NAVIGATE, lambda _: np.array([np.inf]), **base)["approach"] == 0.0


def test_only_navigation_asks_for_the_way() -> None:
    asked = []

    def way(inputs: RewardInputs) -> np.ndarray:
        asked.append(len(inputs.focus.kind))
        return np.where(inputs.focus.kind == NAVIGATE, 3.0, np.nan)

    rewarder(2, nav_distance=way).step(inputs_of([PICK, OPEN]))
    assert not asked
    reward, terms = rewarder(5, nav_distance=way).step(
        inputs_of([PICK, PLACE, NAVIGATE, OPEN, CLOSE])
    )
    assert (
        asked == [5]
        and np.isfinite(reward).all()
        and all(np.isfinite(t).all() for t in terms.values())
    )


def test_modes() -> None:
    inputs = inputs_of(
        [PICK, PICK],
        finger_force=squeeze(),
        obj=(0.5, 0.0, 1.27),
        robot_qd=np.zeros((2, 15)),
    )
    moved = dataclasses.replace(
        inputs,
        signals=dataclasses.replace(inputs.signals, success=np.array([True, False])),
    )
    dense, terms = rewarder(2).step(moved)
    assert dense == pytest.approx([29.0, 26.0]) and terms["success"].tolist() == [
        3.0,
        0.0,
    ]
    normalized, same = rewarder(2, "normalized_dense").step(moved)
    assert normalized == pytest.approx([1.0, 26 / 29])
    np.testing.assert_array_equal(list(same.values()), list(terms.values()))
    for mode, want in (
        ("sparse", [1.0, 0.0]),
        ("none", [0.0, 0.0]),
        ("pointer", [0.0, 0.0]),
    ):
        reward, nothing = rewarder(2, mode).step(moved)
        assert reward.dtype == np.float64 and reward.tolist() == want and nothing == {}
    with refused("reward mode", "normalised_dense", expected="normalized_dense"):
        rewarder(1, "normalised_dense")
    with refused("reward term of pick", "reech", expected="reach"):
        rewarder(1, options=RewardOptions({"pick": {"reech": 1.0}}))


def test_the_real_torso_reaches_the_normaliser_almost() -> None:
    # The torso rests at 0.386 m of 0.386 15, so posture and height are never both at their best.
    top = ROBOT.joint_limits[ROBOT.joints.index("torso_lift_joint")][1]
    lost = 2 * (1 - REST_QPOS[3] / top)
    reward, _ = rewarder(1).step(inputs_of([PLACE], obj=GOAL))
    assert reward[0] == pytest.approx(44 - lost) and lost < 0.001
    above = np.array(REST_QPOS)
    above[3] = top + 0.01
    assert (
        rewarder(1).step(inputs_of([PLACE], obj=GOAL, robot_q=above))[1]["torso_up"][0]
        == 2.0
    )


def test_the_torso_is_not_clipped_where_published() -> None:
    top = ROBOT.joint_limits[ROBOT.joints.index("torso_lift_joint")][1]
    above = np.array(REST_QPOS)
    above[3] = top + 0.01
    made = rewarder(1, options=RewardOptions(formula="published"))
    assert made.step(inputs_of([PLACE], obj=GOAL, robot_q=above))[1]["torso_up"][
        0
    ] == pytest.approx(2 * (1 + 0.01 / top))


@pytest.mark.parametrize(
    ("kind", "scale"),
    [(PLACE, 2.0), (OPEN, 1.0), (CLOSE, 1.0)],
    ids=["place", "open", "close"],
)
@pytest.mark.parametrize("below", [0.0, 0.001, 0.0075])
def test_a_torso_below_its_travel_earns_as_in_the_original(
    kind: int, scale: float, below: float
) -> None:
    """mshab/envs/{place,open,close}.py take the absolute value of the torso's share of its travel."""
    top = ROBOT.joint_limits[ROBOT.joints.index("torso_lift_joint")][1]
    sunk = np.array(REST_QPOS)
    sunk[3] = -below
    made = rewarder(1, options=RewardOptions(formula="published"))
    joint = {OPEN: 0.47, CLOSE: 0.0}.get(kind, 0.4)
    at = inputs_of([kind], obj=GOAL, robot_q=sunk, joint_q=joint, handle=(0.5, 0.2, 1.27))
    earned = made.step(at)[1]["torso_up"][0]
    assert earned == pytest.approx(scale * below / top)
    clipped = rewarder(1).step(at)[1]["torso_up"][0]
    assert clipped == 0.0


def test_closing_at_the_handle_is_remembered_until_the_world_begins_anew() -> None:
    at_handle, away = (
        inputs_of([CLOSE] * 3, joint_q=0.0, handle=at)
        for at in ((0.5, 0.2, 1.27), HANDLE)
    )
    made = rewarder(3)
    made.begin(np.ones(3, bool), away)
    assert not made.step(away)[1]["closed"].any()
    assert made.step(at_handle)[1]["closed"].tolist() == [8.0] * 3
    made.begin(np.array([False, True, False]), away)
    assert made.step(away)[1]["closed"].tolist() == [8.0, 0.0, 8.0]
    # Its state goes from world to world.
    saved = made.get_state(0), made.get_state(1)
    made.set_state(0, saved[1])
    made.set_state(1, saved[0])
    assert made.step(away)[1]["closed"].tolist() == [0.0, 8.0, 8.0]
    assert (
        made.step(inputs_of([CLOSE] * 3, joint_q=0.4))[1]["closed"].tolist() == [0.0] * 3
    )


def test_results_outlive_the_next_step() -> None:
    made = rewarder(1)
    reward, terms = made.step(inputs_of([PICK]))
    kept = reward.copy(), {name: value.copy() for name, value in terms.items()}
    made.step(inputs_of([PICK], obj=GOAL))
    np.testing.assert_array_equal(reward, kept[0])
    np.testing.assert_array_equal(list(terms.values()), list(kept[1].values()))


def test_only_the_kinds_at_hand_are_reported() -> None:
    _, terms = rewarder(1, kinds=("close",)).step(inputs_of([CLOSE]))
    assert "posture_closed" in terms and "hold" not in terms
    assert {"posture_closed", "hold", "arrived"} <= set(
        rewarder(1).step(inputs_of([CLOSE]))[1]
    )
