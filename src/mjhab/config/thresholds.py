"""The thresholds in force: those of the paper, changed by the options of an environment."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from numbers import Real
from typing import Any

from mjhab.config.env import LIMITS, EnvConfig
from mjhab.core.conventions.names import WRAPPED
from mjhab.core.errors import unknown_name, wrong_value
from mjhab.core.typed.checks import check
from mjhab.robots.robot import Robot
from mjhab.tasks.subtasks.registry import SUBTASKS
from mjhab.tasks.thresholds import SubtaskConfig, TaskConfig


def task_config(config: EnvConfig, robot: Robot) -> TaskConfig:
    """The thresholds in force for a robot: those of the paper, changed by the options of ``config``.

    Raises:
        UsageError: an override names no threshold, or its value has the wrong type.
    """
    base = TaskConfig(
        rest_qpos=robot.rest_qpos,
        joints=robot.columns,
        ee_rest_pos=robot.tool_at_rest,
        base_height=robot.base_height,
        continuous=config.runs_to_horizon,
        # A teleport moves the base alone, so that nothing was asked of the arm on the way.
        ignore_arm=config.teleports,
        stillness=config.stillness,
        # With angles that are counted on over turns, the distance from rest is theirs, too, as in the original.
        endless=robot.endless if config.joint_angles == WRAPPED else (),
    )
    limits = {name: _limits(config, name) for name in SUBTASKS}
    changes: dict[str, Any] = {}
    for name, value in config.overrides.items():
        _override(base, changes, limits, name, value)
    return dataclasses.replace(base, **changes, limits=limits)


def _limits(config: EnvConfig, name: str) -> SubtaskConfig:
    """Horizon and force limit of a kind of subtask under the options of ``config``."""
    limits = SUBTASKS[name].limits
    train_horizon = SUBTASKS[name].train_horizon
    if config.trains and train_horizon is not None:
        limits = dataclasses.replace(limits, horizon=train_horizon)
    # After the one of training: an explicit horizon wins.
    if config.horizon:
        limits = dataclasses.replace(limits, horizon=config.horizon)
    if not config.force_limits:
        # Infinity in place of a switch: comparisons stay the same on every backend.
        limits = dataclasses.replace(limits, force_limit=math.inf)
    return limits


def _override(
    base: TaskConfig,
    changes: dict[str, Any],
    limits: dict[str, SubtaskConfig],
    name: str,
    value: Any,
) -> None:
    """Put one override into ``changes`` or ``limits``, checked against the type of the present value."""
    group, _, part = name.partition(".")
    owner: Any = limits.get(group) if part else base
    # These follow from the robot or from options of their own; a second place for them could contradict the first.
    apart = ("limits", "rest_qpos", "joints", "continuous", "stillness", "endless")
    plain = [f.name for f in dataclasses.fields(base) if f.name not in apart]
    nested = [f"{kind}.{limit}" for kind in SUBTASKS for limit in LIMITS]
    # Named apart, because it looks like a threshold and is one of a profile.
    if name == "stillness":
        raise wrong_value(
            "overrides",
            name,
            "other than stillness, an option of its own",
            f"Give stillness={value!r}.",
        )
    if name not in (*plain, *nested):
        raise unknown_name("task-config override", name, (*plain, *nested))
    present = getattr(owner, part or name)
    if isinstance(present, tuple) and isinstance(value, list):
        # Configurations that were recorded as JSON hold lists.
        value = tuple(value)
    new: Any = ()
    with contextlib.suppress(TypeError, ValueError):
        new = type(present)(value) if not isinstance(present, bool) else value
    # True == 1 in Python: a switch must not pass for a number, nor the other way round.
    good = isinstance(value, bool) == isinstance(present, bool) and new == value
    # A number may be as low as 0, or as its default, such as -1 for "without limit".
    if isinstance(present, int | float) and good:
        good = new >= min(0, present)
    if isinstance(present, tuple) and good:
        numbers = all(isinstance(n, Real) and math.isfinite(n) for n in new)
        # Another length would broadcast or cut off silently where the thresholds become arrays.
        good = numbers and len(new) == len(present)
    check(good, f"override {name}", value, f"like {present!r}")
    if part:
        limits[group] = dataclasses.replace(owner, **{part: new})
    else:
        changes[name] = new
