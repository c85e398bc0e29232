"""Signals and success: hand-computed cases, every threshold at equality and just beyond, numpy against torch."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from mjhab.tasks.household.registry import chain
from mjhab.tasks.measure import active_entries, measure
from mjhab.tasks.plan import Subtask, SubtaskKind, Target, TaskPlan, stack_plans
from mjhab.tasks.progress import Progress, accumulate, start
from mjhab.tasks.rewards.table import posture_error
from mjhab.tasks.signals import Signals
from mjhab.tasks.thresholds import TaskConfig
from tests.refusals import refused
from tests.tasks.build import (
    CONFIG,
    REST,
    assert_same_record,
    config_of,
    plan_of,
    resting,
    squeeze,
    to_torch,
)

PICK, PLACE, NAVIGATE, OPEN, CLOSE = range(5)
ZERO_REST = config_of((0.0,) * 15)
"""Rest at zero, so that offsets hit a threshold exactly in floating point."""
HALF = replace(ZERO_REST, nav_bearing=math.atan2(1.0, 2.0), ignore_arm=False)


def look(
    kind: int,
    config: TaskConfig = ZERO_REST,
    link: str = "kitchen_counter/drawer3",
    **over: Any,
) -> Signals:
    """Measure one world that does one subtask."""
    force = over.pop("cumulative", 0.0)
    plan = plan_of(kind, config=config, link=link, must_hold=over.pop("must_hold", False))
    if "box" in over:
        plan = replace(
            plan, box=np.asarray(over.pop("box"), dtype=float).reshape(1, 1, 4)
        )
    progress = replace(start(plan, config), cumulative_force=np.array([force]))
    return measure(resting(rest=config.rest_qpos, **over), plan, progress, config)


def joints(index: int, value: float) -> np.ndarray:
    q = np.zeros((1, 15))
    q[0, index] = value
    return q


def beyond(value: float) -> float:
    """The next float away from zero."""
    return math.nextafter(value, math.copysign(math.inf, value))


def at_and_beyond(
    kind: int,
    signal: str,
    make: Any,
    limit: float,
    config: TaskConfig = ZERO_REST,
    **more: Any,
) -> None:
    """The signal holds at the limit and not one float beyond."""
    assert bool(getattr(look(kind, config, **make(limit), **more), signal)[0]), (
        signal,
        limit,
    )
    assert not bool(
        getattr(look(kind, config, **make(beyond(limit)), **more), signal)[0]
    ), (
        signal,
        limit,
    )


@pytest.mark.parametrize("sign", [1, -1])
def test_thresholds_of_the_robot_include_equality_on_both_sides(sign: int) -> None:
    at_and_beyond(PICK, "ee_rest", lambda v: {"tcp_pos": [0.5, v, 1.27]}, sign * 0.05)
    for joint in range(4, 13):
        at_and_beyond(
            PLACE, "robot_rest", lambda v, j=joint: {"robot_q": joints(j, v)}, sign * 0.2
        )
        at_and_beyond(
            PICK, "robot_rest", lambda v, j=joint: {"robot_q": joints(j, v)}, sign * 0.6
        )
        at_and_beyond(
            OPEN, "is_static", lambda v, j=joint: {"robot_qd": joints(j, v)}, sign * 0.2
        )
    at_and_beyond(PLACE, "robot_rest", lambda v: {"robot_q": joints(3, v)}, sign * 0.01)
    at_and_beyond(PICK, "robot_rest", lambda v: {"robot_q": joints(3, v)}, sign * 0.6)
    for joint in range(3):
        at_and_beyond(
            OPEN, "is_static", lambda v, j=joint: {"robot_qd": joints(j, v)}, sign * 0.05
        )
    assert look(
        OPEN, robot_qd=joints(13, 9.0), robot_q=joints(14, 9.0)
    ).success.shape == (1,)
    assert look(PICK, robot_qd=joints(13, 9.0)).is_static[0], "fingers may move"


@pytest.mark.parametrize("turns", [-2, -1, 1, 3])
def test_whole_turns_of_joints_without_limits_count_only_as_published(
    turns: int,
) -> None:
    """An arm at rest except for a roll joint that was turned round, at rest and 0.1 rad off."""
    roll, limited = 8, 9
    free = tuple(joint == roll for joint in range(15))
    wrapped = replace(ZERO_REST, endless=free)
    for off in (0.0, 0.1):
        q = joints(roll, off + turns * 2 * math.pi)
        assert look(PLACE, wrapped, robot_q=q).robot_rest[0]
        assert not look(PLACE, ZERO_REST, robot_q=q).robot_rest[0]
        state = resting(rest=wrapped.rest_qpos, robot_q=q)
        assert posture_error(state, wrapped)[0] == pytest.approx(off, abs=1e-9)
        assert posture_error(state, ZERO_REST)[0] > 6.0
    q = joints(roll, 0.3 + turns * 2 * math.pi)
    assert not look(PLACE, wrapped, robot_q=q).robot_rest[0]
    q = joints(limited, turns * 2 * math.pi)
    assert not look(PLACE, wrapped, robot_q=q).robot_rest[0]


def test_end_effector_rest_point_moves_and_turns_with_the_base() -> None:
    tcp = [1.0, 2.5, 1.27]
    assert look(PICK, base_pose=[1.0, 2.0, math.pi / 2], tcp_pos=tcp).ee_rest[0]
    assert not look(PICK, base_pose=[1.0, 2.0, 0.0], tcp_pos=tcp).ee_rest[0]
    assert not look(PICK, tcp_pos=[0.5, 0.0, 1.2]).ee_rest[0]


def test_grasp_needs_force_and_direction_on_both_fingers() -> None:
    assert look(PICK, finger_force=squeeze(0.5)).is_grasped[0]
    assert not look(PICK, finger_force=squeeze(math.nextafter(0.5, 0))).is_grasped[0]
    one = squeeze()
    one[0, 1] = 0
    weak = look(PICK, finger_force=one)
    assert (
        not weak.is_grasped[0]
        and weak.contact[0]
        and weak.touch[0]
        and weak.ee_contact[0]
    )
    assert not look(PICK, finger_force=-squeeze()).is_grasped[0], "pushed shut"
    for degrees, grasped in ((29.99, True), (30.01, False)):
        tilt = squeeze()
        tilt[0, 0] = [
            5 * math.sin(math.radians(degrees)),
            -5 * math.cos(math.radians(degrees)),
            0,
        ]
        assert bool(look(PICK, finger_force=tilt).is_grasped[0]) is grasped
    assert look(PICK, finger_force=squeeze(5.0)).target_force[0] == 10.0


def test_contact_is_by_fingers_ee_contact_by_the_hand_touch_by_any_link() -> None:
    elbow = look(OPEN, target_contact=True)
    assert elbow.touch[0] and not elbow.ee_contact[0] and not elbow.contact[0]
    palm = look(OPEN, target_contact=True, ee_contact=True)
    assert palm.touch[0] and palm.ee_contact[0] and not palm.contact[0]
    nothing = look(OPEN)
    assert not nothing.touch[0] and not nothing.ee_contact[0] and not nothing.contact[0]


def test_place_goal_types() -> None:
    def at(offset: tuple[float, float, float], config: TaskConfig) -> bool:
        plan = stack_plans(
            [TaskPlan("t", (Subtask(SubtaskKind.PLACE, "o", goal_rect=rect),))], config
        )
        state = resting(rest=config.rest_qpos, plan_obj_pos=offset)
        return bool(measure(state, plan, start(plan, config), config).at_goal[0])

    rect = ((0.5, 0.2), (-0.5, 0.2), (-0.5, -0.2), (0.5, -0.2))
    ball = ZERO_REST
    can = replace(ZERO_REST, goal_type="cylinder")
    zone = replace(ZERO_REST, goal_type="zone")
    assert at((0.15, 0, 0), ball) and not at((beyond(0.15), 0, 0), ball)
    assert at((0, 0, -0.15), ball) and not at((0.12, 0, 0.12), ball)
    assert at((0.12, 0, 0.12), can) and at((0, 0.15, -0.15), can)
    assert not at((0, 0.15, beyond(0.15)), can) and not at((0.12, 0.12, 0), can)
    assert at((0.5, 0.2, 0.15), zone) and at((-0.5, -0.2, 0), zone)
    assert (
        not at((0.51, 0, 0), zone)
        and not at((0, -0.21, 0), zone)
        and not at((0, 0, 0.16), zone)
    )
    plan = plan_of(PLACE)
    with refused(said="goal_rect"):
        measure(resting(), plan, start(plan, zone), zone)


def test_joint_thresholds_include_equality() -> None:
    def joint(
        q: float,
        kind: int = OPEN,
        link: str = "kitchen_counter/drawer3",
        top: float = 1.0,
    ) -> Signals:
        return look(kind, link=link, joint_q=q, joint_max=top, joint_start=1.0)

    for q, opened in ((0.9, True), (math.nextafter(0.9, 0), False)):
        assert bool(joint(q).opened[0]) is opened
    for q, opened in ((0.75, True), (math.nextafter(0.75, 0), False)):
        assert bool(joint(q, link="fridge/top_door").opened[0]) is opened
    assert (
        joint(1.725, link="fridge/top_door", top=2.3).opened[0]
        and not joint(1.72, OPEN, "fridge/top_door", 2.3).opened[0]
    )
    assert joint(0.01, CLOSE).closed[0] and not joint(beyond(0.01), CLOSE).closed[0]
    assert (
        joint(0.1).slightly_opened[0]
        and not joint(math.nextafter(0.1, 0)).slightly_opened[0]
    )
    near = math.nextafter(1 - 0.05, 2)
    assert (
        joint(0.9499, CLOSE).slightly_closed[0]
        and not joint(near, CLOSE).slightly_closed[0]
    )
    shifted = look(OPEN, joint_min=-0.5, joint_max=0.5, joint_q=0.4)
    assert shifted.opened[0], "fractions count from the lower end of the range"
    other = look(PICK, joint_q=0.0, joint_min=0.0, joint_max=0.0, joint_start=0.0)
    assert not (
        other.opened | other.closed | other.slightly_opened | other.slightly_closed
    )[0]


def test_navigation_distance_bearing_and_area() -> None:
    at_and_beyond(NAVIGATE, "near", lambda v: {"base_pose": [1.0, v, 0.0]}, 2.0)
    at_and_beyond(NAVIGATE, "near", lambda v: {"base_pose": [1.0, v, 0.0]}, -2.0)
    assert look(NAVIGATE, HALF, base_pose=[0.0, 0.5, 0.0]).oriented[0], (
        "equal to the limit, to the right"
    )
    assert look(NAVIGATE, HALF, base_pose=[0.0, -0.5, 0.0]).oriented[0], (
        "equal to the limit, to the left"
    )
    assert not look(NAVIGATE, HALF, base_pose=[0.0, 0.51, 0.0]).oriented[0]
    assert not look(NAVIGATE, HALF, base_pose=[0.0, -0.51, 0.0]).oriented[0]
    assert not look(NAVIGATE, base_pose=[0.0, 0.0, math.pi]).oriented[0]
    assert look(NAVIGATE, base_pose=[0.0, 0.0, 2 * math.pi]).oriented[0]
    assert look(NAVIGATE, base_pose=[1.0, 0.0, 3.0]).success[0], (
        "standing on the goal, every heading faces it"
    )
    box = (-1.0, 0.0, -0.5, 0.0)
    assert look(NAVIGATE, box=box).near[0], "on the corner of the area"
    for xy in ((1e-9, 0.0), (-1.1, 0.0), (0.0, 1e-9), (0.0, -0.6)):
        assert not look(NAVIGATE, box=box, base_pose=[*xy, 0.0]).near[0]
    assert not look(PICK).near[0] and not look(PICK).oriented[0]


def test_navigate_judges_arm_and_grasp_unless_ignored() -> None:
    strict = replace(ZERO_REST, ignore_arm=False)
    assert look(NAVIGATE, strict).success[0]
    assert not look(NAVIGATE, strict, tcp_pos=[0.5, 0.0, 1.0]).success[0]
    assert look(NAVIGATE, tcp_pos=[0.5, 0.0, 1.0]).success[0]
    assert not look(NAVIGATE, strict, robot_q=joints(5, 0.3)).success[0]
    held = {"must_hold": True, "held_force": squeeze(), "robot_q": joints(5, 0.3)}
    carrying = look(NAVIGATE, strict, **held)
    assert (
        carrying.success[0]
        and carrying.is_grasped[0]
        and carrying.contact[0]
        and carrying.must_hold[0]
    )
    assert not look(NAVIGATE, strict, must_hold=True).success[0], "the object is gone"
    assert not look(NAVIGATE, strict, must_hold=True, finger_force=squeeze()).is_grasped[
        0
    ], "another object"
    assert look(NAVIGATE, must_hold=True).success[0]
    assert not look(NAVIGATE, robot_qd=joints(0, 0.1)).success[0], "still driving"


GOOD: dict[int, dict[str, Any]] = {
    PICK: {"finger_force": squeeze()},
    PLACE: {"plan_obj_pos": [1.0, 0.0, 0.5]},
    NAVIGATE: {},
    OPEN: {"joint_q": 0.48},
    CLOSE: {"joint_q": 0.004},
}


@pytest.mark.parametrize("kind", range(5))
def test_success_needs_every_condition(kind: int) -> None:
    strict = replace(ZERO_REST, ignore_arm=False)
    good = GOOD[kind]
    assert look(kind, strict, **good).success[0]
    spoilers: list[dict[str, Any]] = [
        {"tcp_pos": [0.6, 0.0, 1.27]},
        {"robot_q": joints(8, 0.7)},
        {"robot_qd": joints(8, -0.3)},
        {"robot_qd": joints(1, -0.06)},
        {"cumulative": 1e9} if kind != NAVIGATE else {"base_pose": [0.0, 0.0, 1.0]},
    ]
    wrong: dict[int, dict[str, Any]] = {
        PICK: {"finger_force": 0.0},
        PLACE: {"plan_obj_pos": [1.2, 0.0, 0.5]},
        NAVIGATE: {"base_pose": [-1.5, 0.0, 0.0]},
        OPEN: {"joint_q": 0.4},
        CLOSE: {"joint_q": 0.02},
    }
    for spoiler in [*spoilers, wrong[kind]]:
        assert not look(kind, strict, **(good | spoiler)).success[0], spoiler
    if kind == PLACE:
        assert not look(kind, strict, **good, finger_force=squeeze()).success[0], (
            "still held"
        )


@pytest.mark.parametrize(
    ("kind", "limit"),
    [(PICK, 5000.0), (PLACE, 7500.0), (OPEN, 10000.0), (CLOSE, 10000.0)],
)
def test_force_limit_includes_equality(kind: int, limit: float) -> None:
    at_and_beyond(kind, "force_ok", lambda v: {"cumulative": v}, limit)
    at_and_beyond(kind, "success", lambda v: {"cumulative": v}, limit, **GOOD[kind])
    assert look(NAVIGATE, cumulative=1e12).force_ok[0]


def test_finished_places_are_watched_and_a_finished_plan_has_no_kind() -> None:
    plan = plan_of(PLACE, PICK, PLACE)
    objects = np.array([[[1.0, 0.0, 0.5], [0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]])
    state = resting(3, plan_obj_pos=objects)
    moved = resting(3, plan_obj_pos=objects + np.array([0.0, 0.2, 0.0]))
    for pointer, kind, ok in (
        (0, PLACE, True),
        (1, PICK, False),
        (2, PLACE, False),
        (3, -1, False),
    ):
        progress = replace(start(plan, CONFIG), pointer=np.array([pointer]))
        here = measure(state, plan, progress, CONFIG)
        assert here.kind[0] == kind
        assert here.placed_ok[0] == (pointer < 3), "the last place is far off its goal"
        assert measure(moved, plan, progress, CONFIG).placed_ok[0] == ok
    assert not here.success[0] and here.force_ok[0]


def _mixed(worlds: int, seed: int) -> tuple[Any, Any, Any, TaskConfig]:
    """Worlds at every position of a SetTable plan, states spread around the thresholds."""
    rng = np.random.default_rng(seed)
    targets = [
        Target("a", (1, 0, 0.5), (0, 0, 0), "kitchen_counter/drawer3"),
        Target("b", (1, 0, 0), (0, 0, 0), "fridge/t"),
    ]
    config = replace(CONFIG, ignore_arm=bool(seed % 2))
    plan = stack_plans(
        [chain("set_table", targets)] * worlds,
        config,
        [{"fridge/t": (-1, 1, -1, 1)}] * worlds,
        doors={"fridge/t"},
    )
    near = rng.normal(size=(worlds, 1)) * 0.1

    def around(x: Any, scale: float) -> np.ndarray:
        x = np.asarray(x, dtype=float)
        return x + scale * near.reshape((worlds,) + (1,) * (x.ndim - 1)) * rng.normal(
            size=x.shape
        )

    calm = resting(16, worlds)
    state = replace(
        calm,
        base_pose=around(calm.base_pose, 5),
        robot_q=around(calm.robot_q, 1),
        robot_qd=around(calm.robot_qd, 1),
        tcp_pos=around(calm.tcp_pos, 0.3),
        finger_force=around(np.tile(squeeze(1.0), (worlds, 1, 1)), 3),
        held_force=around(np.tile(squeeze(1.0), (worlds, 1, 1)), 3),
        target_contact=rng.random(worlds) < 0.5,
        plan_obj_pos=around(plan.goal_pos, 0.5),
        joint_q=rng.random(worlds) * 0.5,
        robot_force=rng.random(worlds) * 100,
    )
    progress = replace(
        start(plan, config),
        pointer=rng.integers(0, 17, worlds),
        cumulative_force=rng.choice([0.0, 5000.0, 7500.0, 10000.0, 10001.0], worlds),
    )
    return state, plan, progress, config


@pytest.mark.parametrize("seed", range(4))
def test_torch_measures_the_same_in_value_and_dtype(seed: int) -> None:
    state, plan, progress, config = _mixed(400, seed)
    here = measure(state, plan, progress, config)
    assert_same_record(
        here,
        measure(to_torch(state), to_torch(plan), to_torch(progress), config),
        tol=1e-12,
    )
    assert here.success.any() and not here.success.all()
    assert here.success.dtype == bool and here.kind.dtype == np.int64
    assert_same_record(
        accumulate(progress, state.robot_force, state.fingers_force),
        accumulate(
            to_torch(progress), to_torch(state).robot_force, to_torch(state).fingers_force
        ),
    )


def test_single_precision_stays_single() -> None:
    state, plan, progress, config = _mixed(8, 0)

    def single(record: Any) -> Any:
        tensors = to_torch(record)
        names = {
            k: v.float() if v is not None and v.is_floating_point() else v
            for k, v in vars(tensors).items()
        }
        return type(record)(**names)

    here = measure(single(state), single(plan), single(progress), config)
    assert (
        str(here.target_force.dtype)
        == str(here.cumulative_force.dtype)
        == "torch.float32"
    )
    forces = (single(state).robot_force, single(state).fingers_force)
    counted = accumulate(single(progress), *forces)
    for peak in (counted.peak_force, counted.peak_finger_force):
        assert str(peak.dtype) == "torch.float32"


def test_measuring_changes_nothing() -> None:
    state, plan, progress, config = _mixed(16, 1)
    before = [
        np.copy(v)
        for record in (state, plan, progress)
        for v in vars(record).values()
        if v is not None
    ]
    measure(state, plan, progress, config)
    after = [
        v
        for record in (state, plan, progress)
        for v in vars(record).values()
        if v is not None
    ]
    for a, b in zip(before, after, strict=True):
        np.testing.assert_array_equal(a, b)


def test_progress_type_is_what_start_makes() -> None:
    plan = plan_of(PICK)
    assert isinstance(start(plan, CONFIG), Progress) and REST[3] == 0.386


@pytest.mark.parametrize("kind", [PICK, PLACE, NAVIGATE, OPEN, CLOSE])
def test_checks_that_no_world_has_are_left_out_without_a_difference(kind: int) -> None:
    plan = plan_of(kind, config=ZERO_REST)
    progress = start(plan, ZERO_REST)
    active = active_entries(plan, progress.pointer, ZERO_REST)
    everything = replace(active, has_goals=True, has_joints=True, has_ways=True)
    state = resting(rest=ZERO_REST.rest_qpos)
    lean = measure(state, plan, progress, ZERO_REST, active)
    full = measure(state, plan, progress, ZERO_REST, everything)
    for field in fields(Signals):
        np.testing.assert_array_equal(
            getattr(lean, field.name), getattr(full, field.name)
        )
    asked = (active.has_goals, active.has_joints, active.has_ways)
    assert asked == (kind == PLACE, kind in (OPEN, CLOSE), kind == NAVIGATE)
