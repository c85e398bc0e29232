"""Which plan and which start every world gets at a reset: drawn as in MS-HAB, or mjhab's own episodes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mjhab.compat.mshab.files.plan_starts import PlanStarts
from mjhab.compat.mshab.files.plans import MsHabTaskPlan
from mjhab.compat.mshab.worlds.arguments import Arguments
from mjhab.core.errors import UsageError, wrong_value
from mjhab.core.seeding import stream
from mjhab.core.typed.checks import check

FIRST_SEED = 2022
"""Seed of the draws before a reset gives one (mani_skill/envs/sapien_env.py)."""


class PlanDraw:
    """Draws a plan of each world's home, and one of the plan's starts, uniformly.

    Attributes:
        build_config_idxs: (W,) list, index of each world's home.
        task_plan_idxs: (W,) int64, index of its plan among those of its home.
        spawn_selection_idxs: (W,) list, index of its start among those of the plan.

    Args:
        arguments: of the environment.
        starts: of its plans.
        homes: index of every home by the name that plans give it.

    Raises:
        UsageError: the number of worlds is no multiple of the number of homes, where that is asked for.
    """

    def __init__(
        self, arguments: Arguments, starts: PlanStarts, homes: Mapping[str, int]
    ) -> None:
        self._arguments = arguments
        self._starts = starts
        self._worlds = arguments.num_envs
        self._plans: dict[int, list[int]] = defaultdict(list)
        for number, plan in enumerate(starts.plans):
            self._plans[homes[plan.build_config_name or ""]].append(number)
        count = len(self._plans)
        if arguments.equal_homes and self._worlds % count:
            raise wrong_value(
                "num_envs",
                self._worlds,
                f"a multiple of {count}, the number of homes in the plans",
                "Or give require_build_configs_repeated_equally_across_envs=False.",
            )
        self._seeds = [FIRST_SEED] * self._worlds
        self._drawn = [0] * self._worlds
        self.task_plan_idxs = np.zeros(self._worlds, np.int64)
        self.spawn_selection_idxs: list[int | None] = [None] * self._worlds
        self.build(None)

    def build(self, chosen: Sequence[int] | None) -> None:
        """Give every world its home: ``chosen``, or as the arguments say."""
        known = sorted(self._plans)
        if chosen is not None:
            listed = [int(index) for index in chosen]
            check(
                len(listed) == self._worlds and set(listed) <= set(known),
                "build_config_idxs",
                listed,
                f"{self._worlds} of {known}, the homes of the plans",
            )
            self.build_config_idxs = listed
        elif self._arguments.random_homes:
            drawn = stream(self._seeds[0], "mshab", "homes").choice(known, self._worlds)
            self.build_config_idxs = [int(index) for index in drawn]
        else:
            copies = -(-self._worlds // len(known))
            self.build_config_idxs = np.repeat(known, copies)[: self._worlds].tolist()

    def begin(self, seeds: Sequence[int] | None, worlds: Sequence[int]) -> None:
        """Let the next draws of some worlds follow from ``seeds`` (W,); None goes on."""
        if seeds is None:
            return
        for world in worlds:
            self._seeds[world] = seeds[world]
            self._drawn[world] = 0

    def rows(self, worlds: Sequence[int], options: Mapping[str, Any]) -> list[int]:
        """Draw the episodes of some worlds, one each.

        Args:
            worlds: which begin an episode.
            options: of the reset: "task_plan_idxs" (W,) if all worlds begin one, "spawn_selection_idxs", one per world
                that does, None where it is to be drawn.
        """
        plans = options.get("task_plan_idxs") if len(worlds) == self._worlds else None
        spawns = options.get("spawn_selection_idxs")
        if spawns is not None and len(spawns) != len(worlds):
            raise wrong_value(
                "spawn_selection_idxs", spawns, f"{len(worlds)}, one per reset world"
            )
        if plans is not None and len(plans) != self._worlds:
            raise wrong_value("task_plan_idxs", plans, f"{self._worlds}, one per world")
        # Scripts may still hold the array of the last reset.
        self.task_plan_idxs = self.task_plan_idxs.copy()
        return [
            self._row(
                world,
                self._numbers(world),
                None if plans is None else int(plans[world]),
                None if spawns is None else spawns[at],
            )
            for at, world in enumerate(worlds)
        ]

    def _row(
        self, world: int, drawn: np.ndarray, plan: int | None, spawn: int | None
    ) -> int:
        there = self._plans[self.build_config_idxs[world]]
        if plan is None:
            plan = int(drawn[0] * len(there))
        check(
            0 <= plan < len(there),
            "task_plan_idxs",
            plan,
            f"below {len(there)}, the plans of home {self.build_config_idxs[world]}",
        )
        number = there[plan]
        count = self._starts.spawns(number)
        spawn = int(drawn[1] * count) if spawn is None else int(spawn)
        check(0 <= spawn < count, "spawn_selection_idxs", spawn, f"below {count}")
        self.task_plan_idxs[world] = plan
        self.spawn_selection_idxs[world] = spawn
        return self._starts.of(number, spawn)

    def plan(self, world: int) -> MsHabTaskPlan:
        """The plan of a world."""
        there = self._plans[self.build_config_idxs[world]]
        return self._starts.plans[there[self.task_plan_idxs[world]]]

    def _numbers(self, world: int) -> np.ndarray:
        """Two numbers in [0, 1) for the next episode of a world, whatever other worlds do."""
        self._drawn[world] += 1
        key = (world, self._drawn[world])
        return stream(self._seeds[world], "mshab", *key).random(2)


class OwnDraw:
    """Episodes of mjhab's generator, for environments without plans: the k-th of a world follows its (k-1)-th."""

    def __init__(self, num_envs: int) -> None:
        self._worlds = num_envs
        self.build_config_idxs = [0] * num_envs
        self.task_plan_idxs = np.zeros(num_envs, np.int64)
        self.spawn_selection_idxs: list[int | None] = [0] * num_envs

    def refuse(self, options: Mapping[str, Any]) -> None:
        """Refuse reset options that choose homes, plans or starts: without plans there are none.

        Raises:
            UsageError: one is given.
        """
        for name in ("build_config_idxs", "task_plan_idxs", "spawn_selection_idxs"):
            if options.get(name) is not None:
                raise UsageError(
                    f"{name} needs task_plans; without them give mjhab_options={{'home': NAME}}."
                )
