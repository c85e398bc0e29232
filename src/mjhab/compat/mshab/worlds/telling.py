"""`info` of MS-HAB, from the signals and the progress of our worlds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from mjhab.compat.mshab.files.subtasks import MsHabSubtaskConfig
from mjhab.compat.mshab.worlds.observing import as_tensor
from mjhab.core.arrays import cast, constant, namespace
from mjhab.data.imports.ms_hab_layout import (
    FINISHED,
    INFO_CHECKS,
    JOINT,
    PAIRWISE,
    checks_of,
)
from mjhab.envs.loop import TaskLoop
from mjhab.tasks.measure import at_goal
from mjhab.tasks.signals import Signals


class Telling:
    """Makes `info` for W worlds.

    A whole task has the entries of all its kinds of subtasks in every step, False or 0 where they do not belong to the
    active one; there they come and go with the subtasks that some world is at.

    Args:
        worlds: environment of ours.
        configs: limits by kind of subtask.
        kinds: kind of every subtask of the plan.
        tells_events: with the entries that labels of episodes need.
    """

    def __init__(
        self,
        worlds: TaskLoop,
        configs: Mapping[str, MsHabSubtaskConfig],
        kinds: Sequence[str],
        tells_events: bool,
    ) -> None:
        self._worlds = worlds
        self._kinds = tuple(kinds)
        self._alone = bool(worlds.config.subtask)
        found = {
            name: INFO_CHECKS[name] for kind in self._kinds for name in checks_of(kind)
        }
        self._checks = found
        jointed = {"open", "close"}.intersection(self._kinds)
        handled = {"pick", "place", *jointed}.intersection(self._kinds)
        self._joint = tells_events and bool(jointed)
        self._pairwise = tells_events and bool(handled)
        self._places = [i for i, kind in enumerate(self._kinds) if kind == "place"]
        self._navigates = self._alone and self._kinds == ("navigate",)
        # The counter that is read at a reset, too, costs a first subtask one step, as there.
        like = worlds.progress.steps_left
        self._horizons = constant(tuple(configs[kind].horizon for kind in kinds), like)

    def info(self, signals: Signals, elapsed: torch.Tensor) -> dict[str, torch.Tensor]:
        """`info` of the present state: tensors (W,), which later steps do not modify.

        Args:
            signals: those from which success was judged.
            elapsed: (W,) int32 control steps of the episodes.
        """
        worlds = self._worlds
        progress = worlds.progress
        pointer = progress.pointer
        success = worlds.success
        last = len(self._kinds)
        xp = namespace(pointer)
        within = signals.force_ok
        if self._alone:
            left = self._horizons[0] - 1 - progress.episode_step
            fail = ((left <= 0) & ~success) | ~within
            pointer = cast(success, pointer.dtype)
            kind = xp.where(success, FINISHED, worlds.focus.kind)
        else:
            success = (pointer >= last) & signals.placed_ok
            at = xp.minimum(pointer, last - 1)
            begun = cast(pointer == 0, progress.subtask_step.dtype)
            left = self._horizons[at] - progress.subtask_step - begun
            fail = ((left <= 0) & ~success) | ~within | ~signals.placed_ok
            kind = xp.where(success, FINISHED, worlds.focus.kind)
        told: dict[str, Any] = {
            "success": success,
            "fail": fail,
            "subtask": pointer,
            "subtask_type": kind,
            "subtasks_steps_left": left,
            "robot_force": _single(signals.robot_force),
            "robot_cumulative_force": _single(progress.cumulative_force),
        }
        for name, ours in self._checks.items():
            told[name] = getattr(signals, ours)
        if self._pairwise:
            told[PAIRWISE] = _single(signals.target_force)
        if self._joint:
            told |= self._joint_entries()
        if self._places and not self._alone:
            told |= self._progressive(pointer)
        if self._navigates:
            told["distance_from_goal"] = _single(worlds.goal_distance())
        info = {name: as_tensor(values) for name, values in told.items()}
        return {"elapsed_steps": elapsed, **info}

    def _joint_entries(self) -> dict[str, Any]:
        worlds = self._worlds
        low, high = worlds.sensing.joint_range(worlds.focus)
        now = worlds.sensing.joint_now(worlds.state, worlds.focus)
        return dict(zip(JOINT, map(_single, (now, low, high)), strict=True))

    def _progressive(self, pointer: Any) -> dict[str, Any]:
        """Whether the objects of finished Places are at their goals, an entry for each Place of the plan."""
        worlds = self._worlds
        plans = worlds.tables.arrays
        placed = worlds.sensing.plan_obj_pos(worlds.state, worlds.tables, worlds.focus)
        there = at_goal(placed, plans.goal_pos, plans.goal_rect, worlds.task_config)
        return {
            f"obj_at_goal_progressive_{at}": (pointer > at) & there[:, at]
            for at in self._places
        }


def _single(values: Any) -> Any:
    """Numbers as float32, as all of theirs are."""
    return cast(values, namespace(values).float32)
