"""Names of constants: one that other files import means the same everywhere.

A constant is a name in capitals at the top of a module. Within its module it may be called what it is there (``STEPS``,
``MAX_TRIES``), whatever other modules call theirs: a reader sees its value in the same file. One that another file
imports by its name is read without its module, so that no second one with another value may have that name.
"""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

SOURCE = Path(__file__).parents[2] / "src"


def ambiguous(source: Path) -> dict[str, list[str]]:
    """Names of imported constants that have several values, and the modules of these."""
    values: dict[str, dict[str, str]] = defaultdict(dict)
    imported: set[tuple[str, str]] = set()
    for path in sorted(source.rglob("*.py")):
        module = ".".join(path.relative_to(source).with_suffix("").parts)
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in tree.body:
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                for target in targets:
                    if isinstance(target, ast.Name) and target.id.isupper():
                        values[target.id][module] = ast.unparse(node.value)
        imported |= {
            (node.module, alias.name)
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and node.module
            for alias in node.names
        }
    found: dict[str, list[str]] = {}
    for name, places in values.items():
        used = [module for module in places if (module, name) in imported]
        if len({places[module] for module in used}) > 1:
            found[name] = used
    return found


def test_an_imported_constant_has_a_name_of_its_own() -> None:
    assert not ambiguous(SOURCE)


def test_the_rule_can_be_broken(tmp_path: Path) -> None:
    (tmp_path / "one.py").write_text("LIMIT_M = 1.0\nSTEPS = 3\n")
    (tmp_path / "two.py").write_text("from one import LIMIT_M\nSTEPS = 4\n")
    assert not ambiguous(tmp_path)
    (tmp_path / "three.py").write_text("LIMIT_M: float = 2.0\n")
    (tmp_path / "four.py").write_text("def f():\n    from three import LIMIT_M\n")
    assert ambiguous(tmp_path) == {"LIMIT_M": ["one", "three"]}
