"""`benchmarks.latency`: success by latency of a policy that is served while the world goes on."""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.latency import PAGE, RESULT, LatencySpec, measure


def test_the_policy_is_later_with_every_latency(tmp_path: Path) -> None:
    spec = LatencySpec(
        policy="zero",
        latencies=(0.0, 100.0),
        meanwhile=("still",),
        execute=1,
        episodes=1,
        worlds=1,
        out=tmp_path / "latency",
    )
    found = measure(spec)
    late = [row["late_steps"] for row in found["rows"]]
    # Two of three control steps are those of waiting.
    assert late[0] == 0 and 100 <= late[1] <= 200
    assert json.loads((spec.out / RESULT).read_text()) == found
    assert "latency of the answers [ms]" in (spec.out / PAGE).read_text()
    assert measure(spec) == found
