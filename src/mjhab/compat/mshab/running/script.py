"""Runs a script as Python would, with the modules of MS-HAB and ManiSkill answered."""

from __future__ import annotations

import importlib.util
import runpy
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from mjhab.compat.mshab.running.habits import keep_old_habits, stay_on_the_cpu
from mjhab.compat.mshab.running.hook import install
from mjhab.compat.mshab.running.table import FOREIGN
from mjhab.core.errors import UsageError, fault, warn_once

PACKAGE = "mshab"
"""Name of the folder with MS-HAB's own package."""


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


def run_script(script: Path, arguments: Sequence[str]) -> None:
    """Run a file as ``__main__``.

    Raises:
        UsageError: it imports what is not answered.
    """
    prepare(script.resolve().parent, checkout_of(script))
    sys.argv = [str(script), *arguments]
    with _imports_told():
        runpy.run_path(str(script), run_name="__main__")


def run_module(name: str, arguments: Sequence[str]) -> None:
    """Run a module, such as ``mshab.train_sac``, as ``__main__``; it is looked for in the present folder, too.

    Raises:
        UsageError: there is no such module, or it imports what is not answered.
    """
    prepare(Path.cwd(), None)
    try:
        found = importlib.util.find_spec(name)
    except ModuleNotFoundError:
        found = None
    if found is None:
        raise fault(
            name,
            "no such module. Begin in the folder that holds its package, such as a checkout of MS-HAB.",
        )
    sys.argv = [name, *arguments]
    with _imports_told():
        runpy.run_module(name, run_name="__main__", alter_sys=True)


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
