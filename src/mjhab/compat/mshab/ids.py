"""MS-HAB's environment ids."""

from __future__ import annotations

import gymnasium
from gymnasium.envs.registration import WrapperSpec

IDS: dict[str, tuple[str, int | None]] = {
    "PickSubtaskTrain-v0": ("PickSubtaskTrainEnv", 200),
    "PlaceSubtaskTrain-v0": ("PlaceSubtaskTrainEnv", 200),
    "OpenSubtaskTrain-v0": ("OpenSubtaskTrainEnv", 200),
    "CloseSubtaskTrain-v0": ("CloseSubtaskTrainEnv", 200),
    "NavigateSubtaskTrain-v0": ("NavigateSubtaskTrainEnv", 1000),
    "SequentialTask-v0": ("MsHabSequentialTaskEnv", None),
}
"""Id to its class in `worlds.kinds`, and the control steps of an episode that is not told another number."""

_LIMIT = WrapperSpec(
    "TimeLimit", "mjhab.compat.mshab.wrappers.time_limit:TimeLimitWrapper", {}
)


def register_ids() -> None:
    """Register the ids with ``gymnasium.make``; those that are taken stay as they are."""
    for env_id, (made, steps) in IDS.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point=f"mjhab.compat.mshab.worlds.kinds:{made}",
                max_episode_steps=steps,
                # Both of Gymnasium's wrappers expect one world and arrays; these are tensors of many.
                order_enforce=False,
                disable_env_checker=True,
                additional_wrappers=(_LIMIT,),
            )
