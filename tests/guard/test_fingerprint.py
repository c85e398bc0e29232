"""The guard against changes of results: its small version gives the same twice, and it sees a change."""

from __future__ import annotations

from tests.guard.fingerprint import fingerprints, report_differences


def test_two_recordings_are_the_same_in_every_fingerprint() -> None:
    first = fingerprints(small=True)
    assert report_differences(first, fingerprints(small=True)) == 0
    assert {name.split("/")[0] for name in first} == {
        "env",
        "export",
        "model",
        "set_table-pick",
    }


def test_a_change_is_reported() -> None:
    assert report_differences({"a": "1", "b": "2"}, {"a": "1", "b": "3"}) == 1
    assert report_differences({"a": "1"}, {"a": "1", "b": "2"}) == 1
