"""Dense rewards: hand-computed states for every kind and branch, the tables and their options."""

from __future__ import annotations

import math
from dataclasses import replace
from math import tanh
from typing import Any

import numpy as np
import pytest

from mjhab.tasks.rewards.table import RewardView, closed_near, near
from mjhab.tasks.scoring import DenseReward, RewardOptions, reward_table
from mjhab.tasks.subtasks.registry import SUBTASKS, number_of
from mjhab.tasks.thresholds import SubtaskConfig
from tests.refusals import refused
from tests.tasks.build import CONFIG, REST, squeeze
from tests.tasks.rewards.states import (
    AT_REST,
    CLOSE,
    FULL,
    GOAL,
    NAVIGATE,
    OPEN,
    PICK,
    PLACE,
    off,
    speeds,
    view_of,
)


def terms_of(view: RewardView, reward: DenseReward = FULL) -> dict[str, float]:
    """The terms of one world that are not zero; the total is their sum."""
    scored = reward.score(view)
    terms = dict(zip(reward.names, scored.terms[:, 0].tolist(), strict=True))
    assert scored.total[0] == pytest.approx(sum(terms.values()), abs=1e-12)
    return {name: value for name, value in terms.items() if value != 0}


def expect(view: RewardView, **terms: float) -> None:
    assert terms_of(view) == pytest.approx(terms, abs=1e-12)


# -- states computed by hand -------------------------------------------------------------------------------------------


def test_pick_before_the_grasp() -> None:
    # Object 0.3 m beside and 0.4 m below the hand: 0.5 m away. Hand at 5 m/s. Head pan 0.5 rad off. Torso at 0.1 m/s.
    # 700 N: 0.7 - 0.2 = 0.5 too many.
    state: dict[str, Any] = {
        "object_pos": [0.5, 0.3, 0.87],
        "tcp_vel": [3.0, 0.0, 4.0],
        "robot_q": off((4, 0.5)),
        "robot_qd": speeds((3, -0.1)),
        "robot_force": 700.0,
    }
    common = {
        "reach": 5 * (1 - tanh(1.5)),
        "slow_hand": 1 - tanh(1.0),
        "posture": 1 - tanh(0.1),
        "force": 3 * (1 - tanh(1.5)),
        "above": 1 - tanh(1.5),
    }
    expect(
        view_of([PICK], force=5000.0, **state),
        **common,
        force_limit=2.0,
        torso_still=1 - tanh(0.5),
    )
    expect(view_of([PICK], force=5000.1, **state), **common, torso_still=1 - tanh(0.5))
    # Within 0.3 m of the object the torso may move; 200 N are free.
    state |= {"object_pos": [0.5, 0.0, 1.0], "robot_force": 200.0}
    common |= {"reach": 5 * (1 - tanh(0.81)), "force": 3.0, "above": 1.0}
    expect(view_of([PICK], **state), **common, force_limit=2.0, torso_still=1.0)


def test_pick_after_the_grasp() -> None:
    held: dict[str, Any] = {"finger_force": squeeze(), "object_pos": AT_REST}
    always = {
        "reach": 5.0,
        "slow_hand": 1.0,
        "force": 3.0,
        "force_limit": 2.0,
        "grasp": 2.0,
        "hold": 2.0,
    }
    # On the way to rest: hand 0.2 m off, head 0.5 rad off, base at 0.5 (0.3 forward, 0.4 sideways).
    away = held | {
        "tcp_pos": [0.5, 0.2, 1.27],
        "object_pos": [0.5, 0.2, 1.27],
        "robot_q": off((4, 0.5)),
    }
    expect(
        view_of([PICK], robot_qd=speeds((0, 0.3), (1, 0.4)), **away),
        **always,
        posture=1 - tanh(0.1),
        posture_holding=1 - tanh(0.1),
        rest=5 * (1 - tanh(0.6)),
        base_still=1 - tanh(0.5),
    )
    # At rest but moving: wrist at 0.3 rad/s is not static, so no success.
    rest = always | {
        "posture": 1.0,
        "posture_holding": 1.0,
        "rest": 5.0,
        "base_still": 1.0,
        "at_rest": 2.0,
    }
    expect(
        view_of([PICK], robot_qd=speeds((12, 0.3)), **held), **rest, still=1 - tanh(0.3)
    )
    # Fingers do not count as moving. Everything is reached: the largest reward there is.
    expect(
        view_of([PICK], robot_qd=speeds((13, 0.3)), **held),
        **rest,
        still=1.0,
        success=3.0,
    )


def test_place_on_the_way() -> None:
    # Goal (1, 0, 0.5). Object 0.3 m to the side at the goal's height + 0.25; hand 0.1 m above it.
    # Torso sinks at 0.1 m/s. The object moves at 5 m/s and turns at 2 rad/s, which counts only once it is let go.
    state: dict[str, Any] = {
        "object_pos": [1.0, 0.3, 0.75], "tcp_pos": [1.0, 0.3, 0.85], "robot_qd": speeds((3, -0.1)),
        "object_vel": [0.0, 3.0, 4.0, 2.0, 0.0, 0.0],
    }  # fmt: skip
    d_object = math.hypot(0.3, 0.25)
    d_hand = math.hypot(0.3, 0.35)
    way = {
        "slow_hand": 1.0,
        "force": 3.0,
        "force_limit": 2.0,
        "torso_not_sinking": 1 - tanh(0.5),
        "transport": 6 * (1 - (tanh(d_object) + tanh(d_hand)) / 2),
        "height": 4 * (1 - tanh((0.2 + 0.3) / 2)),
    }
    expect(
        view_of([PLACE], finger_force=squeeze(), **state),
        **way,
        slow_object=3.0,
        grasp=2.0,
    )
    expect(view_of([PLACE], **state), **way, slow_object=3 * (1 - tanh(7 / 5)))
    rising = state | {"robot_qd": speeds((3, 0.1))}
    expect(
        view_of([PLACE], **rising),
        **way | {"torso_not_sinking": 1.0},
        slow_object=3 * (1 - tanh(7 / 5)),
    )


def test_place_at_the_goal() -> None:
    placed = {
        "slow_hand": 1.0,
        "slow_object": 3.0,
        "force": 3.0,
        "force_limit": 2.0,
        "placed": 13.0,
    }
    # Hand 0.1 m from rest, an elbow 0.1 rad off, torso halfway, base turning at 0.5 rad/s.
    moving: dict[str, Any] = {
        "object_pos": GOAL,
        "tcp_pos": [0.5, 0.0, 1.17],
        "robot_q": off((9, 0.1)),
        "robot_qd": speeds((2, 0.5)),
        "torso_up": 0.5,
    }
    away = {
        "rest": 5 * (1 - tanh(0.3)),
        "posture": 4 * (1 - tanh(0.1)),
        "torso_up": 1.0,
        "base_still": 1 - tanh(0.5),
    }
    expect(view_of([PLACE], **moving), **placed, **away)
    resting_now = moving | {"tcp_pos": AT_REST}
    expect(
        view_of([PLACE], **resting_now),
        **placed,
        **away | {"rest": 5.0},
        at_rest=2.0,
        still=1 - tanh(0.5),
        base_still_resting=1 - tanh(0.5),
    )
    done = {
        "rest": 5.0,
        "posture": 4.0,
        "torso_up": 2.0,
        "base_still": 1.0,
        "at_rest": 2.0,
        "still": 1.0,
    }
    expect(
        view_of([PLACE], object_pos=GOAL, torso_up=1.0),
        **placed,
        **done,
        base_still_resting=1.0,
        success=6.0,
    )


def test_open_in_its_stages() -> None:
    # Drawer 0 .. 0.5 m, open from 0.9 of it: 0.45. At 0.15 m a third of the way is done.
    part: dict[str, Any] = {"joint_q": 0.15, "handle_distance": 0.4, "joint_qd": -1.0}
    expect(
        view_of([OPEN], **part),
        reach=3 * (1 - tanh(0.4)),
        progress=2.0,
        started=3.0,
        gentle=3.0,
    )
    expect(
        view_of([OPEN], finger_force=squeeze(), **part),
        grasp=5.0,
        progress=2.0,
        started=3.0,
        gentle=3.0,
    )
    # Too fast, either way; doors may turn at 2 rad/s.
    for fast in (1.1, -1.1):
        expect(
            view_of([OPEN], **part | {"joint_qd": fast}),
            reach=3 * (1 - tanh(0.4)),
            progress=2.0,
            started=3.0,
        )
    door = part | {"joint_qd": 1.1, "joint_ideal": 2.0}
    expect(
        view_of([OPEN], **door),
        reach=3 * (1 - tanh(0.4)),
        progress=2.0,
        started=3.0,
        gentle=3.0,
    )
    # Not started at 1 cm; pressed beyond its closed end there is no negative progress.
    nothing = {"reach": 3 * (1 - tanh(0.4)), "gentle": 3.0}
    expect(view_of([OPEN], **part | {"joint_q": 0.01}), **nothing, progress=6 / 45)
    expect(view_of([OPEN], **part | {"joint_q": -0.01}), **nothing)


def test_open_once_it_is_open() -> None:
    opened: dict[str, Any] = {
        "joint_q": 0.48,
        "handle_distance": 0.4,
        "torso_up": 0.5,
        "finger_force": squeeze(),
    }
    stage = {
        "opened": 6.0,
        "progress": 6.0,
        "started": 3.0,
        "gentle": 3.0,
        "torso_up": 0.5,
    }
    away = opened | {"tcp_pos": [0.5, 0.3, 1.27], "robot_q": off((9, 0.3))}
    expect(
        view_of([OPEN], **away),
        **stage,
        posture=2 * (1 - tanh(0.3)),
        rest=2 * (1 - tanh(0.3)),
    )
    at_rest = {"posture": 2.0, "rest": 2.0}
    expect(
        view_of([OPEN], robot_qd=speeds((12, 0.4)), **opened),
        **stage,
        **at_rest,
        still=1 - tanh(0.4),
    )
    expect(view_of([OPEN], **opened), **stage, **at_rest, still=1.0, success=3.0)


def test_close_in_its_stages() -> None:
    # Drawer 0 .. 0.5 m, closed at 0.01 of it: 0.005; 0.5 - 0.252 5 is half of the 0.495 m to go. Elbow 0.4 rad off.
    part: dict[str, Any] = {
        "joint_q": 0.2525,
        "handle_distance": 0.4,
        "joint_qd": -0.9,
        "robot_q": off((9, 0.4)),
    }
    posture = 1 - (tanh(0.4) + tanh(0.08)) / 2
    expect(
        view_of([CLOSE], **part),
        reach=7 * (1 - tanh(0.4)),
        progress=2.5,
        gentle=5.0,
        posture=posture,
    )
    expect(
        view_of([CLOSE], finger_force=squeeze(), **part),
        grasp=7.5,
        progress=2.5,
        gentle=5.0,
        posture=posture,
    )
    expect(
        view_of([CLOSE], **part | {"joint_qd": 1.1}),
        reach=7 * (1 - tanh(0.4)),
        progress=2.5,
        posture=posture,
    )
    # Closed from afar earns no credit for it, and no success; opened to the end there is no progress.
    shut = part | {"joint_q": 0.002, "robot_q": REST}
    expect(
        view_of([CLOSE], **shut),
        reach=7 * (1 - tanh(0.4)),
        progress=5.0,
        gentle=5.0,
        posture=1.0,
    )
    expect(
        view_of([CLOSE], **part | {"joint_q": 0.51}),
        reach=7 * (1 - tanh(0.4)),
        gentle=5.0,
        posture=posture,
    )


def test_close_once_it_is_closed_by_the_hand() -> None:
    shut: dict[str, Any] = {
        "joint_q": 0.005,
        "handle_distance": 0.4,
        "torso_up": 0.5,
        "closed_near": True,
    }
    stage = {"closed": 8.0, "progress": 5.0, "gentle": 5.0, "torso_up": 0.5}
    away = shut | {
        "tcp_pos": [0.5, 0.3, 1.27],
        "robot_q": off((9, 0.4)),
        "finger_force": squeeze(),
    }
    expect(
        view_of([CLOSE], **away),
        **stage,
        posture_closed=10 * (1 - (tanh(0.4) + tanh(0.08)) / 2),
        rest=2 - (tanh(0.3) + tanh(0.9)),
    )
    at_rest = {"posture_closed": 10.0, "rest": 2.0}
    expect(
        view_of([CLOSE], robot_qd=speeds((12, 0.4)), **shut),
        **stage,
        **at_rest,
        still=2 * (1 - tanh(0.4)),
    )
    expect(view_of([CLOSE], **shut), **stage, **at_rest, still=2.0, success=3.0)


def test_navigate_on_the_way() -> None:
    # Base at (-4, 0) heading for (1, 0) by a way of 6 m, driving at 0.5 m/s; 140 N: 0.7 - 0.2 = 0.5 too many.
    far: dict[str, Any] = {
        "base_pose": [-4.0, 0.0, 0.0],
        "tcp_pos": [-3.5, 0.2, 1.27],
        "nav_distance": 6.0,
        "robot_q": off((9, 0.5)),
        "robot_force": 140.0,
    }
    always = {
        "force": 5 * (1 - tanh(1.5)),
        "posture": 2 * (1 - tanh(0.1)),
        "rest": 2 * (1 - tanh(0.6)),
    }
    way = {"ready": 2.0, "approach": 8 * (1 - tanh(0.6))}
    expect(
        view_of([NAVIGATE], robot_qd=speeds((0, 0.5)), **far),
        **always,
        **way,
        forward=2 * tanh(1.0),
    )
    expect(view_of([NAVIGATE], robot_qd=speeds((0, -0.5)), **far), **always, **way)
    turned = far | {"base_pose": [-4.0, 0.0, math.pi / 2], "tcp_pos": [-4.2, 0.5, 1.27]}
    expect(
        view_of([NAVIGATE], robot_qd=speeds((1, 0.5)), **turned),
        **always,
        **way,
        forward=2 * tanh(1.0),
    )
    # What is to be carried has been lost: only the terms that are always given.
    expect(view_of([NAVIGATE], must_hold=True, **far), **always)
    expect(
        view_of([NAVIGATE], must_hold=True, held_force=squeeze(), **far), **always, **way
    )


def test_navigate_at_the_goal() -> None:
    # 1 m in front of the goal; turned by 1 rad from it it is misaligned.
    there = {"ready": 2.0, "arrived": 12.0, "force": 5.0, "posture": 2.0}
    turned: dict[str, Any] = {
        "base_pose": [0.0, 0.0, 1.0],
        "tcp_pos": [0.5 * math.cos(1), 0.5 * math.sin(1), 1.27],
    }
    expect(view_of([NAVIGATE], **turned), **there, rest=2.0, heading=2 * (1 - tanh(0.5)))
    # Goal 45 degrees to the left of +x, the base turned to the right by 0.5 rad.
    beside = {
        "base_pose": [0.0, -1.0, -0.5],
        "tcp_pos": [0.5 * math.cos(0.5), -1 - 0.5 * math.sin(0.5), 1.27],
    }
    expect(
        view_of([NAVIGATE], **beside),
        **there,
        rest=2.0,
        heading=2 * (1 - tanh((math.pi / 4 + 0.5) / 2)),
    )
    moving = speeds((0, 0.3), (2, 0.4))
    aligned = there | {"aligned": 2.0, "base_still": 2 * (1 - tanh(0.5 / 3))}
    expect(view_of([NAVIGATE], robot_qd=moving), **aligned, rest=2.0, still=1 - tanh(0.5))
    away = view_of([NAVIGATE], robot_qd=moving, tcp_pos=[0.5, 0.1, 1.27])
    expect(away, **aligned, rest=2 * (1 - tanh(0.3)))
    expect(view_of([NAVIGATE]), **there, rest=2.0, aligned=2.0, base_still=2.0, still=1.0)


def test_a_finished_plan_earns_nothing() -> None:
    view = view_of([PICK, PICK])
    view = replace(view, signals=replace(view.signals, kind=np.array([-1, 0])))
    scored = FULL.score(view)
    assert (
        scored.total[0] == 0
        and not scored.terms[:, 0].any()
        and scored.normaliser.tolist() == [1.0, 29.0]
    )
    done = replace(view, signals=replace(view.signals, kind=np.array([-1, -1])))
    assert not FULL.score(done).total.any()


def test_without_a_force_limit_its_term_is_always_given() -> None:
    free = replace(
        CONFIG,
        limits={kind: SubtaskConfig(200, math.inf) for kind in ("pick", "place")},
    )
    for kind in (PICK, PLACE):
        view = view_of([kind], config=free, force=1e12)
        assert terms_of(view, DenseReward(free))["force_limit"] == 2.0


def test_closed_near_is_earned_at_the_handle_kept_while_closed_and_lost_by_opening() -> (
    None
):
    def run(closed: str, at_handle: str) -> str:
        near = np.array([False])
        seen = ""
        for shut, at in zip(closed, at_handle, strict=True):
            near = closed_near(
                near, np.array([shut == "1"]), np.array([0.3 if at == "1" else 0.3001])
            )
            seen += str(int(near[0]))
        return seen

    assert (
        run("0111", "1100") == "0111"
    )  # shut at the handle, then the hand goes back to rest
    assert run("0111", "1000") == "0000"  # it fell shut after the hand had left
    assert run("0111", "0001") == "0001"  # the hand comes later
    assert run("11011", "10000") == "11000"  # it opened again


# -- tables and options ------------------------------------------------------------------------------------------------


def test_other_scales_change_the_term_and_the_normaliser() -> None:
    changed = DenseReward(CONFIG, RewardOptions({"pick": {"reach": 4.0, "success": 0.5}}))
    view = view_of([PICK], object_pos=[0.5, 0.3, 0.87])
    assert terms_of(view, changed) == pytest.approx(
        terms_of(view) | {"reach": 4 * (1 - tanh(1.5))}, abs=1e-12
    )
    assert changed.score(view).normaliser[0] == 29 - 1 - 2.5
    # Terms of stages that exclude each other do not add up: the grasp replaces the reach.
    assert (
        reward_table("close").scaled("close", {"reach": 100.0}).attainable
        == 100 + 5 + 5 + 1
    )
    assert reward_table("pick").scaled("pick", {"above": -1.0}).attainable == 29


@pytest.mark.parametrize(
    ("scales", "option"),
    [
        ({"grab": {"reach": 1.0}}, "subtask"),
        ({"pick": {"reech": 1.0}}, "reward term of pick"),
        ({"open": {"hold": 1.0}}, "reward term of open"),
        ({"pick": {"reach": math.nan}}, "the scale of reward term pick.reach"),
        ({"pick": {"reach": True}}, "the scale of reward term pick.reach"),
        ({"pick": {"reach": "5"}}, "the scale of reward term pick.reach"),
    ],
)
def test_scales_that_do_not_exist_are_refused(scales: Any, option: str) -> None:
    with refused(option):
        DenseReward(CONFIG, RewardOptions(scales))


def test_raw_values_are_paired_by_name() -> None:
    sharpness = {"reach": 1.0, "rest": 0.0}
    raw = near(sharpness, {"rest": np.array([9.0]), "reach": np.array([2.0])})
    assert raw["rest"][0] == 1.0 and raw["reach"][0] == pytest.approx(1 - tanh(2.0))
    with refused("distances", "raech, reach"):
        near(sharpness, {"rest": np.array([9.0]), "raech": np.array([2.0])})


def test_a_kind_that_was_not_announced_is_refused() -> None:
    with refused(said="place"):
        DenseReward(CONFIG, kinds=("pick",)).score(view_of([PLACE]))


@pytest.mark.parametrize("name", SUBTASKS)
def test_tables_are_sound(name: str) -> None:
    table = reward_table(name)
    names = [t.name for t in table.terms]
    assert len(set(names)) == len(names) and all(
        t.about and t.scale > 0 for t in table.terms
    )
    when, _ = table.raw(view_of([number_of(name)]), CONFIG)
    assert {t.when for t in table.terms} == {*when, "always"}
    assert {c for case in table.cases for c in case} == set(when)
