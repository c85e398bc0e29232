"""What a script imports of MS-HAB and ManiSkill, and whether it is answered, without running it."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mjhab.compat.mshab.ids import IDS
from mjhab.compat.mshab.running.hook import answered_modules, installed
from mjhab.compat.mshab.running.script import checkout_of
from mjhab.compat.mshab.running.table import FOREIGN
from mjhab.core.errors import about

ANSWERED = "answered"
MISSING = "missing"


def check_script(script: Path) -> dict[str, Any]:
    """``{"imports": {name: "answered" | "missing"}, "ids": [...]}`` of a script.

    Names are "module" or "module.name". Standard libraries are left out; other packages are "answered" if they are
    installed, MS-HAB's own modules if they lie in the checkout. "ids" are MS-HAB's environment ids in its texts.

    Raises:
        UsageError: the file is no Python.
    """
    # A file that is not UTF-8 ends in a ValueError.
    with about(script, (SyntaxError, ValueError)):
        tree = ast.parse(script.read_text(encoding="utf-8"))
    checkout = checkout_of(script)
    if checkout is not None and str(checkout) not in sys.path:
        # As when the script runs: what the checkout has counts as answered.
        sys.path.append(str(checkout))
    modules = answered_modules()
    found: dict[str, str] = {}
    for module, name in sorted(set(_imports(tree))):
        if module.partition(".")[0] not in sys.stdlib_module_names:
            key = f"{module}.{name}" if name else module
            good = _is_answered(module, name, modules)
            found[key] = ANSWERED if good else MISSING
    texts = {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    return {"imports": found, "ids": sorted(texts.intersection(IDS))}


def _imports(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """(module, name) of every import; "" for the module itself."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
            yield from (
                (node.module, "" if alias.name == "*" else alias.name)
                for alias in node.names
            )


def _is_answered(module: str, name: str, modules: dict[str, dict[str, str]]) -> bool:
    if module in modules:
        return not name or name in modules[module] or f"{module}.{name}" in modules
    top = module.partition(".")[0]
    if top not in FOREIGN:
        # Of other packages it is told whether they are installed.
        return installed(top)
    return _lies_there(module)


def _lies_there(module: str) -> bool:
    """Whether a file of a module is found beside the script or installed; nothing is imported."""
    parts = module.split(".")
    for folder in map(Path, sys.path):
        place = folder.joinpath(*parts)
        if place.with_suffix(".py").is_file() or place.is_dir():
            return True
    return False
