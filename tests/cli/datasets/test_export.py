"""``mjhab export`` and ``mjhab data report`` from the command line."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path
from typing import Any

import pytest

from mjhab.cli.exits import INTERRUPTED, OK, USAGE
from mjhab.cli.main import main
from mjhab.data.store.reading import RecordedEpisode
from tests.data.make import record_pictures


@pytest.fixture
def shard(tmp_path: Path) -> Path:
    record_pictures(tmp_path / "a.h5", range(3))
    return tmp_path / "a.h5"


def test_export_lerobot(
    shard: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["export", "lerobot", str(shard), "--out", str(tmp_path / "set")]
    assert main([*command, "--version", "3.0", "--where", "index < 2", "--json"]) == OK
    said = json.loads(capsys.readouterr().out)
    assert (said["episodes"], said["frames"]) == (2, 40)
    assert main(command) == USAGE and "--overwrite" in capsys.readouterr().err
    assert (
        main([*command, "--overwrite", "--version", "2.1", "--no-rgb", "--no-depth"])
        == OK
    )
    assert "without images" in capsys.readouterr().out
    assert main([*command, "--overwrite", "--quality", "90"]) == USAGE


def test_without_pyarrow_the_extra_is_named(
    shard: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in [
        name for name in sys.modules if name.startswith("mjhab.data.export.lerobot")
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr("mjhab.data.export.lerobot", raising=False)
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert (
        main(["export", "lerobot", str(shard), "--out", str(tmp_path / "set")]) == USAGE
    )
    assert "[data]'" in capsys.readouterr().err


def test_export_maniskill(
    shard: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["export", "maniskill", str(shard), "--out", str(tmp_path / "out")]
    assert main([*command, "--json"]) == OK
    said = json.loads(capsys.readouterr().out)
    assert (said["episodes"], said["frames"]) == (3, 60) and Path(
        said["files"][0]
    ).name == "024_bowl.h5"


@pytest.mark.parametrize("format", ["lerobot", "maniskill"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_stopped_export_goes_on(
    shard: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    format: str,
    number: signal.Signals,
    request: pytest.FixtureRequest,
) -> None:
    real = RecordedEpisode.array
    left = [10]
    # A shell's background job, as tests may be, ignores Ctrl-C from its start.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))

    def array(self: RecordedEpisode, path: str) -> Any:
        left[0] -= 1
        if left[0] == 0:
            signal.raise_signal(number)
        return real(self, path)

    command = ["export", format, str(shard), "--out", str(tmp_path / "set")]
    monkeypatch.setattr(RecordedEpisode, "array", array)
    assert (
        main(command) == INTERRUPTED
        and "The same command with --resume continues" in capsys.readouterr().err
    )
    assert (
        not (tmp_path / "set").exists()
        and signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    )
    assert main(command) == USAGE and "is unfinished" in capsys.readouterr().err
    assert main([*command, "--resume"]) == OK and "3 episodes" in capsys.readouterr().out


def test_data_report(
    shard: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "deep/report.html"
    assert main(["data", "report", str(shard), "--out", str(out), "--json"]) == OK
    assert json.loads(capsys.readouterr().out)["bytes"] == out.stat().st_size
    assert main(["data", "report", str(shard), "--out", str(tmp_path)]) == USAGE
