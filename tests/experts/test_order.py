"""The folders of the experts stand one above the other: each imports those below it alone."""

from __future__ import annotations

from pathlib import Path

import mjhab.experts
from tests.test_imports import imported

FROM_BELOW = ("arm", "base", "planning", "skills")


def test_folders_import_those_below_them_alone() -> None:
    root = Path(mjhab.experts.__file__).parent
    folders = {path.name for path in root.iterdir() if (path / "__init__.py").is_file()}
    assert folders == set(FROM_BELOW)
    for level, folder in enumerate(FROM_BELOW):
        above = tuple(f"mjhab.experts.{name}." for name in FROM_BELOW[level + 1 :])
        for path in (root / folder).rglob("*.py"):
            wrong = [name for name in imported(path) if f"{name}.".startswith(above)]
            assert not wrong, f"{folder}/{path.name} imports {wrong} of a folder above it"
