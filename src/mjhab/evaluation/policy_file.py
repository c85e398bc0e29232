"""Policies in a file of the user: ``FILE.py:CLASS``. See `resolve.OpenedPolicy`.

The class has ``name``, ``reset`` and ``act`` of the `Policy` protocol. If its constructor has a parameter, it gets the
vector environment. The class attribute ``env_options`` holds the environment options that the policy needs, e.g.
``{"obs_mode": "depth"}``.
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import os
import sys
import traceback
from pathlib import Path
from types import ModuleType

from mjhab.core.errors import fault, unknown_name, wrong_value
from mjhab.evaluation.own_policy import check_methods, construct_policy, env_options_of
from mjhab.evaluation.resolve import OpenedPolicy, PolicyFacts, PolicyOptions
from mjhab.rollout.policy import Policy, RolloutEnv


class PolicyClass(OpenedPolicy):
    """A class in a file; the hash of the file identifies its version."""

    @property
    def facts(self) -> PolicyFacts:
        """Load the file and describe the class.

        Raises:
            UsageError: the file is missing or raises on import; it has no such class; or the class lacks a method.
        """
        path, _ = _split(self.spec)
        policy_class = _load_class(self.spec)
        return PolicyFacts(
            f"{path.name}:{policy_class.__name__}",
            {"policy_sha256": _file_hash(path)},
            env_options_of(policy_class),
        )

    def _build(self, env: RolloutEnv, options: PolicyOptions) -> Policy:
        """Instantiate the class.

        Raises:
            UsageError: as `facts`; or the constructor has other parameters.
        """
        return construct_policy(_load_class(self.spec), env)


def _split(spec: str) -> tuple[Path, str]:
    """Split into the file and the name of the class, "" without a name."""
    # From the right, because a path of Windows begins with a drive and a colon.
    head, colon, name = spec.rpartition(":")
    if not colon or name.endswith(".py"):
        return Path(spec), ""
    return Path(head), name


def _load_class(spec: str) -> type:
    path, name = _split(spec)
    if not path.is_file():
        raise wrong_value("policy", spec, f"a file that exists, not {path}")
    module = _load_module(path)
    classes = {
        key: value for key, value in vars(module).items() if inspect.isclass(value)
    }
    own = [
        key
        for key, value in classes.items()
        # Imported classes are not the file's own.
        if value.__module__ == module.__name__ and not key.startswith("_")
    ]
    if not name:
        found = ", ".join(f"{path}:{key}" for key in own) or f"{path}:MyPolicy"
        raise wrong_value("policy", spec, f"one class of the file, as in {found}")
    if name not in classes:
        if not own:
            raise fault(path, f"has no class {name!r}; it defines no class at all.")
        raise unknown_name("class", name, own, where=path)
    check_methods(classes[name], name)
    return classes[name]


def _load_module(path: Path) -> ModuleType:
    """Import a file, with its folder on sys.path as for ``python FILE``; each content is imported once.

    Raises:
        UsageError: the file cannot be read, or raises.
    """
    # By its content: a file that was edited in a notebook session is imported anew.
    name = f"mjhab_policy_{path.stem}_{_file_hash(path)[:12]}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise fault(path, "not a Python file.")
    folder = str(path.resolve().parent)
    # Files beside it can be imported, as with ``python FILE``.
    if folder not in sys.path:
        sys.path.insert(0, folder)
    module = importlib.util.module_from_spec(spec)
    # Dataclasses and pickle look up their module in sys.modules.
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    # A script without a main guard may end the process.
    except (Exception, SystemExit) as error:
        # A half-imported module would be found by the next attempt.
        del sys.modules[name]
        what = f"{type(error).__name__}: {error}{_line_of(error, path)}"
        raise fault(path, f"cannot be imported: {what}.") from error
    return module


def _line_of(error: BaseException, path: Path) -> str:
    """ " (line N)" for the line of the file that raised an exception, or ""."""
    if isinstance(error, SyntaxError):
        # Its message already contains the line.
        return ""
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == os.path.abspath(path)]
    # The last frame in the user's file: deeper ones are of libraries.
    return f" (line {lines[-1]})" if lines else ""


def _file_hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
