"""Where MS-HAB's files lie: ManiSkill's folder of assets, and the rearrangement data in it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from mjhab.compat.mshab.files.plans import TaskPlan, root_above

VARIABLE = "MS_ASSET_DIR"
"""Variable of the environment that names ManiSkill's folder, whose folder ``data`` holds the assets."""
_REPLICA_CAD = ("scene_datasets", "replica_cad_dataset")
_REARRANGE = "rearrange"


def asset_dir() -> Path:
    """ManiSkill's folder of assets: ``$MS_ASSET_DIR/data``, else ``~/.maniskill/data``."""
    given = os.environ.get(VARIABLE)
    return (Path(given) if given else Path.home() / ".maniskill") / "data"


def replica_cad_dir() -> Path:
    """ReplicaCAD among these assets."""
    return asset_dir().joinpath(*_REPLICA_CAD)


def rearrange_dir(plans: Sequence[TaskPlan], spawn_file: Path | None) -> Path:
    """The folder of rearrangement data that plans belong to.

    It is that from which their file was read, else that which holds the spawn data, else the one among the assets.
    """
    if plans and plans[0].root is not None:
        return plans[0].root
    above = None if spawn_file is None else root_above(spawn_file, "spawn_data")
    return above or replica_cad_dir() / _REARRANGE
