"""Figures of the structure of the source: how much there is of what, and what is said more than once.

    python tests/guard/mass.py
    python tests/guard/mass.py --root OTHER_CHECKOUT --json

A line of code is a line with at least one token that is neither comment nor docstring. Tokens are those of Python's
own tokenizer. Lines of docstrings are those of all strings that stand alone; notes of constants are those of them that
stand below an assignment at the top of a module or in a class, where a number says its unit, source or reason:
comments in another place. A dataclass is a class that ``dataclass`` decorates; msgspec structures count as well. An
importer of a module is another module of the package that names it in an import, lazy ones included.

A declaration of an option is a field whose value a user gives, on the command line, in Python or as a preset: the field
of a dataclass that checks what it was given (`take_options`, itself or through a base class), that describes fields for
the command line (`Flag`, `Bound`, `Sets` in their annotations), or that is called ``...Config`` or ``...Options``. All
other dataclasses are records: an episode, a row of a table or a job of a worker say which seed or task they have, and
nobody chooses it there. Both are counted, apart.
"""

from __future__ import annotations

import argparse
import ast
import io
import itertools
import json
import tokenize
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

PACKAGE = "mjhab"
SHARED_OPTIONS = ("seed", "threads", "task", "worlds", "num_envs")
OPTION_MARKS = {"take_options", "Flag", "Bound", "Sets"}
"""Names in the body of a class whose fields are options."""
SMALL_MODULE_LINES = 60
LAYOUT_TOKENS = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}


class Module:
    """One file of the package, parsed."""

    def __init__(self, path: Path, source: Path) -> None:
        text = path.read_text(encoding="utf-8")
        relative = path.relative_to(source)
        parts = relative.with_suffix("").parts
        self.name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        self.package = parts[1] if len(parts) > 2 else "(top)"
        self.folder = ".".join(parts[:-1])
        self.lines = text.count("\n")
        self.tree = ast.parse(text)
        self.imports = _imports(self.tree)
        docs = _docstring_lines(self.tree)
        self.docstring_lines = len(docs)
        self.constant_notes = _constant_notes(self.tree)
        code_lines: set[int] = set()
        self.tokens = 0
        self.comments = 0
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            first, last = token.start[0], token.end[0]
            if token.type == tokenize.COMMENT:
                self.comments += not token.string.startswith(
                    ("# noqa", "# type:", "# pyright:")
                )
            if token.type in LAYOUT_TOKENS or first in docs:
                continue
            self.tokens += 1
            code_lines.update(range(first, last + 1))
        self.code_lines = len(code_lines)

    def classes(self) -> Iterator[ast.ClassDef]:
        for node in ast.walk(self.tree):
            if isinstance(node, ast.ClassDef):
                yield node

    def public_names(self) -> int:
        """Public names: functions, classes and constants at the top of the module without an underscore."""
        count = 0
        for node in self.tree.body:
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
                count += not node.name.startswith("_")
            elif isinstance(node, (ast.Assign, ast.AnnAssign)):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                named = [t.id for t in targets if isinstance(t, ast.Name)]
                count += sum(not name.startswith("_") for name in named)
        return count


def _imports(tree: ast.Module) -> set[str]:
    """Dotted names in imports, of modules and of what is taken from them; "module:name" strings are lazy imports."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.add(node.value.partition(":")[0])
    return found


def _docstring_lines(tree: ast.Module) -> set[int]:
    """Lines of every string that stands alone: docstrings of modules, classes, functions and fields."""
    lines: set[int] = set()
    for node in ast.walk(tree):
        value = node.value if isinstance(node, ast.Expr) else None
        if isinstance(value, ast.Constant) and isinstance(value.value, str):
            lines.update(range(value.lineno, (value.end_lineno or value.lineno) + 1))
    return lines


def _constant_notes(tree: ast.Module) -> int:
    """Number of lines of the docstrings below constants; fields of dataclasses are none."""
    count = 0
    for scope in ast.walk(tree):
        if not isinstance(scope, (ast.Module, ast.ClassDef)):
            continue
        for before, note in itertools.pairwise(scope.body):
            constant = isinstance(before, ast.Assign) or (
                isinstance(before, ast.AnnAssign) and isinstance(scope, ast.Module)
            )
            text = note.value if isinstance(note, ast.Expr) else None
            if constant and isinstance(text, ast.Constant) and type(text.value) is str:
                count += (note.end_lineno or note.lineno) - note.lineno + 1
    return count


def _is_dataclass(node: ast.ClassDef) -> bool:
    written = [ast.unparse(part) for part in (*node.decorator_list, *node.bases)]
    return any("dataclass" in part or part.endswith("Struct") for part in written)


def _fields(node: ast.ClassDef) -> list[str]:
    return [
        part.target.id
        for part in node.body
        if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name)
    ]


def per_package(modules: list[Module]) -> dict[str, dict[str, int]]:
    """Sums of every package and of the whole source."""
    importers = Counter(name for module in modules for name in module.imports)
    rows: dict[str, dict[str, int]] = defaultdict(lambda: defaultdict(int))
    for module in modules:
        structures = [node for node in module.classes() if _is_dataclass(node)]
        for row in (rows[module.package], rows["(all)"]):
            row["files"] += 1
            row["lines"] += module.lines
            row["code_lines"] += module.code_lines
            row["tokens"] += module.tokens
            row["docstring_lines"] += module.docstring_lines
            row["comments"] += module.comments
            row["constant_notes"] += module.constant_notes
            row["dataclasses"] += len(structures)
            row["fields"] += sum(len(_fields(node)) for node in structures)
            row["public_names"] += module.public_names()
            row["small_modules"] += module.lines < SMALL_MODULE_LINES
            row["one_importer"] += importers[module.name] == 1
    return {name: dict(row) for name, row in sorted(rows.items())}


def declarations(modules: list[Module]) -> dict[str, dict[str, int]]:
    """Number of classes that declare each of the options that many commands share, and of records that hold one."""
    structures = {
        node.name: node
        for module in modules
        for node in module.classes()
        if _is_dataclass(node) or node.name == "EnvSpec"
    }
    found = {name: {"options": 0, "records": 0} for name in SHARED_OPTIONS}
    for node in structures.values():
        kind = "options" if _takes_options(node, structures) else "records"
        for name in {*_fields(node)} & {*SHARED_OPTIONS}:
            found[name][kind] += 1
    return found


def _takes_options(node: ast.ClassDef, structures: Mapping[str, ast.ClassDef]) -> bool:
    """Whether the fields of a dataclass are options, see the docstring of the module."""
    if node.name.endswith(("Config", "Options")):
        return True
    names = {part.id for part in ast.walk(node) if isinstance(part, ast.Name)}
    if names & OPTION_MARKS:
        return True
    bases = (base.id for base in node.bases if isinstance(base, ast.Name))
    return any(
        _takes_options(structures[base], structures)
        for base in bases
        if base in structures
    )


def shared_class_names(modules: list[Module]) -> dict[str, list[str]]:
    """Names that several classes at the top of a module have, and where."""
    places: dict[str, list[str]] = defaultdict(list)
    for module in modules:
        for node in module.tree.body:
            if isinstance(node, ast.ClassDef):
                places[node.name].append(module.name)
    return {name: where for name, where in sorted(places.items()) if len(where) > 1}


def two_way_pairs(modules: list[Module]) -> list[str]:
    """Pairs of folders of one package that import each other."""
    folders = {module.folder for module in modules}
    arrows: set[tuple[str, str]] = set()
    for module in modules:
        for name in module.imports:
            target = name
            while target and target not in folders:
                target = target.rpartition(".")[0]
            same = target.split(".")[:2] == module.folder.split(".")[:2]
            nested = target.startswith(module.folder) or module.folder.startswith(target)
            if same and target and not nested:
                arrows.add((module.folder, target))
    return sorted(
        f"{one} - {other}"
        for one, other in arrows
        if one < other and (other, one) in arrows
    )


def measured(root: Path) -> dict[str, Any]:
    """All figures of the checkout at `root`."""
    source = root / "src"
    paths = sorted((source / PACKAGE).rglob("*.py"))
    modules = [Module(path, source) for path in paths]
    text = "\n".join(path.read_text(encoding="utf-8") for path in paths)
    packages = per_package(modules)
    total = packages["(all)"]
    return {
        "packages": packages,
        "declarations": declarations(modules),
        "shared_class_names": shared_class_names(modules),
        "two_way_pairs": two_way_pairs(modules),
        "raise_usage_error": text.count("raise UsageError"),
        "tokens_per_line": round(total["tokens"] / total["code_lines"], 2),
        "comments_percent": round(100 * total["comments"] / total["code_lines"], 2),
        "constant_notes_percent": round(
            100 * total["constant_notes"] / total["code_lines"], 2
        ),
        "test_lines": sum(
            path.read_text(encoding="utf-8").count("\n")
            for path in (root / "tests").rglob("*.py")
        ),
        "readme_lines": (root / "README.md").read_text(encoding="utf-8").count("\n"),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, default=Path(__file__).parents[2])
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    figures = measured(options.root)
    if options.json:
        print(json.dumps(figures))
        return
    for name, row in figures.pop("packages").items():
        print(f"{name:14}", *(f"{key} {value}" for key, value in row.items()))
    for name, value in figures.items():
        print(f"{name}: {value}")


if __name__ == "__main__":
    main()
