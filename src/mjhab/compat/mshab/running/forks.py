"""Forks of MS-HAB that have wrappers of their own, such as for colours: whose module is used."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from pathlib import Path

from mjhab.core.errors import about

WRAPPERS = "mshab.envs.wrappers"
MODULES = (
    "mshab.envs.make",
    WRAPPERS,
    f"{WRAPPERS}.action",
    f"{WRAPPERS}.observation",
)
"""Modules that work over our environments as they are: they reach into no engine."""
UNANSWERED = frozenset({"DebugVideoGPU", "FetchCollectRobotInitWrapper"})
"""Wrappers of MS-HAB itself that mjhab does not answer."""


def own_modules(
    folder: Path, answered: Mapping[str, Mapping[str, str]]
) -> dict[str, set[str]]:
    """Modules among MODULES of a checkout that have wrappers which MS-HAB has not, and their names.

    Args:
        folder: of the package ``mshab``.
        answered: names of modules and of their members that mjhab answers.

    Raises:
        UsageError: a module of the checkout is no Python.
    """
    known = UNANSWERED.union(*answered.values())
    found = {}
    for module in MODULES:
        path = _file(folder, module)
        if path is not None:
            with about(path, (SyntaxError, ValueError)):
                tree = ast.parse(path.read_text(encoding="utf-8"))
            names = _wrappers(tree) - known
            if names:
                found[module] = names
    return found


def _file(folder: Path, module: str) -> Path | None:
    place = folder.joinpath(*module.split(".")[1:])
    files = (place.with_suffix(".py"), place / "__init__.py")
    return next((path for path in files if path.is_file()), None)


def _wrappers(tree: ast.Module) -> set[str]:
    """Names of the classes that a module defines, and of those that it takes from the package of wrappers."""
    names = set()
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            names.add(node.name)
        elif isinstance(node, ast.ImportFrom) and (
            node.level or (node.module or "").startswith(WRAPPERS)
        ):
            names |= {alias.name for alias in node.names}
    return names - {"*"}
