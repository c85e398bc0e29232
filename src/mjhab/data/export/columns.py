"""Unit and frame of every column of states and actions, for cards and metadata of exports."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mjhab.data.store.episode_data import RunInfo
from mjhab.data.store.run_entries import ACTION_TABLE

BASE = "base of the robot"
_PARTS: dict[str, tuple[str, str]] = {
    "base_vel": ("m/s", BASE),
    "tcp_pose_wrt_base": ("m", BASE),
    "obj_pose_wrt_base": ("m", BASE),
    "goal_pos_wrt_base": ("m", BASE),
    "is_grasped": ("0 or 1", ""),
}
"""Unit and frame of the state's parts, but for joints."""
_TURNS = ("qw", "qx", "qy", "qz")
_OF_JOINTS = {"qpos": ("m", "rad"), "qvel": ("m/s", "rad/s")}
"""Units of a part with a column per joint: of joints that slide, and of those that turn."""
_SLIDES = ("torso", "finger", "slide")
"""What names of joints that slide hold."""


def state_columns(names: Sequence[str]) -> list[dict[str, str]]:
    """Name, unit and frame of every column of the state.

    Args:
        names: of the columns, see `describing.state_names`.
    """
    return [{"name": name, **_of_state(name)} for name in names]


def _of_state(name: str) -> dict[str, str]:
    part, _, column = name.partition(".")
    if part in _OF_JOINTS:
        slides = any(word in column for word in _SLIDES)
        return {"unit": _OF_JOINTS[part][0 if slides else 1], "frame": "joint"}
    unit, frame = _PARTS.get(part, ("", ""))
    # The parts hold a position and a quaternion in one, so the unit depends on the column.
    if column in _TURNS:
        unit = "quaternion, w first"
    # The velocity of the base mixes m/s with one turn about z.
    if column == "yaw":
        unit = "rad/s"
    return {"unit": unit, "frame": frame}


def action_columns(run: RunInfo) -> list[dict[str, Any]]:
    """Name, unit and frame of every entry of an action; of entries in -1..1 also the values in ``unit`` at both ends.

    Runs of older versions tell the names alone.
    """
    told = run.layout.get(ACTION_TABLE)
    if not told:
        return [{"name": name} for name in run.layout.get("actions", ())]
    known = ("name", "unit", "frame", "low", "high", "normalized")
    return [{key: entry[key] for key in known if key in entry} for entry in told]
