"""What of a release can be told without building one; `make release-check` does the rest."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

import mjhab
from mjhab.cli.machine.examples import EXAMPLES
from tests.packaging.release_check import ROOT, VERSION_FILE, faults, version_of

LOG = """# Changelog

## [Unreleased]

### Changed

## [1.2.0] - 2030-01-02

- A line.

## [1.1.0]
"""


def tree_with(folder: Path, log: str, version: str) -> Path:
    """A source tree of a version, as far as ``faults`` looks at it."""
    file = folder / VERSION_FILE
    file.parent.mkdir(parents=True)
    file.write_text(f'__version__ = "{version}"\n')
    (folder / "CHANGELOG.md").write_text(log)
    return folder


@pytest.mark.parametrize(
    ("version", "change", "fault"),
    [
        ("1.2.0", ("", ""), ""),
        ("1.2", ("", ""), "is no release"),
        ("1.3.0", ("", ""), "no section"),
        ("1.1.0", ("", ""), "no date"),
        ("1.2.0", ("### Changed\n", "### Changed\n\n- New.\n"), "under [Unreleased]"),
    ],
)
def test_what_keeps_a_tree_from_being_tagged_is_named(
    tmp_path: Path, version: str, change: tuple[str, str], fault: str
) -> None:
    tree = tree_with(tmp_path, LOG.replace(*change) if change[0] else LOG, version)
    assert version_of(tree) == version
    found = faults(tree, version)
    assert found == [] if not fault else fault in found[0]


def test_the_version_has_one_owner_and_a_section_of_the_changelog() -> None:
    version = version_of(ROOT)
    assert mjhab.__version__ == version
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert project["project"]["dynamic"] == ["version"]
    assert all("[Unreleased]" in fault for fault in faults(ROOT, version))
    owners = [
        path
        for path in (ROOT / "src").rglob("*.py")
        if re.search(r'^__version__ = "', path.read_text(), re.MULTILINE)
    ]
    assert owners == [ROOT / VERSION_FILE]


def test_the_changelog_says_first_what_a_user_must_change() -> None:
    log = (ROOT / "CHANGELOG.md").read_text()
    (section,) = re.findall(r"^## \[0\.2\.0\].*?(?=^## )", log, re.DOTALL | re.MULTILINE)
    assert section.split("\n### ")[1].startswith("What a user must change")


def test_every_example_is_in_the_package_and_has_a_command() -> None:
    """`check_wheel.py` runs the commands, each a call of mjhab on files of its own; some need more than the wheel."""
    folder = ROOT / "src" / "mjhab" / "examples"
    assert {path.name for path in folder.iterdir() if path.name != "__pycache__"} == set(
        EXAMPLES
    )
    for name, example in EXAMPLES.items():
        calls = "python" if example.needs else "mjhab"
        assert f"{{}}/{name}" in example.command
        assert f" {calls} " in f" {example.command}"


def test_every_folder_of_code_is_a_package() -> None:
    """A folder without ``__init__.py`` is importable, but `make docs` does not find it."""
    source = ROOT / "src" / "mjhab"
    folders = {path.parent for path in source.rglob("*.py")}
    plain = {path for path in folders if not (path / "__init__.py").is_file()}
    assert {
        path for path in plain if not path.is_relative_to(source / "examples")
    } == set()
