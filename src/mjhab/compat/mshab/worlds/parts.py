"""Attributes of the unwrapped environment that scripts read: plans, subtasks, robot, objects, furniture, views."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import torch

from mjhab.compat.mshab.files.matching import home_of
from mjhab.compat.mshab.files.plans import MsHabTaskPlan
from mjhab.compat.mshab.files.subtasks import MsHabSubtask
from mjhab.compat.mshab.worlds.arguments import Arguments
from mjhab.compat.mshab.worlds.draws import OwnDraw, PlanDraw
from mjhab.compat.mshab.worlds.observing import as_tensor
from mjhab.compat.mshab.worlds.own_plans import own_plan
from mjhab.compat.mshab.worlds.pose import PoseBatch
from mjhab.compat.mshab.worlds.states import actors, articulations
from mjhab.compat.mshab.worlds.views import (
    AgentView,
    ArticulationView,
    GoalView,
    ObjectView,
    single,
)
from mjhab.core.errors import UsageError
from mjhab.envs.loop import TaskLoop
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.tasks.subtasks.registry import number_of

HUMAN_VIEW_PX = 512


class SceneParts:
    """Part of `env.MsHabEnv`: what was drawn for the worlds, and what can be looked at in them.

    Args:
        worlds: the environment of ours.
        draw: which episodes its worlds get.
        arguments: those of MS-HAB's environment.
    """

    def __init__(
        self, worlds: TaskLoop, draw: PlanDraw | OwnDraw, arguments: Arguments
    ) -> None:
        self.worlds = worlds
        self._draw = draw
        self.arguments = arguments
        self._on_host = not worlds.metadata.get("tensors", False)
        self.device = torch.device("cpu") if self._on_host else worlds.device  # type: ignore[attr-defined]
        self.task_cfgs = arguments.configs
        self.subtask_cfg = arguments.configs.get(arguments.subtask)
        self.agent = AgentView(worlds, arguments.control_mode)
        self.resting_qpos = torch.tensor(
            worlds.layout.robot.rest_qpos[worlds.task_config.joints.posture],
            device=self.device,
        )
        self.base_task_plans: dict[tuple[str, ...], MsHabTaskPlan] = {
            _uids(plan): plan for plan in arguments.task_plans
        }
        self._forget_plans()

    # -- plans -----------------------------------------------------------------------------------------------------

    def _forget_plans(self) -> None:
        self._plans: list[MsHabTaskPlan] | None = None
        self._merged: list[MsHabSubtask] | None = None

    @property
    def task_plans(self) -> list[MsHabTaskPlan]:
        """(W,) the plan of every world's episode."""
        if self._plans is None:
            self._plans = [
                own_plan(self.worlds, world)
                if isinstance(self._draw, OwnDraw)
                else self._draw.plan(world)
                for world in range(self.worlds.num_envs)
            ]
            for plan in self._plans:
                self.base_task_plans.setdefault(_uids(plan), plan)
        return self._plans

    @property
    def task_plan(self) -> list[MsHabSubtask]:
        """The subtask at every place of the plans: that of world 0, with the uids of those of all worlds."""
        if self._merged is None:
            rows = zip(*(plan.subtasks for plan in self.task_plans), strict=True)
            self._merged = [_merged(row) for row in rows]
        return self._merged

    @property
    def bc_to_task_plans(self) -> dict[str, list[MsHabTaskPlan]]:
        """Plans by the name of their home."""
        found: dict[str, list[MsHabTaskPlan]] = {}
        for plan in self.base_task_plans.values():
            found.setdefault(plan.build_config_name or "", []).append(plan)
        return found

    @property
    def task_ids(self) -> torch.Tensor:
        """(S,) int64 number of the kind of every subtask: pick 0, place 1, navigate 2, open 3, close 4."""
        kinds = [number_of(subtask.type) for subtask in self.task_plan]
        return torch.tensor(kinds, device=self.device)

    @property
    def task_horizons(self) -> torch.Tensor:
        """(S,) int64 control steps of every subtask."""
        steps = [self.task_cfgs[subtask.type].horizon for subtask in self.task_plan]
        return torch.tensor(steps, device=self.device)

    @property
    def build_config_idxs(self) -> list[int]:
        """(W,) index of the home."""
        return self._draw.build_config_idxs

    @property
    def task_plan_idxs(self) -> torch.Tensor:
        """(W,) int64 index of the plan among those of its home."""
        return torch.as_tensor(self._draw.task_plan_idxs, device=self.device)

    @property
    def init_config_idxs(self) -> list[int]:
        """(W,) index of the arrangement of objects among those of all plans."""
        # Plans of our own generator become known when they are looked at.
        plans = self.task_plans
        names = sorted(
            {plan.init_config_name or "" for plan in self.base_task_plans.values()}
        )
        return [names.index(plan.init_config_name or "") for plan in plans]

    @property
    def spawn_selection_idxs(self) -> list[int | None]:
        """(W,) index of the start among those of its plan."""
        return self._draw.spawn_selection_idxs

    @property
    def instructions(self) -> list[str]:
        """(W,) what the active subtask asks for, as a sentence; mjhab's addition."""
        if not self._on_host:
            raise UsageError("sentences are made on the host: take sim_backend='cpu'.")
        return [str(text) for text in self.worlds.info()["instruction"]]

    # -- progress --------------------------------------------------------------------------------------------------

    @property
    def subtask_pointer(self) -> torch.Tensor:
        """(W,) int64 place of the active subtask in the plan; 0 in the environment of one."""
        pointer = as_tensor(self.worlds.progress.pointer).clone()
        return torch.zeros_like(pointer) if self.arguments.subtask else pointer

    @property
    def robot_cumulative_force(self) -> torch.Tensor:
        """(W,) [N x control steps] over the active subtask."""
        return single(self.worlds.progress.cumulative_force)

    # -- looked at -------------------------------------------------------------------------------------------------

    @property
    def subtask_objs(self) -> list[ObjectView | None]:
        """(S,) the object of every subtask, None without one."""
        slots = as_tensor(self.worlds.tables.obj)
        return [
            ObjectView(self.worlds, number) if (slots[:, number] >= 0).all() else None
            for number in range(len(self.task_plan))
        ]

    @property
    def subtask_goals(self) -> list[GoalView | None]:
        """(S,) where every subtask leads, None of a Pick."""
        return [
            None if subtask.type == "pick" else GoalView(self.worlds, number)
            for number, subtask in enumerate(self.task_plan)
        ]

    @property
    def subtask_articulations(self) -> list[ArticulationView | None]:
        """(S,) the furniture of every subtask whose drawer or door it needs, else None."""
        links = as_tensor(self.worlds.tables.link)
        return [
            ArticulationView(self.worlds, number)
            if (links[:, number] >= 0).all()
            else None
            for number in range(len(self.task_plan))
        ]

    @property
    def ee_rest_world_pose(self) -> PoseBatch:
        """World pose of the rest point of the hand."""
        rest = PoseBatch.create_from_pq(
            p=self.worlds.task_config.ee_rest_pos, device=self.device
        )
        return self.agent.base_link.pose * rest

    def get_state_dict(self) -> dict[str, Any]:
        """State of all worlds for reading, in ManiSkill's layout: see `states.actors` and `states.articulations`.

        Beside them MS-HAB's own (W,): indices of plans and homes, pointer, steps left and force. It does not hold all
        that the engine remembers: `mjhab` environments restore ``worlds.get_state(world)``.
        """
        homes = [home_of(plan.build_config_name) for plan in self.task_plans]
        return {
            "actors": actors(self.worlds),
            "articulations": articulations(self.worlds, homes),
            "task_plan_idxs": self.task_plan_idxs.clone(),
            "build_config_idxs": torch.tensor(self.build_config_idxs, device=self.device),
            "init_config_idxs": torch.tensor(self.init_config_idxs, device=self.device),
            "subtask_pointer": self.subtask_pointer,
            "robot_cumulative_force": self.robot_cumulative_force,
        }

    # Reached only for what nothing else has: it says where the answered names are listed.
    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        raise AttributeError(
            f"mjhab does not answer {name!r} of MS-HAB's environments. What it answers stands in docs/ms_hab.md; "
            "env.unwrapped.worlds is its own environment."
        )

    def set_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Refused: such a state lacks what our engine needs to go on exactly.

        Raises:
            UsageError: always.
        """
        raise UsageError(
            "states of get_state_dict are for reading; env.unwrapped.worlds.get_state(world) and set_state restore."
        )

    def render(self) -> torch.Tensor | None:
        """Human views (W, 512, 512, 3) uint8 of all worlds; None without a render mode.

        Raises:
            UsageError: the worlds are on a device.
        """
        if self.arguments.render_mode is None:
            return None
        if not self._on_host:
            raise UsageError(
                "views for humans are drawn on the host: take sim_backend='cpu'."
            )
        worlds = cast(SequentialTaskEnv, self.worlds)
        shown = worlds.render_worlds(range(worlds.num_envs), HUMAN_VIEW_PX, HUMAN_VIEW_PX)
        # torch takes no array with negative strides.
        return torch.from_numpy(np.ascontiguousarray(shown))


def _uids(plan: MsHabTaskPlan) -> tuple[str, ...]:
    return tuple(subtask.uid for subtask in plan.subtasks)


def _merged(row: tuple[MsHabSubtask, ...]) -> MsHabSubtask:
    """The first of parallel subtasks, with the uids of all of them."""
    # A copy, as the plan of world 0 keeps its own uids.
    shared = copy.copy(row[0])
    shared.composite_subtask_uids = [subtask.uid for subtask in row]
    return shared
