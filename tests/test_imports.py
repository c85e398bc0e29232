"""The import rule: data flows one way, heavy libraries stay where they belong, ``import mjhab`` is light."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "mjhab"

ALLOWED: dict[str, frozenset[str]] = {
    "core": frozenset(),
    "assets": frozenset({"core"}),
    "scenes": frozenset({"core"}),
    "tasks": frozenset({"core"}),
    "sim": frozenset({"core", "scenes"}),
    "envs": frozenset({"core", "scenes", "tasks", "sim"}),
    "experts": frozenset({"core", "tasks", "envs"}),
    "rollout": frozenset({"core", "tasks", "sim", "envs", "experts"}),
    "data": frozenset({"core", "tasks", "rollout"}),
    "evaluation": frozenset({"core", "assets", "tasks", "envs", "rollout", "data"}),
    "learning": frozenset({"core", "tasks", "envs", "experts", "rollout", "data", "evaluation"}),
    "viewer": frozenset({"core", "scenes", "tasks", "sim", "envs", "experts", "rollout", "data"}),
    "cli": frozenset(
        {
            "core",
            "assets",
            "scenes",
            "tasks",
            "sim",
            "envs",
            "experts",
            "rollout",
            "data",
            "evaluation",
            "learning",
            "viewer",
        }
    ),
}
"""Package to the packages it may import, besides itself."""

HEAVY: dict[str, frozenset[str]] = {
    "mujoco": frozenset({"scenes", "sim", "viewer"}),
    "warp": frozenset({"sim"}),
    "mujoco_warp": frozenset({"sim"}),
    "torch": frozenset({"sim", "envs", "data", "learning"}),
    "safetensors": frozenset({"learning"}),
    "h5py": frozenset({"data"}),
    "viser": frozenset({"viewer"}),
    "trimesh": frozenset({"scenes"}),
}
"""Library to the packages that may import it."""

FILES = sorted(path for path in SOURCE.rglob("*.py") if path.parent != SOURCE)


def imported(path: Path) -> Iterator[str]:
    """Yield the full name of every module (or name in a module) that a file imports, wherever in the file."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = ("mjhab", *path.relative_to(SOURCE).parent.parts)
                base = ".".join((*package[: len(package) - node.level + 1], *filter(None, [base])))
            yield from (f"{base}.{alias.name}" for alias in node.names)


def package_of(path: Path) -> str:
    return path.relative_to(SOURCE).parts[0]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(SOURCE)))
def test_file_imports_only_what_its_package_may(path: Path) -> None:
    package = package_of(path)
    assert package in ALLOWED, f"package {package!r} has no line in the table of imports"
    for name in imported(path):
        parts = name.split(".")
        if parts[0] == "mjhab" and len(parts) > 1 and parts[1] in ALLOWED:
            allowed = ALLOWED[package] | {package}
            assert parts[1] in allowed, f"{package} may not import {name}; it may import {sorted(allowed)}"
        elif parts[0] in HEAVY:
            assert package in HEAVY[parts[0]], f"{package} may not import {parts[0]}"
            assert parts[0] not in ("warp", "mujoco_warp") or path.name.startswith("warp"), f"{parts[0]} in {path.name}"
            assert parts[0] != "torch" or package != "envs" or path.parent.name == "device", f"torch in {path.name}"


def test_the_rule_can_be_broken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules[__name__], "SOURCE", tmp_path)
    (tmp_path / "tasks").mkdir()
    for line in ("from mjhab.sim import cpu", "import mujoco", "from ..envs import make", "def f():\n    import torch"):
        path = tmp_path / "tasks" / "bad.py"
        path.write_text(line)
        with pytest.raises(AssertionError, match="tasks may not import"):
            test_file_imports_only_what_its_package_may(path)


def test_import_mjhab_is_light() -> None:
    code = (
        "import sys, mjhab\n"
        "bad = {'torch', 'warp', 'mujoco', 'numba', 'scipy', 'trimesh', 'h5py'} & set(sys.modules)\n"
        "assert not bad, f'import mjhab loaded {bad}'\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr


def test_every_package_is_an_attribute() -> None:
    """In a process of its own: here the packages have been imported already, which makes them attributes."""
    packages = sorted(path.parent.name for path in SOURCE.glob("*/__init__.py"))
    code = f"import mjhab\nfor name in {packages}:\n    assert name in dir(mjhab)\n    getattr(mjhab, name)\n"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr


def test_lazy_names_resolve() -> None:
    import mjhab

    for name in mjhab.__all__:
        assert name in dir(mjhab) and getattr(mjhab, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'mkae'"):
        _ = mjhab.mkae
