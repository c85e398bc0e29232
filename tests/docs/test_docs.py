"""Code in the documentation: Python runs, commands parse, make targets and extras exist.

Sizes are small here: what Python makes, evaluates or generates is cut to a few control steps. `make test-docs` runs the
commands, too (`check_commands.py`).
"""

from __future__ import annotations

import functools
import importlib
import re
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
from mjhab.cli.parsing import Parsed
from mjhab.config.perturbing import PERTURBATIONS
from mjhab.core.errors import UsageError
from mjhab.evaluation.parts import open_any, policy_options
from mjhab.evaluation.score.leaderboard import leaderboard
from mjhab.evaluation.score.manifest import TRACKS
from mjhab.evaluation.score.result import read_for_table
from mjhab.evaluation.specs import EvalSpec, GenerateSpec
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

REGISTRIES = (OBJECTS, PACK_SOURCES, PERTURBATIONS)
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
    kept = [(registry, set(registry.names())) for registry in REGISTRIES]
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


PLACEHOLDER = re.compile(r"^<.*>$|\.\.\.|[|\[]")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_commands_exist_and_their_options_fit(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Away from the files that earlier commands have made here.
    monkeypatch.chdir(tmp_path)
    for block in blocks(page):
        if block.language == "bash":
            for command in commands(block):
                # These have names that their Python registers.
                check_command(
                    command, block.reason, with_options=name_of(page) not in FILES
                )


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


def check_command(command: Command, reason: str, with_options: bool) -> None:
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
            parsed = parse(words[1:])
            if with_options:
                check_options(parsed)
    elif command.program not in ("python",):
        assert reason, f"{' '.join(words)}: nothing runs it, and no comment says why"


def check_options(parsed: Parsed) -> None:
    """Check the options of a command, as it does itself before it begins.

    Raises:
        UsageError: one does not fit.
    """
    try:
        spec = parsed.spec
    except UsageError as error:
        # A file that an earlier command makes.
        assert "No such file" in str(error), error
        return
    asked = spec.as_evaluation() if isinstance(spec, GenerateSpec) else spec
    if isinstance(asked, EvalSpec) and str(asked.policy).startswith(
        ("expert", "learned")
    ):
        open_any(asked.policy).check(policy_options(asked))


@pytest.mark.parametrize(
    ("words", "added"),
    [
        ("view runs/pick --export page.html", ""),
        ("score check scores/mine/result.json", ""),
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


@pytest.fixture
def scripts(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], Any]]:
    """Imports a script of docs/scripts by its name."""
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "scripts"))
    before = set(sys.modules)
    yield importlib.import_module
    for name in set(sys.modules) - before:
        if "docs/scripts" in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


def test_tables_of_all_pages_are_those_of_their_results(scripts: Any) -> None:
    files = scripts("result_files")
    tables = scripts("result_tables").tables()
    found = files.pages()
    assert README in found and ROOT / "docs" / "policies.md" in found
    for page in found:
        assert files.fill(page, tables) == page.read_text(encoding="utf-8"), name_of(page)
    asked = "".join(page.read_text(encoding="utf-8") for page in found)
    assert [name for name in tables if f"<!-- table: {name} -->" not in asked] == []


def test_results_tell_their_date_version_and_command(scripts: Any) -> None:
    files = scripts("result_files")
    names = [path.stem for path in files.RESULTS.glob("*.json") if path.stem != "studies"]
    told = [files.read(name) for name in names] + [*files.read("studies").values()]
    assert len(told) > 30
    for about in told:
        assert files.origin(about).startswith("Measured ")


HASH = re.compile(r"\b(?=[0-9]*[a-f])(?=[a-f]*[0-9])[0-9a-f]{7,40}\b")
MANUAL = [
    page
    for page in PAGES
    if page.parent != ROOT / "docs" / "results" and page.stem != "leaderboard"
]
"""Pages without history; docs/results and CHANGELOG.md have it, the leaderboard shows digests of its files."""


@pytest.mark.parametrize("page", MANUAL, ids=name_of)
def test_the_manual_names_no_commit(page: Path) -> None:
    assert HASH.findall(page.read_text(encoding="utf-8")) == []


def test_the_readme_is_short() -> None:
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 120


def test_the_reference_has_every_public_name() -> None:
    pages = (ROOT / "docs" / "reference").glob("*.md")
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    found = [resolved(path) for path in re.findall("^::: (.+)$", text, re.MULTILINE)]
    public = {name: getattr(mjhab, name) for name in mjhab.__all__}
    del public["__version__"]
    assert [name for name, value in public.items() if value not in found] == []
    assert [value for value in found if not value.__doc__] == []


def resolved(path: str) -> Any:
    """The module, class or function of a dotted path.

    Raises:
        AttributeError: there is none.
    """
    try:
        return importlib.import_module(path)
    except ModuleNotFoundError:
        owner, _, name = path.rpartition(".")
        return getattr(importlib.import_module(owner), name)


def test_the_leaderboard_is_the_table_of_its_results() -> None:
    files = sorted((ROOT / "docs" / "results" / "leaderboard").glob("*.json"))
    results = [read_for_table(file) for file in files]
    assert {result.facts["track"] for result in results} <= set(TRACKS)
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


def anchors(page: Path) -> set[str]:
    """Names of the headings of a page, as the site makes them."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    heads = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    plain = [re.sub(r"[^\w\s-]", "", head.lower()).strip() for head in heads]
    return {re.sub(r"\s+", "-", head) for head in plain}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_headings_that_a_page_refers_to_exist(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    links = re.findall(r"\]\((?!http)([^)\s#]*)#([^)\s]+)\)", text)
    places = [((page.parent / name) if name else page, head) for name, head in links]
    assert [link for link in places if link[1] not in anchors(link[0])] == []


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


def test_the_page_of_commands_is_what_its_script_makes(scripts: Any) -> None:
    made = scripts("commands_page").page()
    assert (ROOT / "docs" / "commands.md").read_text(encoding="utf-8") == made
