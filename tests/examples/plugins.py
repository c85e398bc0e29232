"""The examples as plugins: in this process for a while, or in a process of their own."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mjhab.core.registration import plugins
from mjhab.tasks.household.registry import TASKS
from mjhab.tasks.subtasks.registry import SUBTASKS

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"


@contextmanager
def loaded(name: str) -> Iterator[None]:
    """Within the context the subtasks and tasks of an example are registered."""
    path = str(EXAMPLES / name)
    before = list(plugins._found)
    assert plugins.load_plugin(path).error == ""
    try:
        yield
    finally:
        for registry in (SUBTASKS, TASKS):
            for item in [item for item in registry if registry.source(item) == path]:
                registry.remove(item)
        plugins._found[:] = before


def run(name: str, program: Path, *args: str) -> str:
    """Run a program with an example as a plugin; returns what it printed."""
    environment = {
        **os.environ,
        "MJHAB_PLUGINS": str(EXAMPLES / name),
        "PYTHONPATH": os.pathsep.join((str(ROOT / "src"), str(ROOT))),
    }
    done = subprocess.run(
        [sys.executable, str(program), *args],
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
        env=environment,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
