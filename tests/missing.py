"""What a test may need that is not on every machine: on a user's it is skipped, where ``CI`` is set it fails."""

from __future__ import annotations

import importlib.util
import os
from typing import NoReturn

import pytest


def in_ci() -> bool:
    """Whether nothing may go untested in silence."""
    return os.environ.get("CI", "").lower() == "true"


def missing(why: str, whole_module: bool = False) -> NoReturn:
    """Skip a test, or all of a module that is being imported, and say why; in CI nothing may go untested in silence."""
    if in_ci():
        pytest.fail(why)
    pytest.skip(why, allow_module_level=whole_module)


def need_warp() -> None:
    """Called at the top of a module whose tests run on Warp; it is in the extras ``gpu`` and ``dev``."""
    if importlib.util.find_spec("mujoco_warp") is None:
        missing("mujoco_warp is absent: pip install 'mjhab[gpu]'", whole_module=True)


def need_onnxruntime() -> None:
    """Called at the top of a module whose tests run a frozen network; it is in the extras ``vision`` and ``dev``."""
    if importlib.util.find_spec("onnxruntime") is None:
        missing("onnxruntime is absent: pip install 'mjhab[vision]'", whole_module=True)
