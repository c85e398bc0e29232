"""Environments like those that recorded episodes come from."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjhab.core.errors import UsageError
from mjhab.data.record.provenance import TRAIN_MAKER
from mjhab.data.store.episode_data import RunInfo

if TYPE_CHECKING:
    from mjhab.envs.sequential import SequentialTaskEnv


def recorded_env(run: RunInfo, **options: Any) -> SequentialTaskEnv:
    """An environment (autoreset "disabled") in which the episodes of a run happen again.

    Args:
        run: what made the episodes.
        **options: further fields of `EnvConfig` that change nothing in an episode: worlds, threads, what is seen.

    Raises:
        UsageError: a file that the run was recorded with is not there.
    """
    from mjhab.envs import make, make_train

    # Shards tell lists, configurations hold tuples.
    config = {key: tuple(v) if isinstance(v, list) else v for key, v in run.config["env"].items()}
    # The options that a profile gives values are recorded; its name would forbid other cameras.
    config.pop("profile", None)
    for name in ("episodes_file", "spawns"):
        missing = Path(str(config.get(name) or "."))
        if not missing.exists():
            raise UsageError(
                f"the episodes were recorded with the file {missing} ({name}), which is not there."
            )
    build = make_train if run.config.get("maker") == TRAIN_MAKER else make
    return build(**config, **options, autoreset="disabled")
