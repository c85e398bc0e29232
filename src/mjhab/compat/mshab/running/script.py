"""Runs a script as Python would, with the modules of MS-HAB and ManiSkill answered."""

from __future__ import annotations

import ast
import importlib.util
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from mjhab.compat.mshab.running.habits import keep_old_habits, stay_on_the_cpu
from mjhab.compat.mshab.running.hook import install
from mjhab.compat.mshab.running.table import FOREIGN
from mjhab.core.errors import (
    UsageError,
    about,
    fault,
    unknown_name,
    warn_once,
    wrong_value,
)

PACKAGE = "mshab"
"""Name of the folder with MS-HAB's own package."""
_NO_CONSTANTS: Mapping[str, Any] = {}


def find_script(name: str) -> Path:
    """The file of a script.

    Raises:
        UsageError: there is none.
    """
    path = Path(name)
    if not path.is_file():
        raise fault(
            name,
            "no such script. Usage: python -m mjhab.compat.mshab SCRIPT.py ARGS... (or -m MODULE ARGS...)",
        )
    return path


def checkout_of(script: Path) -> Path | None:
    """Folder above MS-HAB's package that a script lies in; None if it lies in none."""
    for folder in script.resolve().parents:
        if folder.name == PACKAGE and (folder / "envs").is_dir():
            return folder.parent
    return None


def read_constant(text: str) -> tuple[str, Any]:
    """``NAME=VALUE`` of a command line, the value as Python writes it.

    Raises:
        UsageError: it is none.
    """
    name, mark, value = text.partition("=")
    try:
        if not (mark and name.isidentifier()):
            raise ValueError("no name")
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError) as error:
        raise wrong_value(
            "--set", text, "NAME=VALUE, the value as Python writes it, such as NUM_ENVS=4"
        ) from error


def run_script(
    script: Path, arguments: Sequence[str], constants: Mapping[str, Any] = _NO_CONSTANTS
) -> None:
    """Run a file as ``__main__``.

    Args:
        script: the file.
        arguments: its command line.
        constants: values for names that the file itself gives a value to, at its outermost level.

    Raises:
        UsageError: the file is no Python, gives no value to one of the names, or imports what is not answered.
    """
    prepare(script.resolve().parent, checkout_of(script))
    sys.argv = [str(script), *arguments]
    _run(script, ModuleType("__main__"), constants)


def run_module(
    name: str, arguments: Sequence[str], constants: Mapping[str, Any] = _NO_CONSTANTS
) -> None:
    """Run a module, such as ``mshab.train_sac``, as ``__main__``; it is looked for in the present folder, too.

    Raises:
        UsageError: there is no such module, or see `run_script`.
    """
    prepare(Path.cwd(), None)
    try:
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.submodule_search_locations is not None:
            # As `python -m` does with a package.
            spec = importlib.util.find_spec(f"{name}.__main__")
    # A package above it is missing, which is told like the module itself.
    except ModuleNotFoundError:
        spec = None
    if spec is None or not spec.has_location or spec.origin is None:
        raise fault(
            name,
            "no such module. Begin in the folder that holds its package, such as a checkout of MS-HAB.",
        )
    sys.argv = [spec.origin, *arguments]
    module = ModuleType("__main__")
    module.__package__ = spec.parent
    # Processes that a script starts find it by this name again.
    module.__spec__ = spec
    _run(Path(spec.origin), module, constants)


def _run(path: Path, module: ModuleType, constants: Mapping[str, Any]) -> None:
    """Run a file in a module that takes the place of ours as ``__main__``."""
    with about(path, (SyntaxError, ValueError)):
        tree = ast.parse(path.read_bytes(), str(path))
    _give(tree, path, constants)
    module.__file__ = str(path)
    before = sys.modules["__main__"]
    # pickle looks for the script's classes by this name.
    sys.modules["__main__"] = module
    try:
        with _imports_told():
            exec(compile(tree, str(path), "exec"), vars(module))
    finally:
        sys.modules["__main__"] = before


def _give(tree: ast.Module, path: Path, constants: Mapping[str, Any]) -> None:
    """Put other values into the assignments of names."""
    found: dict[str, ast.Assign | ast.AnnAssign] = {}
    for node in tree.body:
        targets = (
            node.targets
            if isinstance(node, ast.Assign)
            else [node.target]
            if isinstance(node, ast.AnnAssign) and node.value is not None
            else []
        )
        if isinstance(node, ast.Assign | ast.AnnAssign) and len(targets) == 1:
            target = targets[0]
            if isinstance(target, ast.Name):
                found[target.id] = node
    for name, value in constants.items():
        if name not in found:
            raise unknown_name(f"constant of {path.name}", name, found)
        # In the tree and not afterwards, so that what is computed from the name follows.
        given = ast.parse(repr(value), mode="eval").body
        found[name].value = ast.copy_location(given, found[name])
    ast.fix_missing_locations(tree)


@contextmanager
def _imports_told() -> Iterator[None]:
    """Tell an import that is not answered in one line, with its place."""
    try:
        yield
    except ImportError as error:
        if (error.name or "").partition(".")[0] not in FOREIGN:
            raise
        place = traceback.extract_tb(error.__traceback__)[-1]
        raise UsageError(
            f"{place.filename}, line {place.lineno}: {error}. mjhab does not answer it; "
            "`python -m mjhab.compat.mshab --check SCRIPT.py` lists all that a script misses."
        ) from error


def prepare(folder: Path, checkout: Path | None) -> None:
    """Let imports find what lies in the folder of a script and in the checkout, and answer the rest."""
    # `python -m` put the present folder there.
    sys.path[0] = str(folder)
    if checkout is not None:
        sys.path.append(str(checkout))
    if not install():
        warn_once(
            "ManiSkill and SAPIEN are installed: the script runs on them, and not on mjhab."
        )
        return
    keep_old_habits()
    stay_on_the_cpu()
