"""Paths of the robosuite files that describe the robot. robosuite itself is not imported."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from mjhab.core.errors import MjhabError
from mjhab.core.machine import pip_install

PACKAGE = "robosuite"
INSTALL = pip_install("--no-deps", "robosuite==1.5.2")


def robosuite_file(name: str) -> Path:
    """Return the path of a file below the assets folder of robosuite.

    Raises:
        MjhabError: robosuite is not installed, or has no such file.
    """
    # find_spec locates the package without running it: its imports need much that the files do not.
    found = importlib.util.find_spec(PACKAGE)
    if found is None or not found.submodule_search_locations:
        raise MjhabError(
            "the robot 'panda_omron' is made of files of the package robosuite, which is not installed; "
            f"run: {INSTALL}"
        )
    path = Path(next(iter(found.submodule_search_locations))) / "models" / "assets" / name
    if not path.is_file():
        raise MjhabError(f"robosuite has no file {path}; run: {INSTALL}")
    return path
