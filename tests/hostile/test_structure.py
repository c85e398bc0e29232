"""A few draws of the structure-aware fuzz (`structure.py`): data or an error of ours, never a traceback."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.hostile.structure import SUBJECTS, try_draws

DRAWS = 5


@pytest.mark.parametrize("name", [name for name in SUBJECTS if name != "replay"])
def test_a_changed_part_ends_in_data_or_in_an_error_of_ours(
    name: str, tmp_path: Path
) -> None:
    template = tmp_path / "template"
    template.mkdir()
    SUBJECTS[name].make(template)
    shutil.copytree(template, tmp_path / "sound")
    assert SUBJECTS[name].read(tmp_path / "sound"), "the unchanged file is refused"
    assert (
        sum(1 for _ in try_draws(name, range(DRAWS), template, tmp_path / "work"))
        == DRAWS
    )
