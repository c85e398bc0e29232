"""``mjhab examples``: what comes with the package, as files of the user's own."""

from __future__ import annotations

import errno
import json
import shlex
from pathlib import Path

import pytest

from mjhab.cli.machine.examples import EXAMPLES, SOURCE, Example, copy_examples
from mjhab.cli.main import main, parse
from tests.refusals import refused

FAILED = 1
USAGE = 2


def test_every_example_is_named() -> None:
    there = {path.name for path in SOURCE.iterdir() if path.name != "__pycache__"}
    assert set(EXAMPLES) == there


@pytest.mark.parametrize("example", EXAMPLES.values(), ids=EXAMPLES)
def test_its_command_names_a_file_that_is_there(example: Example) -> None:
    variables, words = [], shlex.split(example.command.format(SOURCE))
    while "=" in words[0]:
        variables.append(words.pop(0))
    assert words[0] == "python" or (words[0] == "mjhab" and parse(words[1:]))
    paths = [word.partition("=")[2] or word for word in (*variables, *words)]
    named = [path for path in paths if path.startswith(str(SOURCE))]
    assert named and all(Path(path).exists() for path in named)


def test_they_are_copied_once_and_nothing_of_the_user_is_overwritten(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "mine"
    assert main(["examples", "--out", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["written"] > 10 and str(out) in told["commands"]["push"]
    assert (out / "mug/mug.glb").read_bytes() == (SOURCE / "mug/mug.glb").read_bytes()
    assert not list(out.rglob("__pycache__"))
    (out / "clear_table.py").unlink()
    assert copy_examples(out) == 1
    (out / "clear_table.py").write_text("mine")
    (out / "control_mode.py").unlink()
    assert main(["examples", "--out", str(out)]) == USAGE
    assert "clear_table.py" in capsys.readouterr().err
    assert (out / "clear_table.py").read_text() == "mine"
    assert not (out / "control_mode.py").exists()


def test_commands_are_for_a_shell_whatever_the_folder_is_called(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "my examples"
    assert main(["examples", "--out", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    words = shlex.split(told["commands"]["robot"])
    assert words[:2] == [f"MJHAB_PLUGINS={out}/robot/boxy.py", "mjhab"]


def test_a_full_disk_is_told_with_the_file_that_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(path: Path, content: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    assert main(["examples", "--out", str(tmp_path / "mine")]) == FAILED
    told = capsys.readouterr().err
    assert f"{tmp_path / 'mine'}/" in told and "No space left on device" in told
    assert str(SOURCE) not in told
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("")
    with refused("out", str(tmp_path / "a")):
        copy_examples(tmp_path / "a")
