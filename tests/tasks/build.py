"""States, plans and histories that the tests of ``tasks`` start from."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch

from mjhab.core.arrays import map_record
from mjhab.core.joints import JointColumns
from mjhab.tasks.label_state import History
from mjhab.tasks.plan import PlanArrays, Subtask, SubtaskKind, TaskPlan, stack_plans
from mjhab.tasks.signals import Signals, WorldState
from mjhab.tasks.thresholds import TaskConfig

REST = (
    0,
    0,
    0,
    0.386,
    0,
    -0.370,
    0.562,
    -1.032,
    0.695,
    0.955,
    -0.1,
    2.077,
    0,
    0.015,
    0.015,
)


def config_of(rest: tuple[float, ...] = REST, **changes: Any) -> TaskConfig:
    """Thresholds for a robot like Fetch, with another rest pose and other changes."""
    joints = JointColumns(count=15, fingers=slice(13, 15), torso=3)
    return TaskConfig(
        rest, joints, ee_rest_pos=(0.5, 0.0, 1.25), base_height=0.02, **changes
    )


CONFIG = config_of()
HISTORY_FIELDS = tuple(f.name for f in dataclasses.fields(History))


def plan_of(
    *kinds: int,
    config: TaskConfig = CONFIG,
    link: str = "kitchen_counter/drawer3",
    **more: Any,
) -> PlanArrays:
    """One world that does the given kinds in order; place and navigation goals at (1, 0, 0.5)."""
    subtasks = tuple(
        Subtask(SubtaskKind(k), obj="bowl", link=link, goal_pos=(1.0, 0.0, 0.5), **more)
        for k in kinds
    )
    return stack_plans([TaskPlan("test", subtasks)], config, doors={"fridge/top_door"})


def resting(
    subtasks: int = 1, worlds: int = 1, rest: tuple[float, ...] = REST, **over: Any
) -> WorldState:
    """Robots standing at the origin at rest, the hand empty, objects at the origin, the joint in the middle."""
    zeros = np.zeros
    values: dict[str, Any] = {
        "base_pose": zeros((worlds, 3)),
        "robot_q": np.tile(np.asarray(rest, dtype=float), (worlds, 1)),
        "robot_qd": zeros((worlds, 15)),
        "tcp_pos": np.tile([0.5, 0.0, 1.27], (worlds, 1)),
        "finger_force": zeros((worlds, 2, 3)),
        "finger_dir": np.tile([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]], (worlds, 1, 1)),
        "robot_force": zeros(worlds),
        "fingers_force": zeros(worlds),
        "target_contact": zeros(worlds, dtype=bool),
        "ee_contact": zeros(worlds, dtype=bool),
        "plan_obj_pos": zeros((worlds, subtasks, 3)),
        "joint_q": np.full(worlds, 0.25),
        "joint_min": zeros(worlds),
        "joint_max": np.full(worlds, 0.5),
        "joint_start": np.full(worlds, 0.25),
        "held_force": zeros((worlds, 2, 3)),
    }
    for name, value in over.items():
        values[name] = np.broadcast_to(np.asarray(value), values[name].shape).astype(
            values[name].dtype
        )
    return WorldState(**values)


def squeeze(force: float = 5.0) -> np.ndarray:
    """(1, 2, 3) finger forces [N] of a straight grasp."""
    return np.array([[[0.0, -force, 0.0], [0.0, force, 0.0]]])


def signals(worlds: int = 1, **over: Any) -> Signals:
    """Signals where nothing holds but the force limit and the finished Places."""
    values: dict[str, Any] = {
        f.name: np.zeros(worlds, dtype=bool) for f in dataclasses.fields(Signals)
    }
    values |= {
        name: np.zeros(worlds)
        for name in ("robot_force", "target_force", "cumulative_force")
    }
    values |= {
        "force_ok": np.ones(worlds, dtype=bool),
        "placed_ok": np.ones(worlds, dtype=bool),
    }
    values["kind"] = np.zeros(worlds, dtype=np.int64)
    for name, value in over.items():
        values[name] = np.broadcast_to(
            np.asarray(value, dtype=values[name].dtype), (worlds,)
        ).copy()
    return Signals(**values)


def history(steps: int | None = None, **rows: str | bool) -> History:
    """One world's history (T+1, 1) from strings such as ``is_grasped="0110"``; others False, force within limits."""
    length = (
        steps
        if steps is not None
        else max(len(row) for row in rows.values() if isinstance(row, str))
    )
    values = {name: np.zeros((length, 1), dtype=bool) for name in HISTORY_FIELDS}
    values["force_ok"][:] = True
    for name, row in rows.items():
        values[name][:, 0] = [c == "1" for c in row] if isinstance(row, str) else row
    return History(**values)


def random_history(
    rng: np.random.Generator, kind: int, steps: int, worlds: int
) -> History:
    """Histories that physics and success rules allow: grasp implies contact, success its conditions, and so on."""

    def flips(p_one: float) -> np.ndarray:
        flip = rng.random((steps, worlds)) < rng.random(worlds) * 0.6
        return (np.cumsum(flip, axis=0) + (rng.random(worlds) < p_one)) % 2 == 1

    grasped = flips(0.4)
    contact = grasped | flips(0.3)
    ee_contact = contact | flips(0.3)
    at_goal = flips(0.3)
    near = flips(0.5)
    opened = flips(0.3)
    closed = flips(0.3)
    closed = closed & ~opened
    broken = rng.integers(0, 4 * steps, worlds)
    force_ok = np.arange(steps)[:, None] < np.where(broken == 0, 4 * steps, broken)
    goal = {0: grasped, 1: at_goal & ~grasped, 2: near, 3: opened, 4: closed}[kind]
    return History(
        is_grasped=grasped,
        at_goal=at_goal,
        opened=opened,
        closed=closed,
        slightly_opened=opened | (flips(0.3) & ~closed),
        slightly_closed=closed | (flips(0.3) & ~opened),
        near=near,
        contact=contact,
        touch=ee_contact | flips(0.3),
        ee_contact=ee_contact,
        force_ok=force_ok,
        success=goal
        & force_ok
        & (rng.random((steps, worlds)) < rng.random(worlds) * 0.7),
        must_hold=np.broadcast_to(rng.random(worlds) < 0.5, (steps, worlds)).copy(),
    )


def to_torch(record: Any) -> Any:
    """The same record as torch tensors."""
    return map_record(lambda x: torch.from_numpy(np.array(x)), record)


def assert_same(
    numpy_value: np.ndarray, torch_value: torch.Tensor, name: str = "", tol: float = 0.0
) -> None:
    """The two agree in shape, dtype and value."""
    assert str(torch_value.dtype).removeprefix("torch.") == str(numpy_value.dtype), name
    np.testing.assert_allclose(
        torch_value.numpy(), numpy_value, rtol=tol, atol=tol, err_msg=name
    )


def assert_same_record(numpy_record: Any, torch_record: Any, tol: float = 0.0) -> None:
    """All fields of two records agree in shape, dtype and value."""
    for f in dataclasses.fields(numpy_record):
        assert_same(
            getattr(numpy_record, f.name), getattr(torch_record, f.name), f.name, tol
        )
