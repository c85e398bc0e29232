"""mjhab: the Home Assistant Benchmark with low-level whole-body control, on MuJoCo.

Importing the package makes its ids known to Gymnasium and loads neither mujoco nor any other heavy library: the names
below are looked up when they are first used.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjhab.core.version import __version__

if TYPE_CHECKING:
    from mjhab.envs import make, make_train
    from mjhab.evaluation.evaluate import evaluate
    from mjhab.evaluation.generate import generate
    from mjhab.experts import make_expert
    from mjhab.robots.registry import register_robot
    from mjhab.scenes.pack_source import PackRequest, PackSource, register_pack
    from mjhab.scenes.packs import open_pack

__all__ = [
    "PackRequest",
    "PackSource",
    "__version__",
    "evaluate",
    "generate",
    "make",
    "make_expert",
    "make_train",
    "open_pack",
    "register_pack",
    "register_robot",
]

_LAZY = {
    "PackRequest": "mjhab.scenes.pack_source",
    "PackSource": "mjhab.scenes.pack_source",
    "evaluate": "mjhab.evaluation.evaluate",
    "generate": "mjhab.evaluation.generate",
    "make": "mjhab.envs",
    "make_train": "mjhab.envs",
    "register_robot": "mjhab.robots.registry",
    "make_expert": "mjhab.experts",
    "open_pack": "mjhab.scenes.packs",
    "register_pack": "mjhab.scenes.pack_source",
}
_PACKAGES = frozenset(
    {
        "assets",
        "bench",
        "cli",
        "config",
        "core",
        "data",
        "envs",
        "episodes",
        "evaluation",
        "experts",
        "integrations",
        "layout",
        "learning",
        "render",
        "reports",
        "robots",
        "rollout",
        "scenes",
        "serving",
        "sim",
        "tasks",
    }
)


def __getattr__(name: str) -> Any:
    """Import the home of a lazy name on first use (PEP 562)."""
    if name in _PACKAGES:
        return importlib.import_module(f"mjhab.{name}")
    if name not in _LAZY:
        raise AttributeError(f"module 'mjhab' has no attribute {name!r}")
    value = getattr(importlib.import_module(_LAZY[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY, *_PACKAGES})


def register_all() -> None:
    """Load plugins and make the ids known to Gymnasium: done when ``mjhab`` is imported, done once."""
    from mjhab.core.plugins import load_plugins
    from mjhab.envs.catalog import register_envs

    load_plugins()
    register_envs()


def _is_command() -> bool:
    """Whether the process is the ``mjhab`` command, which registers when it runs something: ``--help`` is quick."""
    # Not sys.argv: worker processes of the command are given it, too.
    return "mjhab.cli.main" in sys.orig_argv or Path(*sys.orig_argv[1:2]).stem == "mjhab"


if not _is_command():
    register_all()
