"""An import hook: modules of MS-HAB, ManiSkill and SAPIEN whose names are those of our objects."""

from __future__ import annotations

import importlib
import importlib.machinery
import sys
from collections.abc import Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from types import ModuleType
from typing import Any

from mjhab.compat.mshab.running.table import MANI_SKILL, MSHAB, SAPIEN, WITHOUT_CHECKOUT

ENGINE = ("sapien", "mani_skill")
"""Packages without which MS-HAB's own environments cannot be imported."""


def installed(package: str) -> bool:
    """Whether a top-level package can be found, without importing it; our answers do not count."""
    for finder in sys.meta_path:
        if isinstance(finder, Answers):
            continue
        try:
            if finder.find_spec(package, None) is not None:
                return True
        except (ImportError, AttributeError):
            continue
    return False


def answered_modules() -> dict[str, dict[str, str]]:
    """Modules that mjhab answers in this process, and the places of their names.

    The environments are answered unless ManiSkill and SAPIEN are installed. The rest of MS-HAB comes from its own
    package where that can be found.
    """
    if all(map(installed, ENGINE)):
        return {}
    found = {**MANI_SKILL, **SAPIEN, **MSHAB}
    return found if installed("mshab") else {**found, **WITHOUT_CHECKOUT}


class Answers(MetaPathFinder, Loader):
    """Finds and makes the modules of a table; all others are left to the finders behind it.

    Args:
        modules: names of modules, and of their members with the places "module:name" where those are.
    """

    def __init__(self, modules: Mapping[str, Mapping[str, str]]) -> None:
        self._modules = modules

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: Any = None
    ) -> importlib.machinery.ModuleSpec | None:
        """The answer to an import; None if it is not ours."""
        if fullname not in self._modules:
            return None
        inside = any(name.startswith(f"{fullname}.") for name in self._modules)
        return importlib.machinery.ModuleSpec(
            fullname, self, origin="answered by mjhab", is_package=inside
        )

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType:
        """An empty module."""
        return ModuleType(spec.name, f"{spec.name}, answered by mjhab.")

    def exec_module(self, module: ModuleType) -> None:
        """Give the module its members: those that stand in other modules come when they are asked for."""
        members = self._modules[module.__name__]
        module.__dict__["__all__"] = [n for n in members if not n.startswith("_")]

        def member(name: str) -> Any:
            place = members.get(name)
            if place is None:
                known = ", ".join(sorted(members)) or "no names"
                raise AttributeError(
                    f"mjhab answers {known} of {module.__name__}, and not {name!r}"
                )
            owner, _, attribute = place.partition(":")
            value = getattr(importlib.import_module(owner), attribute)
            module.__dict__[name] = value
            return value

        module.__dict__["__getattr__"] = member


def install() -> bool:
    """Answer imports from now on; False if nothing is answered. Registers the ids, too.

    Once answered, the same modules stay answered.
    """
    if any(isinstance(finder, Answers) for finder in sys.meta_path):
        return True
    modules = answered_modules()
    if not modules:
        return False
    sys.meta_path.insert(0, Answers(modules))
    importlib.import_module("mjhab.compat.mshab")
    return True
