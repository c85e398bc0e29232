"""mjhab needs nothing that only Linux has."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

from tests.packaging.without_linux import MODULES, OF_OS

ROOT = Path(__file__).parents[2]
OWNERS = {
    "core/files/locking.py": {"fcntl"},
    "core/machine.py": {"sched_getaffinity", "/proc"},
}
"""The only modules that ask for what other systems lack, and do without where it is absent."""


def asked_for(tree: ast.AST) -> set[str]:
    """Modules and functions of Linux alone, and /proc, that a module names."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names} & {*MODULES}
        elif isinstance(node, ast.ImportFrom):
            found |= {str(node.module)} & {*MODULES}
        elif isinstance(node, ast.Attribute):
            found |= {node.attr} & {*OF_OS} if ast.unparse(node.value) == "os" else set()
        elif isinstance(node, ast.Constant) and str(node.value).startswith("/proc"):
            found.add("/proc")
    return found


def test_one_module_each_asks_for_what_only_linux_has() -> None:
    source = ROOT / "src" / "mjhab"
    words = ("/proc", *MODULES, *(f"os.{name}" for name in OF_OS))
    found = {}
    for path in source.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        if any(word in text for word in words) and (names := asked_for(ast.parse(text))):
            found[path.relative_to(source).as_posix()] = names
    assert found == OWNERS


def test_it_works_without_what_only_linux_has(tmp_path: Path) -> None:
    program = Path(__file__).with_name("without_linux.py")
    done = subprocess.run(
        [sys.executable, str(program), str(tmp_path)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0 and done.stdout.splitlines()[-1] == "done", done.stderr
