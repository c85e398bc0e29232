"""A folder of a run: refused with what differs, and left empty where nothing was made."""

from __future__ import annotations

from pathlib import Path

import pytest

from mjhab.core.errors import UsageError
from mjhab.core.files.outputs import PROBE
from mjhab.core.files.run_folder import RunFolder
from tests.refusals import refused


class Counted(RunFolder):
    """Work are the files ``*.txt`` that hold something."""

    WORK = ("*.txt",)
    FREE_KEYS = frozenset({"threads"})


CONFIG = {"seed": 0, "env": {"task": "a", "home": "b"}, "threads": 1}


def test_a_resumed_run_names_the_nearest_differences(tmp_path: Path) -> None:
    Counted.open(tmp_path / "run", CONFIG).close()
    again = {**CONFIG, "threads": 2}
    Counted.open(tmp_path / "run", again, resume=True).close()
    other = {**CONFIG, "env": {"task": "c", "home": "b"}, "mjhab": "9.9"}
    with pytest.raises(UsageError) as refused:
        Counted.open(tmp_path / "run", other, resume=True)
    said = str(refused.value)
    assert "env.task = 'a', now it is 'c'" in said and "home" not in said
    assert "mjhab = None, now it is '9.9'" in said and "--overwrite" not in said


@pytest.mark.parametrize(("content", "stays"), [("", False), ("work", True)])
def test_a_refused_run_leaves_its_work_alone(
    content: str, stays: bool, tmp_path: Path
) -> None:
    with pytest.raises(UsageError), Counted.open(tmp_path / "run", CONFIG) as folder:
        (folder.path / "below").mkdir()
        (folder.path / "below" / "a.txt").write_text(content, encoding="utf-8")
        raise UsageError("no")
    assert (tmp_path / "run").exists() is stays
    assert not stays or (tmp_path / "run" / "below" / "a.txt").is_file()


def test_one_process_writes(tmp_path: Path) -> None:
    with Counted.open(tmp_path, CONFIG), refused(said="being written"):
        Counted.open(tmp_path, CONFIG, resume=True)
    Counted.open(tmp_path, CONFIG, resume=True).close()
    assert [entry.name for entry in tmp_path.iterdir()] == ["config.json"]


def test_what_another_process_tries_to_write_is_no_content(tmp_path: Path) -> None:
    (tmp_path / f"{PROBE}x1").mkdir()
    Counted.open(tmp_path, CONFIG).close()
