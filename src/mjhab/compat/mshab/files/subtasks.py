"""Subtasks of task plans, under the names and fields of ``mshab.envs.planner``.

Scripts make and read these objects, and their files hold the fields by name. They say what is to be done where;
`files.starts` turns them into mjhab's own plans and starts. Lengths [m], world frame with +z up;
objects and furniture are named by kind and number, ``024_bowl-0``.
"""

from __future__ import annotations

import math
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from mjhab.core.errors import unknown_name, warn_once, wrong_value
from mjhab.core.typed.checks import check

Point = Sequence[float]
"""x, y, z [m]."""
CORNERS = 4
RIGHT_ANGLE_TOLERANCE_RAD = math.radians(1e-3)
"""Largest deviation of a zone's corners from right angles."""
_UID_CHARACTERS = 6


@dataclass
class ArticulationConfig:
    """A drawer or door: the piece of furniture by kind and by name, number of the link (root 0) and of its joint."""

    articulation_type: str
    articulation_id: str
    articulation_handle_link_idx: int
    articulation_handle_active_joint_idx: int


@dataclass
class MsHabSubtask:
    """What all subtasks have: kind, name, and names of those that run beside it in parallel worlds."""

    KIND: ClassVar[str] = ""

    type: str = field(init=False)
    uid: str = field(init=False)
    composite_subtask_uids: list[str] = field(init=False)

    def __post_init__(self) -> None:
        self.type = self.KIND
        if self.type not in SUBTASK_CLASSES:
            raise unknown_name("type of a subtask", self.type, SUBTASK_CLASSES)
        if getattr(self, "uid", None) is None:
            self.uid = f"{self.type}_{uuid.uuid4().hex[:_UID_CHARACTERS]}"
        if getattr(self, "composite_subtask_uids", None) is None:
            self.composite_subtask_uids = [self.uid]


@dataclass
class PickSubtask(MsHabSubtask):
    """Lift an object; ``articulation_config`` is of the drawer or door that it is behind."""

    KIND: ClassVar[str] = "pick"

    obj_id: str
    articulation_config: ArticulationConfig | None = None


@dataclass
class PlaceSubtask(MsHabSubtask):
    """Put a held object at a point. A zone has four corners in order; numbers may be texts with commas.

    Raises:
        UsageError: the corners are not those of a rectangle.
    """

    KIND: ClassVar[str] = "place"

    obj_id: str
    goal_rectangle_corners: Any = None
    goal_pos: Any = None
    validate_goal_rectangle_corners: bool = True
    articulation_config: ArticulationConfig | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.validate_goal_rectangle_corners and (
            self.goal_rectangle_corners is not None
        ):
            self.goal_rectangle_corners = _rectangle(self.goal_rectangle_corners)
        if isinstance(self.goal_pos, str):
            self.goal_pos = _numbers("goal_pos", self.goal_pos)


@dataclass
class NavigateSubtask(MsHabSubtask):
    """Drive to a point or to a piece of furniture, with an object in the hand if ``obj_id`` names one.

    ``remove_obj_id``: object that is taken out of the home, so that a drawer behind the goal is empty.
    """

    KIND: ClassVar[str] = "navigate"

    obj_id: str | None = None
    goal_pos: Any = None
    prev_goal_pos: Any = None
    articulation_config: ArticulationConfig | None = None
    remove_obj_id: str | None = None


@dataclass
class OpenSubtask(MsHabSubtask, ArticulationConfig):
    """Open a drawer or door, behind which an object is; the handle is a point in the link's frame (+y up)."""

    KIND: ClassVar[str] = "open"

    obj_id: str
    articulation_relative_handle_pos: Any


@dataclass
class CloseSubtask(MsHabSubtask, ArticulationConfig):
    """Close a drawer or door; see `OpenSubtask` and `NavigateSubtask`."""

    KIND: ClassVar[str] = "close"

    articulation_relative_handle_pos: Any
    remove_obj_id: str | None = None


SUBTASK_CLASSES: dict[str, type[MsHabSubtask]] = {
    kind.KIND: kind
    for kind in (
        PickSubtask,
        PlaceSubtask,
        NavigateSubtask,
        OpenSubtask,
        CloseSubtask,
    )
}
"""Class of every kind of subtask."""


def _numbers(name: str, given: str | Point) -> list[float]:
    """A point that may be a text such as ``"1.0, 2, 0.5"``."""
    try:
        parts = given.split(",") if isinstance(given, str) else given
        point = [float(part) for part in parts]
    except (TypeError, ValueError) as error:
        raise wrong_value(name, given, "three numbers [m]") from error
    return point


def _rectangle(given: Any) -> list[list[float]]:
    """Corners of a zone that were checked.

    Raises:
        UsageError: they are not four, or two neighbouring sides are not at a right angle.
    """
    name = "goal_rectangle_corners"
    try:
        corners = [_numbers(name, corner) for corner in given]
    except TypeError as error:
        raise wrong_value(name, given, f"{CORNERS} points") from error
    if len(corners) != CORNERS or len({len(corner) for corner in corners}) != 1:
        raise wrong_value(name, given, f"{CORNERS} points")
    points = np.array(corners)
    along = np.roll(points, -1, axis=0) - points
    back = np.roll(points, 1, axis=0) - points
    lengths = np.linalg.norm(along, axis=1) * np.linalg.norm(back, axis=1)
    # Two equal corners have no angle: theirs is NaN, which no tolerance admits.
    with np.errstate(invalid="ignore", divide="ignore"):
        angles = np.arccos(np.clip(np.sum(along * back, axis=1) / lengths, -1.0, 1.0))
    if not (np.abs(angles - np.pi / 2) < RIGHT_ANGLE_TOLERANCE_RAD).all():
        raise wrong_value(name, given, "the corners of a rectangle in order around it")
    return corners


# -- limits of success and failure -------------------------------------------------------------------------------------


@dataclass
class MsHabSubtaskConfig:
    """Limits that all kinds of subtasks have: horizon [control steps], force [N x control steps], distances from rest.

    Raises:
        UsageError: a number is negative, or the horizon is 0.
    """

    task_id: int
    horizon: int = 200
    robot_cumulative_force_limit: float = math.inf
    ee_rest_thresh: float = 0.05
    robot_resting_qpos_tolerance: float = 0.2
    robot_resting_qpos_tolerance_grasping: float = 0.6

    def __post_init__(self) -> None:
        check(self.horizon > 0, "horizon", self.horizon, "1 control step or more")
        for name in (
            "ee_rest_thresh",
            "robot_resting_qpos_tolerance",
            "robot_resting_qpos_tolerance_grasping",
        ):
            check(getattr(self, name) >= 0, name, getattr(self, name), "0 or more")

    def update(self, update_dict: Mapping[str, Any]) -> MsHabSubtaskConfig:
        """Set fields by name and return itself; a name that is no field is told once and left out."""
        for name, value in update_dict.items():
            if getattr(self, name, None) is None:
                warn_once(f"{type(self).__name__} has no field {name!r}; it is left out.")
            else:
                setattr(self, name, value)
        return self


@dataclass
class PickSubtaskConfig(MsHabSubtaskConfig):
    """Limits of Pick."""

    task_id: int = 0
    robot_cumulative_force_limit: float = 5000


@dataclass
class PlaceSubtaskConfig(MsHabSubtaskConfig):
    """Limits of Place. ``goal_type``: form of the goal, of which ``obj_goal_thresh`` [m] is radius or half height.

    Raises:
        UsageError: an unknown goal type.
    """

    task_id: int = 1
    obj_goal_thresh: float = 0.15
    goal_type: str = "sphere"
    robot_cumulative_force_limit: float = 7500

    def __post_init__(self) -> None:
        super().__post_init__()
        check(
            self.obj_goal_thresh >= 0,
            "obj_goal_thresh",
            self.obj_goal_thresh,
            "0 or more [m]",
        )
        if self.goal_type not in ("zone", "cylinder", "sphere"):
            raise unknown_name(
                "goal_type", self.goal_type, ("zone", "cylinder", "sphere")
            )


@dataclass
class NavigateSubtaskConfig(MsHabSubtaskConfig):
    """Limits of Navigate: distance [m] and bearing [rad] of the goal; whether arm and grasp count."""

    task_id: int = 2
    horizon: int = 500
    navigated_successfully_dist: float = 2
    navigated_successfully_rot: float = 0.5
    ignore_arm_checkers: bool = False


@dataclass
class OpenSubtaskConfig(MsHabSubtaskConfig):
    """Limits of Open. ``joint_qpos_open_thresh_frac``: share of the joint's range by kind of furniture, or "default".

    Raises:
        UsageError: there is no share for "default", or one is not from 0 to 1.
    """

    task_id: int = 3
    robot_cumulative_force_limit: float = 10_000
    joint_qpos_open_thresh_frac: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        name = "joint_qpos_open_thresh_frac"
        shares = self.joint_qpos_open_thresh_frac
        check("default" in shares, name, shares, 'shares by furniture, with a "default"')
        for furniture, share in shares.items():
            check(
                isinstance(share, float) and 0 <= share <= 1,
                f"{name}[{furniture!r}]",
                share,
                "a number from 0.0 to 1.0",
            )


@dataclass
class CloseSubtaskConfig(MsHabSubtaskConfig):
    """Limits of Close: share of the joint's range below which it is closed."""

    task_id: int = 4
    robot_cumulative_force_limit: float = 10_000
    joint_qpos_close_thresh_frac: float = 0.01
