"""Commands whose stderr cannot be written: messages are lost, the work is not."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from mjhab.cli.main import main
from mjhab.cli.streams import SturdyStream
from mjhab.evaluation import evaluate
from mjhab.rollout.store import read_records
from tests.rollout.fake_env import FakeEnv


def full_device() -> io.TextIOWrapper:
    return open("/dev/full", "w", encoding="utf-8")


def pipe_without_reader() -> io.TextIOWrapper:
    reader, writer = os.pipe()
    os.close(reader)
    return open(writer, "w", encoding="utf-8")


@pytest.mark.parametrize("unwritable", [full_device, pipe_without_reader, lambda: None])
def test_an_evaluation_is_whole_where_stderr_cannot_be_written(
    unwritable: object,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert callable(unwritable)
    monkeypatch.setattr(
        evaluate, "make_env", lambda spec, options: FakeEnv(spec.asked.num_envs)
    )
    monkeypatch.setattr(sys, "stderr", unwritable())
    run = ["eval", "--policy", "zero", "--episodes", "4", "--worlds", "2", "--films", "0"]
    assert main([*run, "--out", str(tmp_path / "run"), "--json"]) == 0
    sys.stderr.write("more text than a buffer holds " * 1000)
    sys.stderr.flush()
    sys.stderr.close()
    assert json.loads(capsys.readouterr().out)["episodes"] == 4
    assert len(read_records(tmp_path / "run")) == 4
    assert (tmp_path / "run" / "report.html").is_file()
    assert (tmp_path / "run" / "summary.json").is_file()


def test_a_refusal_without_stderr_has_its_exit_code(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "stderr", full_device())
    assert main(["eval", "--task", "no_such_task"]) == 2
    sys.stderr.close()


def test_closed_streams_are_opened_before_a_file_gets_their_number() -> None:
    code = (
        "import os, sys; from mjhab.cli.main import main\n"
        "main(['--version'])\n"
        "sys.exit(0 if os.open('/dev/null', os.O_RDONLY) > 2 else 3)"
    )
    command = f'exec "{sys.executable}" -c "{code}" <&- >&- 2>&-'
    assert subprocess.run(command, shell=True, timeout=60, check=False).returncode == 0


@pytest.mark.parametrize("is_closed", [False, True])
def test_a_stream_without_a_descriptor_discards_what_it_cannot_write(
    is_closed: bool,
) -> None:
    stream = io.StringIO()
    if is_closed:
        stream.close()
    sturdy = SturdyStream(stream)
    assert sturdy.write("text") == 4
    sturdy.flush()
