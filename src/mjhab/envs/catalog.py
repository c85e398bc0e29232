"""Environment ids, and the one place that builds environments."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import gymnasium

from mjhab.config.env import EnvConfig, TrainConfig
from mjhab.core.errors import UsageError, unknown_name
from mjhab.sim.backends import resolve

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

    from mjhab.envs.loop import TaskLoop
    from mjhab.envs.single import SingleEnv

CHAIN_IDS: dict[str, dict[str, Any]] = {
    "mjhab/TidyHouse-v1": {"task": "tidy_house"},
    "mjhab/PrepareGroceries-v1": {"task": "prepare_groceries"},
    "mjhab/SetTable-v1": {"task": "set_table"},
}
"""Gymnasium ids of the long-horizon tasks and the configuration each stands for."""
TRAIN_IDS: dict[str, dict[str, Any]] = {
    "mjhab/PickSubtaskTrain-v1": {"task": "tidy_house", "subtask": "pick"},
    "mjhab/PlaceSubtaskTrain-v1": {"task": "tidy_house", "subtask": "place"},
    "mjhab/OpenSubtaskTrain-v1": {"task": "set_table", "subtask": "open"},
    "mjhab/CloseSubtaskTrain-v1": {"task": "set_table", "subtask": "close"},
    "mjhab/NavigateSubtaskTrain-v1": {"task": "tidy_house", "subtask": "navigate"},
}
"""Gymnasium ids of the training environments; ``task`` may be given as an option, ``subtask`` is the id's."""
ENV_IDS = {**CHAIN_IDS, **TRAIN_IDS}


def make(**options: Any) -> Any:
    """Build a vector environment of a chain, or of one of its subtasks as it is evaluated.

    Args:
        **options: fields of `EnvConfig`.

    Returns:
        A `SequentialTaskEnv`, with backend warp a `DeviceEnv`.

    Raises:
        UsageError: unknown option or value; the message lists the valid ones.
    """
    return _build(EnvConfig(**_known(options, EnvConfig)))


def make_train(**options: Any) -> Any:
    """Build a vector environment in which one subtask is trained.

    Args:
        **options: fields of `TrainConfig`.

    Returns:
        A `SequentialTaskEnv`, with backend warp a `DeviceEnv`.

    Raises:
        UsageError: unknown option or value; the message lists the valid ones.
    """
    return _build(TrainConfig(**_known(options, TrainConfig)))


def _build(config: EnvConfig) -> TaskLoop:
    if resolve(config.backend) == "warp":
        from mjhab.envs.device.env import DeviceEnv

        return DeviceEnv(config)
    from mjhab.envs.sequential import SequentialTaskEnv

    return SequentialTaskEnv(config)


def make_by_id(env_id: str, **options: Any) -> Any:
    """Build the vector environment of a Gymnasium id, e.g. ``"mjhab/SetTable-v1"``."""
    if env_id not in ENV_IDS:
        raise unknown_name("environment id", env_id, ENV_IDS)
    build = make_train if env_id in TRAIN_IDS else make
    return build(**{**ENV_IDS[env_id], **options})


def make_single(*, env_id: str, **options: Any) -> SingleEnv:
    """Build one world of a Gymnasium id as a plain `gymnasium.Env`; entry point of ``gymnasium.make``."""
    from mjhab.envs.single import SingleEnv

    if options.get("backend") == "warp":
        raise UsageError(
            "one world as a plain gymnasium.Env runs on backend 'cpu'; use gymnasium.make_vec for 'warp'"
        )
    fixed = {"num_envs": 1, "autoreset": "disabled", "backend": "cpu"}
    return SingleEnv(make_by_id(env_id, **{**options, **fixed}))


def _make_vector(*, env_id: str, **options: Any) -> VectorEnv:
    return make_by_id(env_id, **options)


def _known(options: dict[str, Any], config: type[EnvConfig]) -> dict[str, Any]:
    names = [f.name for f in dataclasses.fields(config)]
    for name in options:
        if name not in names:
            raise unknown_name("environment option", name, names)
    return options


def register_envs() -> None:
    """Make the ids known to ``gymnasium.make`` and ``gymnasium.make_vec``; called when ``mjhab`` is imported."""
    for env_id in ENV_IDS:
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point="mjhab.envs.catalog:make_single",
                vector_entry_point="mjhab.envs.catalog:_make_vector",
                kwargs={"env_id": env_id},
            )
