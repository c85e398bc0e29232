"""Trajectories of whole tasks.

As there, an episode that does not succeed is written up to the control step before that in which the last of its
finished subtasks was done, and not at all if none was.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np

from mjhab.compat.mshab.wrappers.record import RecordEpisode
from mjhab.core.errors import fault, missing_field, unknown_name

FILTERS = ("any", "success", "min_success_subtasks")


class RecordEpisodeSequentialTask(RecordEpisode):
    """`RecordEpisode` for chains: trajectories have `info`, too, and are chosen by what was achieved.

    Args:
        env, output_dir: as in `RecordEpisode`.
        demo_filter: "any", "success" (the whole plan in some step), or "min_success_subtasks".
        min_success_subtasks: finished subtasks that the last filter asks for.
        **options: as in `RecordEpisode`.

    Raises:
        UsageError: the environment is of one subtask, an unknown filter, or a filter without its number.
    """

    WRITES_INFO: ClassVar[bool] = True

    def __init__(
        self,
        env: gymnasium.Env,
        output_dir: str | Path,
        demo_filter: str = "any",
        min_success_subtasks: int | None = None,
        **options: Any,
    ) -> None:
        if env.unwrapped.arguments.subtask:  # type: ignore[attr-defined]
            raise fault(type(self).__name__, "is for whole tasks.")
        if demo_filter not in FILTERS:
            raise unknown_name("demo_filter", demo_filter, FILTERS)
        if demo_filter == FILTERS[2] and min_success_subtasks is None:
            raise missing_field(
                "min_success_subtasks", "demo_filter 'min_success_subtasks'"
            )
        super().__init__(env, output_dir, **options)
        self.demo_filter = demo_filter
        self.min_success_subtasks = min_success_subtasks

    def _kept(self, steps: list[dict[str, Any]], world: int) -> int:
        after = [step["info"] for step in steps[1:]]
        if not after or any(info["success"][world] for info in after):
            return len(after)
        finished = [int(info["subtask"][world]) for info in after]
        least = {"any": 0, "success": len(self.base_env.task_plan)}
        if max(finished) < least.get(self.demo_filter, self.min_success_subtasks or 0):
            return 0
        # argmax gives the first of equal values: the step in which the last subtask was finished.
        return int(np.argmax(finished))
