"""Code in the documentation: Python runs, commands parse, make targets and extras exist.

Sizes are small here: what Python makes, evaluates or generates is cut to a few control steps. `make test-docs` runs the
commands, too (`check_commands.py`).
"""

from __future__ import annotations

import functools
import importlib
import re
import runpy
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import pytest

import mjhab
from mjhab.cli.main import parse
from mjhab.evaluation.score.leaderboard import leaderboard
from mjhab.evaluation.score.manifest import TRACKS
from mjhab.evaluation.score.result import read_for_table
from mjhab.scenes.objects import OBJECTS
from mjhab.scenes.pack_source import PACK_SOURCES
from tests.docs.check_commands import small as made_quick
from tests.docs.pages import (
    LANGUAGES,
    PAGES,
    README,
    ROOT,
    Command,
    blocks,
    commands,
    hidden_commands,
    name_of,
    saved,
)

SMALL_VECTOR = {"num_envs": 2}
SMALL_EVALUATION = {"episodes": 1, "worlds": 1, "films": 0, "horizon": 5}
SMALL_GENERATION = {
    "episodes": 1,
    "per_target": 0,
    "keep": None,
    "workers": 0,
    "horizon": 5,
}
WITH_PYTHON = [
    page for page in PAGES if any(b.language == "python" for b in blocks(page))
]
FILES = {
    "docs/extending.md": ("home/cottage.json", "home/hut.py", "mug/mug.glb"),
    "docs/tutorials/extend.md": ("mug/mug.glb",),
}
"""Files of `examples` that the Python of a page finds in its folder."""


def smaller(call: Callable[..., Any], options: dict[str, Any]) -> Callable[..., Any]:
    @functools.wraps(call)
    def called(*args: Any, **given: Any) -> Any:
        return call(*args, **{**given, **options})

    return called


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Environments, evaluations and generations that take seconds."""
    monkeypatch.setattr(mjhab, "evaluate", smaller(mjhab.evaluate, SMALL_EVALUATION))
    monkeypatch.setattr(mjhab, "generate", smaller(mjhab.generate, SMALL_GENERATION))
    monkeypatch.setattr(gymnasium, "make_vec", smaller(gymnasium.make_vec, SMALL_VECTOR))


@pytest.fixture
def registries() -> Iterator[None]:
    """What pages register is there for them alone."""
    kept = [(registry, set(registry.names())) for registry in (OBJECTS, PACK_SOURCES)]
    yield
    for registry, names in kept:
        for name in set(registry.names()) - names:
            registry.remove(name)


@pytest.mark.usefixtures("small", "registries")
@pytest.mark.parametrize("page", WITH_PYTHON, ids=name_of)
def test_python_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    # A plugin finds its files beside itself, whatever the working directory is.
    plugin = tmp_path / "plugin"
    plugin.mkdir()
    for file in FILES.get(name_of(page), ()):
        shutil.copy(ROOT / "examples" / file, plugin)
    before = set(sys.modules)
    names: dict[str, object] = {"__file__": str(plugin / "plugin.py")}
    # Other pages go on with the policy that the README has its readers save.
    for block in [*saved(README), *blocks(page)]:
        if block.file:
            (tmp_path / block.file).write_text(block.code)
        elif block.language == "python" and not block.reason:
            exec(compile(block.code, str(page), "exec"), names)
    for name in set(sys.modules) - before:
        if getattr(sys.modules[name], "__file__", None) == str(tmp_path / f"{name}.py"):
            del sys.modules[name]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_all_code_is_in_blocks_whose_language_is_said(page: Path) -> None:
    assert hidden_commands(page) == []
    assert {block.language for block in blocks(page)} <= set(LANGUAGES)


PLACEHOLDER = re.compile(r"^[A-Z_]+(\.[a-z.]+)?$|^<.*>$|\.\.\.|[|\[]")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_exist(page: Path) -> None:
    for block in blocks(page):
        if block.language == "bash":
            for command in commands(block):
                check_command(command, block.reason)


def make_targets() -> list[str]:
    """Targets of the Makefile that have a description."""
    return re.findall(
        r"^([a-z0-9-]+):.*## ", (ROOT / "Makefile").read_text(), re.MULTILINE
    )


def test_make_help_lists_every_target() -> None:
    shown = subprocess.run(
        ["make", "--no-print-directory", "help"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert re.findall(r"^  make (\S+)", shown.stdout, re.MULTILINE) == make_targets()


def check_command(command: Command, reason: str) -> None:
    targets = make_targets()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    words = command.words
    if command.program == "make":
        assert next(word for word in words[1:] if "=" not in word) in targets
    elif command.program == "pip":
        for extra in re.findall(r"mjhab\[([\w,]+)\]", " ".join(words)):
            assert set(extra.split(",")) <= set(project["optional-dependencies"])
    elif command.program == "mjhab":
        if not any(PLACEHOLDER.search(word) for word in words[1:]):
            parse(words[1:])
    elif command.program not in ("python",):
        assert reason, f"{' '.join(words)}: nothing runs it, and no comment says why"


@pytest.mark.parametrize(
    ("words", "added"),
    [
        ("view runs/pick --export page.html", ""),
        ("score --check scores/mine/result.json", ""),
        ("eval --subtask pick --episodes 50", "--episodes 2"),
        ("train bc --task set_table --subtask pick --out runs/a", "--demos 8"),
        (
            "train bc --task set_table --subtask pick --data runs/b --out runs/a",
            "--films 0",
        ),
    ],
)
def test_commands_are_made_quick(words: str, added: str) -> None:
    made = made_quick(words.split())
    assert " ".join(made).startswith(words)
    more = " ".join(made[len(words.split()) :])
    assert more == "" if not added else added in more
    assert ("--demos" in more) == (added == "--demos 8")
    parse(made)


def test_tables_of_the_experts_are_those_of_their_results() -> None:
    path = ROOT / "docs" / "scripts" / "experts_tables.py"
    tables = runpy.run_path(str(path))
    page = tables["PAGE"].read_text(encoding="utf-8")
    assert "| set_table | open |" in page
    assert tables["page_with_tables"](page) == page


def test_table_of_the_students_is_that_of_their_results(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scripts = ROOT / "docs" / "scripts"
    monkeypatch.syspath_prepend(str(scripts))
    tables = runpy.run_path(str(scripts / "students_tables.py"))
    page = tables["PAGE"].read_text(encoding="utf-8")
    assert "| set_table | close |" in page
    filled = tables["page_with_tables"](page, tables["TABLES"])
    assert filled == page


def test_the_leaderboard_is_the_table_of_its_results() -> None:
    files = sorted((ROOT / "docs" / "results" / "leaderboard").glob("*.json"))
    results = [read_for_table(file) for file in files]
    assert {result.facts["track"] for result in results} == set(TRACKS)
    assert (ROOT / "docs" / "leaderboard.md").read_text(encoding="utf-8") == leaderboard(
        results
    )


def test_the_site_needs_no_network() -> None:
    site = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert "  - search\n  - offline" in site, (
        "search works from a disk by the plugin offline alone"
    )
    (scripts,) = re.findall(r"polyfills: \[(.*)\]", site)
    assert (ROOT / "docs" / scripts).is_file()
    assert not re.findall(r"https?://", site)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_pages_and_pictures_that_a_page_refers_to_exist(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    targets = re.findall(r"\]\(([^)\s#:]+)(?:#[^)]*)?\)", text)
    assert [name for name in targets if not (page.parent / name).exists()] == []
    # A link out of docs/ ends nowhere in the built site.
    docs = ROOT / "docs"
    if page.is_relative_to(docs):
        places = {name: (page.parent / name).resolve() for name in targets}
        assert [
            name for name, place in places.items() if not place.is_relative_to(docs)
        ] == []


def test_the_page_of_commands_is_what_its_script_makes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(ROOT / "docs" / "scripts")
    made = importlib.import_module("commands_page").page()
    assert (ROOT / "docs" / "commands.md").read_text(encoding="utf-8") == made
