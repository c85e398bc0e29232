"""MS-HAB's environment ids."""

from __future__ import annotations

import gymnasium
from gymnasium.envs.registration import WrapperSpec

IDS: dict[str, tuple[str, int | None]] = {
    "PickSubtaskTrain-v0": ("pick", 200),
    "PlaceSubtaskTrain-v0": ("place", 200),
    "OpenSubtaskTrain-v0": ("open", 200),
    "CloseSubtaskTrain-v0": ("close", 200),
    "NavigateSubtaskTrain-v0": ("navigate", 1000),
    "SequentialTask-v0": ("", None),
}
"""Id to its subtask ("" for a whole task), and the number of control steps of an episode that is not told another."""

_LIMIT = WrapperSpec(
    "TimeLimit", "mjhab.compat.mshab.wrappers.time_limit:TimeLimitWrapper", {}
)


def register_ids() -> None:
    """Register the ids with ``gymnasium.make``; those that are taken stay as they are."""
    for env_id, (subtask, steps) in IDS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point="mjhab.compat.mshab.worlds.env:MsHabEnv",
                max_episode_steps=steps,
                order_enforce=False,
                disable_env_checker=True,
                additional_wrappers=(_LIMIT,),
                kwargs={"subtask": subtask},
            )
