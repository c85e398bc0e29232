"""Task plans: which subtasks a robot has to do, in which order, and every threshold that judges it.

Thresholds come from the MS-HAB paper (Sec. 4 and App. A.2) and from its code (mshab/envs/planner.py,
mshab/envs/sequential_task.py).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Literal

import numpy as np

from mjhab.core.arrays import Array
from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.joints import JointColumns

Vec3 = tuple[float, float, float]
Box = tuple[float, float, float, float]
"""A rectangle on the floor in world axes: x_min, x_max, y_min, y_max [m]."""


class SubtaskKind(IntEnum):
    """Kinds of subtasks, numbered as in mshab/envs/planner.py. Padding in arrays is -1."""

    PICK = 0
    PLACE = 1
    NAVIGATE = 2
    OPEN = 3
    CLOSE = 4


PADDING = -1
KIND_NAMES: tuple[str, ...] = tuple(kind.name.lower() for kind in SubtaskKind)
TASKS: tuple[str, ...] = ("tidy_house", "prepare_groceries", "set_table")
STILLNESS: tuple[str, ...] = ("absolute", "published")
"""Whether speeds count by their size, or with their sign; see `TaskConfig.stillness`."""
TARGETS_PER_TASK: dict[str, int] = {"tidy_house": 5, "prepare_groceries": 3, "set_table": 2}


@dataclass(frozen=True)
class SubtaskConfig:
    """Limits of one kind of subtask: ``horizon`` in control steps, ``force_limit`` in N x control steps."""

    horizon: int
    force_limit: float


@dataclass(frozen=True)
class TaskConfig:
    """Every threshold of success and failure. Lengths [m], angles [rad], speeds [rad/s or m/s], forces [N]."""

    rest_qpos: tuple[float, ...]
    """(J,) joint positions of the robot at rest."""
    joints: JointColumns
    """Where base, posture and fingers are among the joints."""
    ee_rest_pos: Vec3
    """Where the tool centre rests, in the frame of the base link."""
    base_height: float
    """Height of the frame of the base link over the floor (mshab/envs/sequential_task.py: the base floats)."""
    pick: SubtaskConfig = SubtaskConfig(200, 5000.0)
    place: SubtaskConfig = SubtaskConfig(200, 7500.0)
    navigate: SubtaskConfig = SubtaskConfig(500, math.inf)
    open: SubtaskConfig = SubtaskConfig(200, 10000.0)
    close: SubtaskConfig = SubtaskConfig(200, 10000.0)
    continuous: bool = False
    """Evaluate a single subtask to its horizon: success does not end it, force is never reset."""
    hold_steps: int = -1
    """With ``continuous``: control steps that an episode goes on after its first success, or after the step in which
    its force exceeds the limit; -1 for all to the horizon. Demonstrations need no more."""

    ee_rest_tol: float = 0.05
    arm_tol: float = 0.2
    arm_tol_grasped: float = 0.6
    torso_tol: float = 0.01
    static_speed: float = 0.2
    static_base_speed: float = 0.05
    stillness: str = "absolute"
    """"absolute": no joint is faster than these, either way; "published": joints that move the other way count as
    still, however fast (the paper's App. A.2 and mani_skill/agents/robots/fetch/fetch.py take no absolute value)."""
    grasp_force: float = 0.5
    grasp_angle: float = math.radians(30.0)

    goal_type: Literal["sphere", "cylinder", "zone"] = "sphere"
    goal_tol: float = 0.15
    open_fraction_fridge: float = 0.75
    open_fraction_drawer: float = 0.9
    close_fraction: float = 0.01
    slightly_open_fraction: float = 0.1
    slightly_close_fraction: float = 0.05
    nav_distance: float = 2.0
    nav_bearing: float = 0.5
    ignore_arm: bool = True
    """Navigate is judged without arm and grasp; the default because teleport navigation does not move them."""

    def __post_init__(self) -> None:
        if len(self.rest_qpos) != self.joints.count:
            raise UsageError(
                f"rest_qpos needs the {self.joints.count} joint values of the robot, got {len(self.rest_qpos)}."
            )
        if self.goal_type not in ("sphere", "cylinder", "zone"):
            raise unknown_name("goal_type", self.goal_type, ("sphere", "cylinder", "zone"))
        if self.stillness not in STILLNESS:
            raise unknown_name("stillness", self.stillness, STILLNESS)

    def of(self, kind: int) -> SubtaskConfig:
        """Return the limits of one kind of subtask."""
        return (self.pick, self.place, self.navigate, self.open, self.close)[int(kind)]

    @property
    def horizons(self) -> tuple[int, ...]:
        """Horizon of every kind, indexed by ``SubtaskKind``."""
        return tuple(self.of(kind).horizon for kind in SubtaskKind)

    @property
    def force_limits(self) -> tuple[float, ...]:
        """Force limit of every kind, indexed by ``SubtaskKind``."""
        return tuple(self.of(kind).force_limit for kind in SubtaskKind)

    @property
    def rest_tolerances(self) -> tuple[float, ...]:
        """How far every joint of the posture may be from rest [m, rad]."""
        posture = self.joints.posture
        return tuple(
            self.torso_tol if column == self.joints.torso else self.arm_tol
            for column in range(posture.start, posture.stop)
        )

    def open_fraction(self, link: str) -> float:
        """Return the part of its range at which a link such as ``"fridge/top_door"`` counts as open."""
        return (
            self.open_fraction_fridge if link.startswith("fridge/") else self.open_fraction_drawer
        )


@dataclass(frozen=True)
class Target:
    """One object of a task: where it is, where it belongs, and what must be opened for it. World frame [m].

    ``start_link``/``goal_link`` name a link such as ``"kitchen_counter/drawer3"`` if the object starts in, or
    belongs into, a piece of furniture that opens; ``handle_pos`` is the handle of ``start_link``.
    """

    obj: str
    goal_pos: Vec3
    start_pos: Vec3 = (0.0, 0.0, 0.0)
    start_link: str = ""
    goal_link: str = ""
    handle_pos: Vec3 = (0.0, 0.0, 0.0)


GOAL_OF = "goal of "
"""Before the name of an object: the name of a navigation that leads to where the object goes."""


@dataclass(frozen=True)
class Subtask:
    """One step of a plan.

    ``obj``: object to pick or place, the object behind the link to open, or the object carried while navigating.
    ``link``: the link to open or close, the one the object is in or goes into, or the one to navigate to.
    ``goal_pos`` [m, world]: place goal, point to navigate to, handle at the start of the episode; unused by pick.
    ``toward``: what a navigation leads to, an object or a link, for display. ``goal_rect`` (4 corners, in order
    around the rectangle, world xy) is the place zone, needed for goal_type "zone" only.
    """

    kind: SubtaskKind
    obj: str = ""
    link: str = ""
    goal_pos: Vec3 = (0.0, 0.0, 0.0)
    must_hold: bool = False
    toward: str = ""
    goal_rect: tuple[tuple[float, float], ...] = ()

    @property
    def target(self) -> str:
        """Name of what the subtask is about: the object, the link, or what to navigate to."""
        if self.kind == SubtaskKind.NAVIGATE:
            return self.toward or self.obj or self.link
        return self.link if self.kind in (SubtaskKind.OPEN, SubtaskKind.CLOSE) else self.obj


@dataclass(frozen=True)
class TaskPlan:
    """The subtasks of one episode in order. ``task`` names the task the plan belongs to."""

    task: str
    subtasks: tuple[Subtask, ...]
    home: str = ""

    def only(self, index: int) -> TaskPlan:
        """Return the plan with just one of the subtasks, to train or evaluate it alone."""
        return replace(self, subtasks=(self.subtasks[index],))

    def indices(self, kind: int) -> tuple[int, ...]:
        """Return the positions of all subtasks of one kind."""
        return tuple(i for i, subtask in enumerate(self.subtasks) if subtask.kind == kind)


def _fetch_and_place(target: Target) -> list[Subtask]:
    """Navigate to the object, pick it, carry it to its goal, place it."""
    kind = SubtaskKind
    return [
        Subtask(
            kind.NAVIGATE, link=target.start_link, goal_pos=target.start_pos, toward=target.obj
        ),
        Subtask(kind.PICK, obj=target.obj, link=target.start_link),
        Subtask(
            kind.NAVIGATE,
            target.obj,
            target.goal_link,
            target.goal_pos,
            must_hold=True,
            toward=f"{GOAL_OF}{target.obj}",
        ),
        Subtask(kind.PLACE, obj=target.obj, link=target.goal_link, goal_pos=target.goal_pos),
    ]


def _open_fetch_place_close(target: Target) -> list[Subtask]:
    """The chain of one SetTable object: its drawer or door is opened before and closed after."""
    kind = SubtaskKind
    link = target.start_link
    handle = target.handle_pos
    if not link:
        raise UsageError(
            f"set_table needs a start_link for {target.obj!r}: the drawer or door it starts behind."
        )
    go = Subtask(kind.NAVIGATE, link=link, goal_pos=handle, toward=link)
    opening = Subtask(kind.OPEN, obj=target.obj, link=link, goal_pos=handle)
    closing = Subtask(kind.CLOSE, link=link, goal_pos=handle)
    return [go, opening, *_fetch_and_place(target), go, closing]


def chain(task: str, targets: Sequence[Target], home: str = "") -> TaskPlan:
    """Build the sequence of subtasks of a task (MS-HAB paper Sec. 3.2, mshab/utils/gen/gen_task_plans.py).

    Args:
        task: one of ``TASKS``.
        targets: the objects in the order they are handled: 5 for tidy_house, 3 for prepare_groceries, 2 for
            set_table (the bowl in the drawer, then the apple in the fridge). Imported episodes may have fewer.
        home: name of the home, carried along.

    Raises:
        UsageError: unknown task, wrong number of targets, or a set_table target without a link to open.
    """
    if task not in TASKS:
        raise unknown_name("task", task, TASKS)
    if not 1 <= len(targets) <= TARGETS_PER_TASK[task]:
        raise UsageError(
            f"{task} handles 1 to {TARGETS_PER_TASK[task]} objects, got {len(targets)} targets."
        )
    build = _open_fetch_place_close if task == "set_table" else _fetch_and_place
    return TaskPlan(task, tuple(subtask for target in targets for subtask in build(target)), home)


@dataclass(frozen=True)
class PlanArrays:
    """The plans of all worlds as arrays: W worlds, S subtasks, shorter plans padded with kind -1."""

    kind: Array
    """(W, S) int64."""
    length: Array
    """(W,) int64, number of real subtasks."""
    goal_pos: Array
    """(W, S, 3) [m, world]: place goal, navigation goal, handle at start; unused by pick."""
    must_hold: Array
    """(W, S) bool: this Navigate carries an object."""
    open_frac: Array
    """(W, S): part of the range at which the link counts as open."""
    box: Array
    """(W, S, 4) [m, world]: x_min, x_max, y_min, y_max the base must reach, all NaN without one."""
    goal_rect: Array | None = field(default=None)
    """(W, S, 4, 2) [m, world] corners of the place zones in order, for goal_type "zone"; NaN without one."""


def stack_plans(
    plans: Sequence[TaskPlan],
    config: TaskConfig,
    boxes: Sequence[Mapping[str, Box]] | None = None,
    min_subtasks: int = 1,
) -> PlanArrays:
    """Put the plans of W worlds into arrays, padded to the longest.

    Args:
        plans: one plan per world.
        config: gives the open fractions.
        boxes: per world, the floor area in front of a link from which it can be reached. It binds a Navigate with
            that ``link`` and nothing in the hand (mshab/envs/navigate.py).
        min_subtasks: pad to at least so many subtasks, so that array shapes do not depend on the plans drawn.
    """
    count = max(min_subtasks, *(len(plan.subtasks) for plan in plans))
    shape = (len(plans), count)
    kind = np.full(shape, PADDING, dtype=np.int64)
    goal_pos = np.zeros((*shape, 3))
    must_hold = np.zeros(shape, dtype=bool)
    open_frac = np.full(shape, config.open_fraction_drawer)
    box = np.full((*shape, 4), np.nan)
    rect = np.full((*shape, 4, 2), np.nan)
    for w, plan in enumerate(plans):
        for s, subtask in enumerate(plan.subtasks):
            kind[w, s] = subtask.kind
            goal_pos[w, s] = subtask.goal_pos
            must_hold[w, s] = subtask.must_hold
            open_frac[w, s] = config.open_fraction(subtask.link)
            if boxes is not None and subtask.kind == SubtaskKind.NAVIGATE and not subtask.must_hold:
                box[w, s] = boxes[w].get(subtask.link, (np.nan,) * 4)
            if subtask.goal_rect:
                rect[w, s] = subtask.goal_rect
    length = np.array([len(plan.subtasks) for plan in plans], dtype=np.int64)
    zones = rect if config.goal_type == "zone" else None
    return PlanArrays(kind, length, goal_pos, must_hold, open_frac, box, zones)


FRONT_AREAS: dict[str, tuple[float, float, float]] = {
    "fridge": (0.933, 1.833, 0.6),
    "kitchen_counter": (0.3, 1.5, 0.6),
}
"""Area from which furniture is opened: x from, x to, half-width [m], seen from the root of the fridge or from the
drawer link with +x to the front (mshab/utils/gen/gen_spawn_positions.py)."""


def front_box(link: str, pos_xy: tuple[float, float], yaw: float) -> Box:
    """Return the floor area in front of a link as a box along the world axes.

    Args:
        link: e.g. ``"kitchen_counter/drawer3"``.
        pos_xy: origin of the fridge, or of the closed drawer's link [m, world].
        yaw: heading of the front [rad]; for other than quarter turns the bounding box is returned.
    """
    furniture = link.split("/")[0]
    if furniture not in FRONT_AREAS:
        raise unknown_name("furniture", furniture, FRONT_AREAS)
    near, far, half = FRONT_AREAS[furniture]
    cos = math.cos(yaw)
    sin = math.sin(yaw)
    corners = [(x, y) for x in (near, far) for y in (-half, half)]
    xs = [pos_xy[0] + cos * x - sin * y for x, y in corners]
    ys = [pos_xy[1] + sin * x + cos * y for x, y in corners]
    return (min(xs), max(xs), min(ys), max(ys))
