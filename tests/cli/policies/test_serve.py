"""`mjhab serve` and `mjhab eval --policy ws://...`: what they print, what they refuse, how they end."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from mjhab.cli.main import main
from mjhab.evaluation.score.result import ScoreResult
from mjhab.serving.address import Address
from mjhab.serving.client import Connection
from tests.serving.constant import Constant, serving


def test_the_first_line_is_the_port_and_ctrl_c_ends_it() -> None:
    command = [
        sys.executable,
        *"-m mjhab.cli.main serve zero --port 0 --json".split(),
    ]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as server:
        assert server.stdout is not None and server.stderr is not None
        port = int(server.stdout.readline())
        metadata = Connection(Address(f"ws://127.0.0.1:{port}")).greet()
        assert metadata["mjhab"]["policy"] == "zero"
        server.send_signal(signal.SIGINT)
        out = server.stdout.read()
        told = server.stderr.read()
        assert server.wait(20) == 0
    assert json.loads(out.splitlines()[-1]) == {"port": port, "requests": 0, "refused": 0}
    assert f"zero at ws://127.0.0.1:{port}, dialect openpi" in told


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["serve", "expret"], "Did you mean 'expert'"),
        (["serve", "expert", "--dialect", "grpc"], "unknown dialect 'grpc'"),
        (["serve", "expert", "--port", "70000"], "port must be at most 65,535"),
        (
            ["serve", "expert", "--max-message-mb", "0"],
            "max_message_mb must be at least 1",
        ),
        (["serve", "ws://localhost:1"], "is served already"),
        (["serve", "student", "--subtask", "pikc"], "Did you mean 'pick'"),
        (
            ["serve", "student", "--subtask", "pick", "--target", "013_aple"],
            "Did you mean '013_apple'",
        ),
        (["serve", "zero", "--style", "speed=0.5"], "style must be left out"),
        (["serve", "expert", "--style", "speeed=0.5"], "Did you mean 'speed'"),
        (["serve", "expert", "--assets", "nowhere"], "'nowhere'"),
        (
            ["eval", "--policy", "ws://127.0.0.1:1"],
            "no policy server at ws://127.0.0.1:1",
        ),
        (
            ["eval", "--policy", "expert", "--dialect", "openpi"],
            "--dialect: for a served policy",
        ),
        (
            ["eval", "--policy", "ws://127.0.0.1:1", "--batch"],
            "batch must be left out",
        ),
        (["score", "--check", "nowhere.json"], "nowhere.json: does not exist"),
        (["score", "--track", "subtask"], "Did you mean 'subtasks'"),
        (["score", "--episodes", "0"], "episodes must be at least 1"),
    ],
)
def test_bad_input_is_told(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("server_of", "words", "error"),
    [
        (
            {"delay_s": 2.0},
            ["--timeout", "0.1", "--first-timeout", "0.3"],
            "no answer within 0.3 s",
        ),
        ({"error": RuntimeError("no memory")}, [], "RuntimeError: no memory"),
        ({}, [], ""),
    ],
    ids=["late", "error", "good"],
)
def test_json_has_latencies_whether_or_not_something_was_answered(
    server_of: dict[str, Any],
    words: list[str],
    error: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with serving(Constant(**server_of)) as server:
        command = [
            "eval",
            "--policy",
            f"ws://127.0.0.1:{server.port}",
            "--subtask",
            "close",
        ]
        command += "--episodes 1 --films 0 --threads 1 --camera-size 16".split()
        code = 1 if error else 0
        run = main([*command, *words, "--out", str(tmp_path / "run"), "--json"])
        assert run == code
        told = json.loads(capsys.readouterr().out.splitlines()[-1])
        # Nothing is known of what the subtask would have been if the policy ended it.
        assert told["upper_bound"] == ([None] if error else [told["success_once"]])
        assert told["latency_ms"].keys() == {"p50", "p99"}
        assert (told["latency_ms"]["p50"] is None) == ("no answer" in error)
        # Nothing is left to do: the latencies are those of the run.
        assert (
            main([*command, *words, "--out", str(tmp_path / "run"), "--json", "--resume"])
            == code
        )
        again = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert again["latency_ms"] == told["latency_ms"]
    assert again["out_of_range"] == told["out_of_range"] == {}
    page = (tmp_path / "run" / "report.html").read_text()
    assert ("ended 1 of 1 episodes with an error" in page) == bool(error)
    record = json.loads((tmp_path / "run" / "episodes.jsonl").read_text())
    assert error in record.get("error", "")


@pytest.mark.parametrize(("errors", "code"), [(0, 0), (1, 1)])
def test_a_score_with_errors_of_the_policy_is_exit_code_1(
    errors: int, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    summary = {
        "score": 0.0,
        "episodes": 1,
        "complete": False,
        "errors": errors,
        "rows": [],
        "tainted": 0,
        "other_starts": 0,
    }
    result = ScoreResult({"track": "subtasks", "split": "test"}, summary, (), "0")
    monkeypatch.setattr("mjhab.cli.policies.score.score", lambda *_: result)
    assert main(["score", "--json", "--out", str(tmp_path / "score")]) == code
