"""Code in the documentation runs: Python is executed, commands are parsed, make targets and extras exist."""

from __future__ import annotations

import re
import shlex
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import pytest

from mjhab.cli.main import parse

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").rglob("*.md"))
EXECUTED = [page for page in PAGES if page.parent.name == "tutorials"] + [
    ROOT / "docs" / "index.md",
    ROOT / "docs" / "viewer.md",
]
"""Pages whose Python is executed from top to bottom; it takes seconds."""
BLOCK = re.compile(r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```', re.DOTALL | re.MULTILINE)


@dataclass(frozen=True)
class Block:
    """A piece of code in a page; ``file``: the name it is to be saved under, or ""."""

    language: str
    file: str
    code: str


def blocks(page: Path) -> list[Block]:
    return [Block(*(part or "" for part in found)) for found in BLOCK.findall(page.read_text())]


def commands(page: Path) -> list[list[str]]:
    """Lines of shell blocks as words, without comments."""
    found = []
    for block in blocks(page):
        if block.language in ("bash", "sh", "console"):
            joined = block.code.replace("\\\n", " ")
            found += [shlex.split(line, comments=True) for line in joined.splitlines()]
    return [words for words in found if words]


@pytest.mark.parametrize("page", EXECUTED, ids=lambda page: page.stem)
def test_python_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    before = set(sys.modules)
    names: dict[str, object] = {}
    found = [block for block in blocks(page) if block.language == "python"]
    assert found, f"{page} shows no Python"
    for block in found:
        if block.file:
            (tmp_path / block.file).write_text(block.code)
        else:
            exec(compile(block.code, str(page), "exec"), names)
    for name in set(sys.modules) - before:
        if getattr(sys.modules[name], "__file__", None) == str(tmp_path / f"{name}.py"):
            del sys.modules[name]


PLACEHOLDER = re.compile(r"^[A-Z_]+$|^<.*>$|\.\.\.|[|\[]")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT / "docs")))
def test_commands_exist(page: Path) -> None:
    targets = re.findall(r"^([a-z-]+):.*## ", (ROOT / "Makefile").read_text(), re.MULTILINE)
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    for words in commands(page):
        program = Path(words[0]).name
        if program == "make":
            assert next(word for word in words[1:] if "=" not in word) in targets
        elif program == "pip":
            for extra in re.findall(r"mjhab\[([\w,]+)\]", " ".join(words)):
                assert set(extra.split(",")) <= set(extras)
        elif program == "mjhab" and not any(PLACEHOLDER.search(word) for word in words[1:]):
            parse(words[1:])
