"""`benchmarks.perturb`: an environment without and one with an axis, timed in turns."""

from __future__ import annotations

from benchmarks.perturb import PerturbSpec, measure


def test_the_clean_environment_is_the_measure() -> None:
    asked = PerturbSpec(("language",), obs="state", worlds=1, steps=1, turns=1)
    found = measure(asked)["axes"]
    assert list(found) == ["clean", "language"] and found["clean"]["slower"] == 0.0
    assert all(row["step_ms"] > 0 for row in found.values())
