"""States that the tests of dense rewards start from: by hand, at their best, at random."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from typing import Any

import numpy as np

from mjhab.core.arrays import map_record
from mjhab.tasks.measure import measure
from mjhab.tasks.plan import Subtask, SubtaskKind, TaskPlan, stack_plans
from mjhab.tasks.progress import start
from mjhab.tasks.rewards.table import RewardView
from mjhab.tasks.scoring import DenseReward
from mjhab.tasks.signals import WorldState
from mjhab.tasks.thresholds import TaskConfig
from tests.tasks.build import CONFIG, REST, resting, squeeze

PICK, PLACE, NAVIGATE, OPEN, CLOSE = range(5)
AT_REST = [0.5, 0.0, 1.27]
"""Where the tool centre rests when the base is at the origin: (0.5, 0, 1.25) in a base 2 cm above the floor."""
EXTRA = {
    "tcp_vel": (3,),
    "object_pos": (3,),
    "object_vel": (6,),
    "torso_up": (),
    "handle_distance": (),
    "joint_qd": (),
    "joint_ideal": (),
    "nav_distance": (),
    "closed_near": (),
}
"""Fields of a view beside the world, with the shape of a row."""
GOAL = (1.0, 0.0, 0.5)
FULL = DenseReward(CONFIG)


def off(*shifts: tuple[int, float], base: tuple[float, ...] = REST) -> list[float]:
    """Joint values ``base`` with some shifted."""
    values = list(base)
    for joint, shift in shifts:
        values[joint] += shift
    return values


def speeds(*entries: tuple[int, float]) -> list[float]:
    return off(*entries, base=(0.0,) * 15)


def view_of(
    kinds: list[int],
    config: Any = CONFIG,
    must_hold: Any = False,
    force: Any = 0.0,
    **over: Any,
) -> RewardView:
    """Worlds that do one subtask each, place and navigation goals at ``GOAL``; the robot at rest at the origin."""
    subtasks = [
        Subtask(SubtaskKind(k), "bowl", "kitchen_counter/drawer3", GOAL, must_hold)
        for k in kinds
    ]
    plan = stack_plans([TaskPlan("test", (s,)) for s in subtasks], config)
    extra: dict[str, Any] = {
        name: np.zeros((len(kinds), *shape)) for name, shape in EXTRA.items()
    }
    extra |= {
        "joint_ideal": extra["joint_ideal"] + 1.0,
        "closed_near": extra["closed_near"] > 0,
    }
    for name in set(over) & set(EXTRA):
        extra[name] = np.broadcast_to(
            np.asarray(over.pop(name)), extra[name].shape
        ).astype(extra[name].dtype)
    world = resting(
        1, len(kinds), **{"plan_obj_pos": extra["object_pos"][:, None], **over}
    )
    return look(world, plan, config, force, extra)


def look(
    world: WorldState, plan: Any, config: TaskConfig, force: Any, extra: dict[str, Any]
) -> RewardView:
    progress = start(plan, config)
    progress = replace(progress, cumulative_force=progress.cumulative_force + force)
    signals = measure(world, plan, progress, config)
    goal = plan.goal_pos[:, 0]
    open_frac = plan.open_frac[:, 0]
    return RewardView(
        world=world, signals=signals, goal_pos=goal, open_frac=open_frac, **extra
    )


BEST: dict[int, dict[str, Any]] = {
    PICK: {"finger_force": squeeze(), "object_pos": AT_REST},
    PLACE: {"object_pos": GOAL, "torso_up": 1.0},
    NAVIGATE: {},
    OPEN: {"joint_q": 0.45, "torso_up": 1.0},
    CLOSE: {"joint_q": 0.005, "torso_up": 1.0, "closed_near": True},
}


RANDOM = {
    "tcp_pos": lambda r: AT_REST + r.normal(0, 0.3, 3),
    "base_pose": lambda r: r.normal(0, 2, 3),
    "robot_q": lambda r: REST + r.normal(0, 0.2, 15),
    "robot_qd": lambda r: r.normal(0, 0.3, 15),
    "finger_force": lambda r: squeeze()[0] * r.uniform(0, 2) + r.normal(0, 1, (2, 3)),
    "held_force": lambda r: squeeze()[0],
    "robot_force": lambda r: r.exponential(300),
    "joint_q": lambda r: r.uniform(-0.05, 0.55),
    "tcp_vel": lambda r: r.normal(0, 3, 3),
    "object_pos": lambda r: GOAL + r.normal(0, 0.2, 3),
    "object_vel": lambda r: r.normal(0, 3, 6),
    "torso_up": lambda r: r.uniform(0, 1),
    "handle_distance": lambda r: r.exponential(0.5),
    "joint_qd": lambda r: r.normal(0, 1),
    "joint_ideal": lambda r: r.choice([1.0, 2.0]),
    "nav_distance": lambda r: r.exponential(5),
    "closed_near": lambda r: r.random() < 0.5,
}


def random_view(seed: int, worlds: int, chance: float = 0.7) -> RewardView:
    """Worlds that are at their best but for some quantities, each of which is random with a chance."""
    rng = np.random.default_rng(seed)
    views = []
    for kind in rng.integers(0, 5, worlds).tolist():
        over = {name: draw(rng) for name, draw in RANDOM.items() if rng.random() < chance}
        must_hold = bool(rng.random() < 0.5)
        force = rng.exponential(5000)
        views.append(
            view_of([kind], must_hold=must_hold, force=force, **BEST[kind] | over)
        )
    return join(views)


def join(records: list[Any]) -> Any:
    """One record of many, their rows one after the other."""
    first = records[0]
    values = {
        f.name: [getattr(r, f.name) for r in records] for f in dataclasses.fields(first)
    }
    merged = {
        k: join(v) if dataclasses.is_dataclass(v[0]) else np.concatenate(v)
        for k, v in values.items()
    }
    return type(first)(**merged)


def rows(record: Any, index: Any) -> Any:
    return map_record(
        lambda x: rows(x, index) if dataclasses.is_dataclass(x) else x[index], record
    )
