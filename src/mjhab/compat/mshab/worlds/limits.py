"""Limits of success and failure (``task_cfgs``), as MS-HAB's environments have them, and as options of ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mjhab.compat.mshab.files.subtasks import (
    CloseSubtaskConfig,
    MsHabSubtaskConfig,
    NavigateSubtaskConfig,
    OpenSubtaskConfig,
    PickSubtaskConfig,
    PlaceSubtaskConfig,
)
from mjhab.core.errors import unknown_name, wrong_type, wrong_value

OPEN_SHARES = {"default": 0.9, "fridge": 0.75, "kitchen_counter": 0.9}
TRAIN_NAVIGATE_HORIZON = 1000
ENDLESS = 30_000
"""Horizon [control steps] of our subtasks below the layer, which has clocks of its own: never reached."""
_SHARED = {
    "ee_rest_thresh": "ee_rest_tol",
    "robot_resting_qpos_tolerance": "arm_tol",
    "robot_resting_qpos_tolerance_grasping": "arm_tol_grasped",
}
"""Limits of every kind of subtask there that are limits of all kinds together here."""


def default_configs(subtask: str) -> dict[str, MsHabSubtaskConfig]:
    """Limits by kind of subtask, of a training environment of ``subtask``, or ("") of a whole task."""
    alone = subtask == "navigate"
    return {
        "pick": PickSubtaskConfig(),
        "place": PlaceSubtaskConfig(),
        "navigate": NavigateSubtaskConfig(
            horizon=TRAIN_NAVIGATE_HORIZON if alone else 500
        ),
        "open": OpenSubtaskConfig(joint_qpos_open_thresh_frac=dict(OPEN_SHARES)),
        "close": CloseSubtaskConfig(),
    }


def changed_configs(
    configs: dict[str, MsHabSubtaskConfig], changes: Mapping[str, Any] | None
) -> None:
    """Change limits in place, as the argument ``task_cfgs`` asks: ``{"pick": {"horizon": 100}}``.

    Raises:
        UsageError: no such kind of subtask, its limits are no mapping, or a limit is no number.
    """
    given = {} if changes is None else changes
    if not isinstance(given, Mapping):
        raise wrong_type("task_cfgs", given, "a mapping of limits by subtask")
    for kind, values in given.items():
        if kind not in configs:
            raise unknown_name("subtask in task_cfgs", kind, configs)
        if not isinstance(values, Mapping):
            raise wrong_type(f"task_cfgs[{kind!r}]", values, "a mapping of limits")
        for name, value in values.items():
            is_number = isinstance(getattr(configs[kind], name, None), int | float)
            if is_number and not isinstance(value, int | float):
                raise wrong_type(f"task_cfgs[{kind!r}][{name!r}]", value, "a number")
        # Types are checked first, as the class compares numbers without looking at them.
        configs[kind].update(values)
        # The rules of the class hold for what was changed, too.
        configs[kind].__post_init__()


def overrides_of(
    configs: Mapping[str, MsHabSubtaskConfig], kinds: Sequence[str]
) -> dict[str, Any]:
    """Our ``overrides`` for the limits of ``kinds``, the subtasks that an environment has.

    Raises:
        UsageError: kinds that run in one environment differ in a limit that is one number for all of them here.
    """
    options: dict[str, Any] = {}
    for name, ours in _SHARED.items():
        values = {kind: float(getattr(configs[kind], name)) for kind in kinds}
        if len(set(values.values())) > 1:
            raise wrong_value(
                f"task_cfgs: {name}",
                values,
                "one number for all subtasks of an environment",
            )
        options[ours] = next(iter(values.values()))
    for kind in kinds:
        config = configs[kind]
        options[f"{kind}.force_limit"] = float(config.robot_cumulative_force_limit)
        if isinstance(config, PlaceSubtaskConfig):
            options["goal_tol"] = float(config.obj_goal_thresh)
            options["goal_type"] = config.goal_type
        elif isinstance(config, NavigateSubtaskConfig):
            options["nav_distance"] = float(config.navigated_successfully_dist)
            options["nav_bearing"] = float(config.navigated_successfully_rot)
            options["ignore_arm"] = bool(config.ignore_arm_checkers)
        elif isinstance(config, OpenSubtaskConfig):
            shares = config.joint_qpos_open_thresh_frac
            other = shares["default"]
            options["open_fraction_door"] = shares.get("fridge", other)
            options["open_fraction_drawer"] = shares.get("kitchen_counter", other)
        elif isinstance(config, CloseSubtaskConfig):
            options["close_fraction"] = float(config.joint_qpos_close_thresh_frac)
    return options
