"""The guard against changes of results: its small version gives the same twice, and it sees a change."""

from __future__ import annotations

from tests.guard.fingerprint import fingerprints, report_differences
from tests.refusals import command


def test_two_recordings_are_the_same_in_every_fingerprint() -> None:
    """The commands of one run in processes of their own, those of the other in this one."""
    first = fingerprints(small=True)
    assert report_differences(first, fingerprints(small=True, run=command)) == 0
    assert {name.split("/")[0] for name in first} == {
        "env",
        "export",
        "model",
        "set_table-pick",
    }


def test_a_change_is_reported() -> None:
    assert report_differences({"a": "1", "b": "2"}, {"a": "1", "b": "3"}) == 1
    assert report_differences({"a": "1"}, {"a": "1", "b": "2"}) == 1
