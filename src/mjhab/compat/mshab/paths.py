"""Folders in which MS-HAB and ManiSkill look for their files."""

from __future__ import annotations

import os
from pathlib import Path

HOME = Path(os.getenv("MS_ASSET_DIR", str(Path.home() / ".maniskill")))
"""What ``$MS_ASSET_DIR`` names, else ``~/.maniskill``."""
ASSET_DIR = HOME / "data"
DEMO_DIR = HOME / "demos"
PACKAGE_ASSET_DIR = ASSET_DIR / "package"
"""ManiSkill's package has files of robots and homes there; ours has none, so that scripts find nothing."""
REPLICA_CAD = ASSET_DIR / "scene_datasets" / "replica_cad_dataset"
REARRANGE = REPLICA_CAD / "rearrange"
"""Task plans, spawn data and episodes, see `files`."""
