"""Numbers over records: the keys for machines, intervals, curves and groups."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace
from itertools import pairwise
from statistics import median

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mjhab.core.names import kind_of
from mjhab.reports.metrics import (
    alone_rates,
    labels_by_kind,
    progress_curves,
    rows_by_kind,
    rows_by_position,
    summarize,
    wilson,
)
from mjhab.rollout.loop import rollout
from mjhab.rollout.policy import ZeroPolicy
from mjhab.rollout.records import EpisodeRecord
from tests.rollout.fake_env import SET_TABLE, FakeEnv

KEYS = [
    "episodes",
    "success_once",
    "success_at_end",
    "progressive",
    "upper_bound",
    "labels",
    "legacy_labels",
]
KEYS += ["tainted", "errors", "skipped_homes", "subtasks", "seconds"]


@pytest.fixture(scope="module")
def records() -> list[EpisodeRecord]:
    return rollout(
        FakeEnv(8, quality=0.9, taint_chance=0.3), ZeroPolicy(), range(30), seed=0
    )


def test_summary_has_exactly_the_keys_for_machines(records: list[EpisodeRecord]) -> None:
    summary = summarize(records, 12.345)
    assert list(summary) == KEYS
    assert summary["episodes"] == 30 and summary["seconds"] == 12.35
    assert 0 < summary["success_once"] == summary["success_at_end"] < 1
    assert summary["tainted"] == sum(1 for record in records if record.taint) > 0
    assert sum(summary["labels"].values()) == sum(
        len(record.subtasks) for record in records
    )
    legacy = [subtask.legacy_label for record in records for subtask in record.subtasks]
    assert summary["legacy_labels"] == {
        name: legacy.count(name) for name in set(legacy) - {None}
    }
    json.dumps(summary, allow_nan=False)


def test_summary_of_nothing() -> None:
    summary = summarize([], 0.0)
    assert list(summary) == KEYS
    assert (
        summary["success_once"] == 0.0
        and summary["progressive"] == []
        and summary["labels"] == summary["legacy_labels"] == {}
    )


def test_progressive_counts_episodes_that_got_so_far(
    records: list[EpisodeRecord],
) -> None:
    curve, bound = progress_curves(records)
    assert len(curve) == len(bound) == len(SET_TABLE)
    for k, value in enumerate(curve):
        assert value == pytest.approx(
            sum(record.completed > k for record in records) / len(records), abs=1e-4
        )
    assert curve[-1] == pytest.approx(
        sum(record.success_once for record in records) / len(records), abs=1e-4
    )
    assert bound == pytest.approx(curve, abs=2e-4), (
        "rates inside the chain multiply to the curve itself"
    )


def test_bound_multiplies_the_rates_of_subtasks_alone(
    records: list[EpisodeRecord],
) -> None:
    alone = {
        ("pick", "024_bowl"): 0.5,
        ("pick", ""): 0.8,
        ("navigate", ""): 1.0,
        ("open", ""): 1.0,
    }
    alone |= {("place", ""): 1.0, ("close", ""): 1.0}
    bound = progress_curves(records, alone)[1]
    assert (
        bound[:3] == [1.0, 1.0, 1.0]
        and bound[3:11] == [0.5] * 8
        and bound[11:] == [0.4] * 5
    )


def test_there_is_no_bound_of_what_nobody_tried(records: list[EpisodeRecord]) -> None:
    stopped = [
        dataclasses.replace(record, subtasks=(), completed=0, error="no answer")
        for record in records
    ]
    assert progress_curves(stopped)[1] == [None] * len(SET_TABLE)
    bound = progress_curves(stopped, {("navigate", ""): 0.5})[1]
    assert bound[0] == 0.5 and bound[1:] == [None] * (len(SET_TABLE) - 1)
    # What comes after a subtask that always fails is 0, tried or not.
    assert progress_curves(stopped, {("navigate", ""): 0.0})[1] == [0.0] * len(SET_TABLE)
    json.dumps(summarize(stopped, 1.0), allow_nan=False)


def test_alone_rates_come_from_single_subtask_runs(records: list[EpisodeRecord]) -> None:
    runs = rollout(
        FakeEnv(4, plan=(("pick", "013_apple_:0000"),), subtask="pick"),
        ZeroPolicy(),
        range(20),
        seed=0,
    )
    rate = sum(record.success_once for record in runs) / 20
    assert alone_rates([*runs, *records]) == {
        ("pick", ""): rate,
        ("pick", "013_apple"): rate,
    }


def test_rows_count_what_was_reached(records: list[EpisodeRecord]) -> None:
    rows = rows_by_position(records)
    assert [(row.kind, row.target) for row in rows] == [
        (kind, kind_of(target)) for kind, target in SET_TABLE
    ]
    assert rows[0].reached == 30
    for before, after in pairwise(rows):
        assert after.reached == before.successes
    for row in rows:
        assert row.interval[0] <= row.success_once <= row.interval[1]
    by_kind = rows_by_kind(records)
    assert sum(row.reached for row in by_kind) == sum(row.reached for row in rows)
    assert {(row.kind, row.target) for row in by_kind} == {
        (row.kind, row.target) for row in rows
    }


def test_rows_tell_steps_to_success_and_mark_teleports(
    records: list[EpisodeRecord],
) -> None:
    def judged_over_200_steps(record: EpisodeRecord) -> EpisodeRecord:
        subtasks = [
            replace(
                subtask,
                teleported=subtask.kind == "navigate",
                end_step=subtask.start_step + 200,
            )
            for subtask in record.subtasks
        ]
        return replace(record, subtasks=tuple(subtasks))

    rows = rows_by_kind([judged_over_200_steps(record) for record in records])
    for row in rows:
        own = [
            subtask
            for record in records
            for subtask in record.subtasks
            if (subtask.kind, kind_of(subtask.target)) == (row.kind, row.target)
        ]
        assert row.judged == (row.kind != "navigate")
        # In these episodes success ends a subtask.
        needed = [s.end_step - s.start_step for s in own if s.success_once]
        wanted = median(needed) if row.judged else None
        assert row.steps_to_success == wanted != 200
        peaks = [s.peak_finger_force or 0.0 for s in own]
        assert row.peak_finger_force == pytest.approx(median(peaks), abs=0.06)
    summary = summarize(records, 1.0)
    assert [row["kind"] for row in summary["subtasks"]] == [kind for kind, _ in SET_TABLE]


def test_rows_without_any_episode_reaching_them() -> None:
    rows = rows_by_position(rollout(FakeEnv(1, quality=0.0), ZeroPolicy(), [0], seed=0))
    assert (
        rows[1].reached,
        rows[1].success_once,
        rows[1].interval,
        rows[1].peak_force,
    ) == (
        0,
        0.0,
        (0.0, 1.0),
        None,
    )


def test_labels_are_counted(records: list[EpisodeRecord]) -> None:
    counts = labels_by_kind(records)
    assert set(counts) == {kind for kind, _ in SET_TABLE}
    assert counts["pick"]["straightforward_success"] > 0


def test_target_type_drops_the_instance_number_only() -> None:
    assert kind_of("024_bowl_:0003") == "024_bowl"
    assert kind_of("goal of 013_apple_:0000") == "goal of 013_apple"
    assert kind_of("kitchen_counter/drawer3") == "kitchen_counter/drawer3"


def test_wilson_known_values() -> None:
    assert wilson(0, 0) == (0.0, 1.0)
    assert wilson(8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert wilson(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-4)


@given(st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_holds_the_rate_and_mirrors(case: tuple[int, int]) -> None:
    successes, total = case
    low, high = wilson(successes, total)
    assert (
        0.0 <= low <= successes / total + 1e-4 and successes / total - 1e-4 <= high <= 1.0
    )
    other = wilson(total - successes, total)
    assert (1 - high, 1 - low) == pytest.approx(other, abs=2e-4)
