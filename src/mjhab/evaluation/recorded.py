"""Environments in which recorded episodes can be simulated again."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjhab.config.env import COMMANDED_FINGERS, EnvConfig
from mjhab.core.conventions.names import UNWRAPPED
from mjhab.core.errors import fault, missing_field, unknown_name
from mjhab.core.typed.options import with_tuples
from mjhab.data.record.provenance import TRAIN_MAKER
from mjhab.data.store.episode_data import RunInfo
from mjhab.scenes.pack_source import pack_request

if TYPE_CHECKING:
    from mjhab.envs.sequential import SequentialTaskEnv


def recorded_env(run: RunInfo, **options: Any) -> SequentialTaskEnv:
    """Make an environment (autoreset "disabled") that reproduces the episodes of a recorded run.

    Args:
        run: the recorded run.
        **options: further fields of `EnvConfig` that do not change an episode: worlds, threads, observations.

    Raises:
        UsageError: a file that the run was recorded with is missing, or its options are none of an environment.
    """
    from mjhab.envs import make, make_train

    recorded = run.config.get("env")
    if recorded is None:
        raise missing_field(
            "env", "config of the episodes", "Without it they cannot be simulated again."
        )
    config = with_tuples(recorded)
    known = {option.name for option in dataclasses.fields(EnvConfig)}
    for name in config:
        # What this call sets itself cannot come from the recording, too.
        if name not in known - options.keys() - {"autoreset"}:
            raise unknown_name("environment option of the recorded episodes", name, known)
    # What older versions had no option for.
    config.setdefault("joint_angles", UNWRAPPED)
    config.setdefault("teleport_fingers", COMMANDED_FINGERS)
    assets = pack_request(config.get("assets", "builtin"), recorded=True)
    config["assets"] = assets.as_json()
    # All option values of the profile are recorded; its name would only forbid other cameras.
    config.pop("profile", None)
    for name in ("episodes_file", "spawns"):
        missing = Path(str(config.get(name) or "."))
        if not missing.exists():
            raise fault(
                missing,
                f"does not exist; the episodes were recorded with this file ({name}).",
            )
    build = make_train if run.config.get("maker") == TRAIN_MAKER else make
    return build(**config, **options, autoreset="disabled")
