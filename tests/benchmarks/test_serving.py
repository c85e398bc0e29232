"""`benchmarks.serving`: a server that is killed while episodes run."""

from __future__ import annotations

from benchmarks.serving import ServingSpec, measure_restarts


def test_no_episode_is_lost_when_the_server_is_killed() -> None:
    found = measure_restarts(ServingSpec(worlds=2, steps=200, restarts=1))
    assert found["restarts"] == 1 and found["steps"] >= 200
    assert found["episodes"] == 2 == found["finished"] + found["marked"]
