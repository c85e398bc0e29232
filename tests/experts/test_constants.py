"""Every number of the experts is explained, and says where it comes from or that nobody knows."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import mjhab.experts

ROOT = Path(mjhab.experts.__file__).parent
UNKNOWN = "Numbers that name no source were chosen by hand"
COUNTED = {"arm/frame_kernels.py", "arm/ik_kernels.py"}
"""Files whose numbers count kinds of joints and of goals."""


def unexplained(source: str) -> list[str]:
    """Constants with numbers that no docstring follows, their own or that of the group they stand in."""
    tree = ast.parse(source)
    found: list[str] = []
    group: list[str] = []
    for node in tree.body:
        if isinstance(node, ast.Expr):
            group = []
            continue
        name = ""
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            name = node.targets[0].id
        if not name.lstrip("_").isupper():
            found += group
            group = []
        elif any(
            isinstance(part, ast.Constant) and isinstance(part.value, int | float)
            for part in ast.walk(node)
        ):
            group.append(name)
    return found + group


def test_a_number_without_explanation_is_found() -> None:
    assert unexplained('A = 1\n"""Says."""\nB = 2.0\n\ndef f(): ...\n') == ["B"]
    assert unexplained('A = 1\nB = 2\n"""Both."""\n') == []


@pytest.mark.parametrize(
    "path", sorted(ROOT.rglob("*.py")), ids=lambda path: str(path.relative_to(ROOT))
)
def test_numbers_are_explained(path: Path) -> None:
    source = path.read_text(encoding="utf-8")
    assert not unexplained(source)
    names = [line.split(" = ")[0] for line in source.splitlines() if " = " in line]
    if any(name.isupper() and name.isidentifier() for name in names):
        known = path.relative_to(ROOT).as_posix() in COUNTED | {"jit.py", "phases.py"}
        assert known or UNKNOWN in (ast.get_docstring(ast.parse(source)) or ""), (
            "the module says nothing about numbers without a source"
        )
