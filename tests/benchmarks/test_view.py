"""`benchmarks.view` counts what a page is sent."""

from __future__ import annotations

from benchmarks.view import ViewSpec, measure_view
from tests.refusals import refused


def test_frames_and_bytes_are_counted() -> None:
    measured = measure_view(ViewSpec(worlds=(1, 4), seconds=0.5, threads=1))
    assert list(measured) == ["1", "4"]
    for found in measured.values():
        assert found["opening_mb"] > 0.3, "a home has more bytes"
        assert all(value > 0 for value in found.values()), found


def test_what_cannot_be_shown_is_told() -> None:
    with refused(said="worlds must be at least 1"):
        measure_view(ViewSpec(worlds=(0,)))
    with refused("policy", "expret", expected="expert"):
        measure_view(ViewSpec(worlds=(1,), policy="expret"))
