"""An import hook: modules of MS-HAB, ManiSkill and SAPIEN whose names are those of our objects."""

from __future__ import annotations

import importlib
import importlib.machinery
import sys
from collections.abc import Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from pathlib import Path
from types import ModuleType
from typing import Any

from mjhab.compat.mshab.running.forks import own_modules
from mjhab.compat.mshab.running.table import MANI_SKILL, MSHAB, SAPIEN, WITHOUT_CHECKOUT
from mjhab.core.errors import warn_once

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
        # Old finders of other packages lack find_spec.
        except (ImportError, AttributeError):
            continue
    return False


def answered_modules() -> dict[str, dict[str, str]]:
    """Modules that mjhab answers in this process, and the places of their names.

    The environments are answered unless ManiSkill and SAPIEN are installed. The rest of MS-HAB comes from its own
    package where that can be found, and so do modules with wrappers that only a fork has (`forks`).
    """
    if all(map(installed, ENGINE)):
        return {}
    found = {**MANI_SKILL, **SAPIEN, **MSHAB}
    folder = package_folder()
    if folder is None:
        return {**found, **WITHOUT_CHECKOUT}
    own = own_modules(folder, MSHAB)
    if own:
        wrappers = ", ".join(sorted(set().union(*own.values())))
        warn_once(f"{', '.join(own)}: those of {folder} are used, which has {wrappers}.")
    for module in own:
        del found[module]
    return found


def package_folder() -> Path | None:
    """Folder of MS-HAB's own package, beside the script or installed; None if there is none."""
    spec = importlib.machinery.PathFinder.find_spec("mshab")
    places = [] if spec is None else spec.submodule_search_locations or []
    return next((Path(place) for place in places if Path(place).is_dir()), None)


class Answers(MetaPathFinder, Loader):
    """Finds and makes the modules of a table; all others are left to the finders behind it.

    Args:
        modules: names of modules, and of their members with the places "module:name" where those are.
        folder: of MS-HAB's own package, in which modules are that are not answered; None without one.
    """

    def __init__(
        self, modules: Mapping[str, Mapping[str, str]], folder: Path | None = None
    ) -> None:
        self._modules = modules
        self._folder = folder

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: Any = None
    ) -> importlib.machinery.ModuleSpec | None:
        """The answer to an import; None if it is not ours."""
        if fullname not in self._modules:
            return None
        inside = any(name.startswith(f"{fullname}.") for name in self._modules)
        spec = importlib.machinery.ModuleSpec(
            fullname, self, origin="answered by mjhab", is_package=inside
        )
        top, *below = fullname.split(".")
        if inside and top == "mshab" and self._folder is not None:
            # What is not answered of the package comes from MS-HAB's own files.
            spec.submodule_search_locations = [str(self._folder.joinpath(*below))]
        return spec

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
    # Ahead of the finder of files, which would find MS-HAB's own modules.
    sys.meta_path.insert(0, Answers(modules, package_folder()))
    importlib.import_module("mjhab.compat.mshab")
    return True
