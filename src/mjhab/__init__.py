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
    from mjhab.config.perturbing import Perturbation, Quantity, register_perturbation
    from mjhab.envs import make, make_train
    from mjhab.evaluation.compare import compare
    from mjhab.evaluation.datasets.chain_starts import chain_starts
    from mjhab.evaluation.datasets.export import export_lerobot, export_maniskill
    from mjhab.evaluation.datasets.label import label
    from mjhab.evaluation.datasets.replay import replay
    from mjhab.evaluation.evaluate import evaluate
    from mjhab.evaluation.generate import generate
    from mjhab.evaluation.publishing.make import make_dataset
    from mjhab.evaluation.shots.shoot import shot
    from mjhab.experts import make_expert
    from mjhab.learning.train import train
    from mjhab.robots.controllers.modes import ControlMode, register_control_mode
    from mjhab.robots.registry import register_robot
    from mjhab.scenes.home_files import home_pack
    from mjhab.scenes.object_glb import object_from_glb
    from mjhab.scenes.objects import ObjectModel, register_object
    from mjhab.scenes.pack_source import PackRequest, PackSource, register_pack
    from mjhab.scenes.packs import open_pack
    from mjhab.tasks.household.registry import register_task
    from mjhab.tasks.household.spec import TargetRule, TaskSpec
    from mjhab.tasks.subtasks.registry import register_subtask
    from mjhab.tasks.subtasks.spec import LabelRule, SubtaskSpec

__all__ = [
    "ControlMode",
    "LabelRule",
    "ObjectModel",
    "PackRequest",
    "PackSource",
    "Perturbation",
    "Quantity",
    "SubtaskSpec",
    "TargetRule",
    "TaskSpec",
    "__version__",
    "chain_starts",
    "compare",
    "evaluate",
    "export_lerobot",
    "export_maniskill",
    "generate",
    "home_pack",
    "label",
    "make",
    "make_dataset",
    "make_expert",
    "make_train",
    "object_from_glb",
    "open_pack",
    "register_control_mode",
    "register_object",
    "register_pack",
    "register_perturbation",
    "register_robot",
    "register_subtask",
    "register_task",
    "replay",
    "shot",
    "train",
]

_LAZY = {
    "ObjectModel": "mjhab.scenes.objects",
    "LabelRule": "mjhab.tasks.subtasks.spec",
    "SubtaskSpec": "mjhab.tasks.subtasks.spec",
    "TargetRule": "mjhab.tasks.household.spec",
    "TaskSpec": "mjhab.tasks.household.spec",
    "PackRequest": "mjhab.scenes.pack_source",
    "PackSource": "mjhab.scenes.pack_source",
    "chain_starts": "mjhab.evaluation.datasets.chain_starts",
    "compare": "mjhab.evaluation.compare",
    "evaluate": "mjhab.evaluation.evaluate",
    "export_lerobot": "mjhab.evaluation.datasets.export",
    "export_maniskill": "mjhab.evaluation.datasets.export",
    "generate": "mjhab.evaluation.generate",
    "label": "mjhab.evaluation.datasets.label",
    "make_dataset": "mjhab.evaluation.publishing.make",
    "replay": "mjhab.evaluation.datasets.replay",
    "shot": "mjhab.evaluation.shots.shoot",
    "make": "mjhab.envs",
    "make_train": "mjhab.envs",
    "ControlMode": "mjhab.robots.controllers.modes",
    "register_control_mode": "mjhab.robots.controllers.modes",
    "register_robot": "mjhab.robots.registry",
    "make_expert": "mjhab.experts",
    "open_pack": "mjhab.scenes.packs",
    "home_pack": "mjhab.scenes.home_files",
    "object_from_glb": "mjhab.scenes.object_glb",
    "register_object": "mjhab.scenes.objects",
    "register_subtask": "mjhab.tasks.subtasks.registry",
    "register_task": "mjhab.tasks.household.registry",
    "Perturbation": "mjhab.config.perturbing",
    "Quantity": "mjhab.config.perturbing",
    "register_perturbation": "mjhab.config.perturbing",
    "register_pack": "mjhab.scenes.pack_source",
    "train": "mjhab.learning.train",
}
_PACKAGES = frozenset(
    {
        "assets",
        "bench",
        "cli",
        "compat",
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
        "paper",
        "render",
        "reports",
        "robots",
        "rollout",
        "scenes",
        "serving",
        "sim",
        "tasks",
        "viewer",
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
    from mjhab.core.registration.plugins import load_plugins
    from mjhab.envs.catalog import register_envs

    load_plugins()
    register_envs()


def _is_command() -> bool:
    """Whether the process is the ``mjhab`` command, which registers when it runs something: ``--help`` is quick."""
    # Not sys.argv: worker processes of the command are given it, too.
    words = sys.orig_argv
    if sys.argv[:1] == ["-m"]:
        # Python's own mark while it looks for the module behind -m.
        return words[words.index("-m") + 1] in ("mjhab", "mjhab.cli.main")
    return Path(*words[1:2]).stem == "mjhab"


if not _is_command():
    register_all()
