"""The bench of peers: rows by name, and the reason where a peer is missing."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from benchmarks import peers
from benchmarks.peers_worker import PEERS, measure


@pytest.fixture(autouse=True)
def ours(monkeypatch: pytest.MonkeyPatch) -> None:
    """No environment is made: rounds of mjhab get faster and faster."""
    speeds = iter(range(100))

    def row(spec: peers.PeersSpec, worlds: int, obs: str) -> dict[str, object]:
        return {
            "name": f"mjhab {worlds} {obs}",
            "version": "0",
            "steps_per_s": next(speeds),
            "images_per_s": None,
        }

    monkeypatch.setattr(peers, "_ours", row)
    names = list(PEERS)[:1]
    monkeypatch.setattr(peers, "PEERS", {name: PEERS[name] for name in names})


def test_missing_peers_are_named_with_the_reason(
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = ["--python", sys.executable, "--seconds", "0.1", "--rounds", "2", "--json"]
    assert peers.main([*words, "--worlds", "1"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [row["steps_per_s"] for row in found["rows"]] == [2, 3]
    assert "robosuite" in found["missing"]["robosuite PickPlace, states"]


def test_an_interpreter_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert peers.main(["--python", str(Path("nowhere/python")), "--rounds", "1"]) == 0
    assert "not measured (No such file or directory" in capsys.readouterr().out


def test_a_measurement_counts_steps_and_images(monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[int] = []
    monkeypatch.setitem(PEERS, "toy", lambda: ("1.0", lambda: steps.append(1), 2))
    found = measure("toy", 0.05)
    # The first step, which may compile, is not counted.
    assert found["steps_per_s"] == pytest.approx((len(steps) - 1) / 0.05, rel=0.5)
    assert found["images_per_s"] == pytest.approx(2 * found["steps_per_s"], rel=0.01)
