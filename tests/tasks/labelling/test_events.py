"""Events are edges; the published labels follow from event lists; the tracker keeps both."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mjhab.tasks.label_state import History
from mjhab.tasks.labelling.events import blank, event_names, step_events
from mjhab.tasks.labelling.labels import label_history, label_names
from mjhab.tasks.labelling.legacy import extend, legacy_history, legacy_label
from mjhab.tasks.labelling.tracker import SubtaskTracker
from mjhab.tasks.plan import SubtaskKind
from mjhab.tasks.subtasks.registry import event_columns, spec_of
from tests.tasks.build import (
    HISTORY_FIELDS,
    assert_same,
    history,
    random_history,
    to_torch,
)

PICK, PLACE, NAVIGATE, OPEN, CLOSE = range(5)
X = "excessive_collisions"


def stream(kind: int, record: History) -> list[list[str]]:
    """Event names of each step 1..T of one world."""
    kinds = np.array([kind])
    steps = range(1, record.success.shape[0])
    return [
        event_names(kinds, step_events(kinds, record.row(t - 1), record.row(t)))[0]
        for t in steps
    ]


def test_pick_events() -> None:
    record = history(
        contact="01110", is_grasped="00110", success="00010", force_ok="11110"
    )
    assert stream(PICK, record) == [
        ["contact"],
        ["grasped"],
        ["success"],
        ["dropped", X, "lost_contact", "lost_success"],
    ]


def test_place_events_tell_where_the_object_was_let_go() -> None:
    record = history(is_grasped="1101100", at_goal="0111010")
    assert stream(PLACE, record) == [
        ["at_goal"],
        ["released_at_goal"],
        ["grasped"],
        ["left_goal"],
        ["at_goal", "released_at_goal"],
        ["left_goal"],
    ]
    assert stream(PLACE, history(is_grasped="10", at_goal="00")) == [
        ["released_outside_goal"]
    ]
    assert stream(PLACE, history(is_grasped="10", at_goal="10")) == [
        ["released_outside_goal", "left_goal"]
    ]


def test_navigate_events() -> None:
    record = history(near="0110", is_grasped="0010", success="0010")
    assert stream(NAVIGATE, record) == [
        ["navigated_close"],
        ["grasped", "success"],
        ["dropped", "lost_navigated_close", "lost_success"],
    ]


def test_excess_is_told_once() -> None:
    assert stream(NAVIGATE, history(force_ok="11000")) == [[], [X], [], []]


def test_open_and_close_events() -> None:
    record = history(
        contact="01110",
        opened="00100",
        slightly_opened="01110",
        closed="10001",
        success="00100",
    )
    assert stream(OPEN, record) == [
        ["contact", "slightly_opened"],
        ["opened", "success"],
        ["lost_success"],
        ["closed", "lost_contact"],
    ]
    record = history(
        contact="0111",
        closed="0010",
        slightly_closed="0110",
        opened="1101",
        success="0010",
    )
    assert stream(CLOSE, record) == [
        ["contact", "slightly_closed"],
        ["closed", "success"],
        ["opened", "lost_success"],
    ]


def test_a_finished_plan_has_no_events_and_kinds_have_only_theirs() -> None:
    rng = np.random.default_rng(0)
    worlds = 2000
    rows = [
        History(**{n: rng.random(worlds) < 0.5 for n in HISTORY_FIELDS}) for _ in range(2)
    ]
    for kind in range(-1, 5):
        kinds = np.full(worlds, kind)
        flags = step_events(kinds, *rows)
        assert flags.shape == (worlds, len(event_columns())) and flags.dtype == bool
        seen = {name for names in event_names(kinds, flags) for name in names}
        assert seen == (set(spec_of(kind).events) if kind >= 0 else set())


def test_torch_flags_the_same_in_value_and_dtype() -> None:
    rng = np.random.default_rng(1)
    rows = [
        History(**{n: rng.random(600) < 0.5 for n in HISTORY_FIELDS}) for _ in range(2)
    ]
    kinds = rng.integers(-1, 5, 600)
    flags = step_events(kinds, *rows)
    others = [to_torch(row) for row in rows]
    torch_kinds = to_torch(History(**dict.fromkeys(HISTORY_FIELDS, kinds))).success
    assert_same(flags, step_events(torch_kinds, *others))
    assert event_names(kinds, flags) == event_names(
        torch_kinds, step_events(torch_kinds, *others)
    )
    assert_same(blank(rows[0]).force_ok, blank(others[0]).force_ok)


def test_event_lists_drop_immediate_repeats_and_what_they_do_not_count() -> None:
    events: list[str] = []
    extend(events, PICK, ["contact", "lost_contact"])
    extend(events, PICK, ["contact", "grasped"])
    extend(events, PICK, ["contact", "opened"])
    assert events == ["contact", "grasped", "contact"]


LEGACY = [
    (PICK, "contact grasped success", True, "straightforward_success"),
    (PICK, "contact grasped dropped grasped success", True, "winding_success"),
    (PICK, "contact grasped success contact", True, "success_then_drop"),
    (
        PICK,
        f"contact grasped success {X} dropped",
        True,
        "success_then_excessive_collisions",
    ),
    (PICK, "grasped success", True, "success_then_excessive_collisions"),
    (PICK, f"contact {X}", False, "excessive_collision_failure"),
    (PICK, "", False, "mobility_failure"),
    (PICK, "grasped", False, "cant_grasp_failure"),
    (PICK, "contact grasped dropped", False, "drop_failure"),
    (PICK, "contact grasped dropped grasped", False, "too_slow_failure"),
    (
        PLACE,
        f"grasped at_goal released_at_goal success {X}",
        True,
        "success_then_excessive_collisions",
    ),
    (PLACE, "at_goal success left_goal", True, "dubious_success"),
    (PLACE, "grasped at_goal released_at_goal success", True, "placed_in_goal_success"),
    (
        PLACE,
        "grasped released_outside_goal at_goal success",
        True,
        "dropped_to_goal_success",
    ),
    (
        PLACE,
        "grasped at_goal left_goal at_goal released_at_goal success",
        True,
        "winding_success",
    ),
    (PLACE, X, False, "excessive_collision_failure"),
    (PLACE, "", False, "didnt_grasp_failure"),
    (PLACE, "grasped", False, "didnt_reach_goal_failure"),
    (PLACE, "grasped at_goal released_at_goal left_goal", False, "place_in_goal_failure"),
    (
        PLACE,
        "grasped at_goal released_outside_goal left_goal",
        False,
        "drop_to_goal_failure",
    ),
    (PLACE, "grasped at_goal", False, "wont_let_go_failure"),
    (PLACE, "grasped at_goal released_at_goal", False, "too_slow_failure"),
    (NAVIGATE, f"success {X}", True, "success_then_excessive_collisions"),
    (NAVIGATE, "grasped dropped success", True, "success_then_dropped"),
    (NAVIGATE, "grasped success", True, "navigation_success"),
    (NAVIGATE, X, False, "excessive_collision_failure"),
    (NAVIGATE, "dropped", False, "dropped_failure"),
    (NAVIGATE, "", False, "navigation_failure"),
    (OPEN, f"opened success {X}", True, "success_then_excessive_collisions"),
    (OPEN, "opened success closed", True, "dubious_success"),
    (OPEN, "contact slightly_opened opened success", True, "open_success"),
    (OPEN, X, False, "excessive_collision_failure"),
    (OPEN, "slightly_opened opened", False, "cant_reach_articulation_failure"),
    (OPEN, "contact slightly_opened opened closed", False, "closed_after_open_failure"),
    (OPEN, "contact opened slightly_opened", False, "slightly_open_failure"),
    (OPEN, "contact slightly_opened opened", False, "too_slow_failure"),
    (OPEN, "contact", False, "cant_open_failure"),
    (CLOSE, f"closed success {X}", True, "success_then_excessive_collisions"),
    (CLOSE, "closed success opened", True, "dubious_success"),
    (CLOSE, "contact closed success slightly_closed", True, "closed_success"),
    (CLOSE, X, False, "excessive_collision_failure"),
    (CLOSE, "", False, "cant_reach_articulation_failure"),
    (CLOSE, "contact slightly_closed closed opened", False, "open_after_closing_failure"),
    (CLOSE, "contact closed opened slightly_closed", False, "slightly_closed_failure"),
    (CLOSE, "contact slightly_closed closed", False, "too_slow_failure"),
    (CLOSE, "contact", False, "cant_close_failure"),
]


@pytest.mark.parametrize(("kind", "events", "success", "expected"), LEGACY)
def test_published_rules(kind: int, events: str, success: bool, expected: str) -> None:
    assert legacy_label(kind, events.split(), success) == expected


def test_published_rules_that_look_at_the_first_step_of_a_place() -> None:
    assert (
        legacy_label(PLACE, ["at_goal", "success"], True, at_goal_first=True)
        == "placed_in_goal_success"
    )
    assert (
        legacy_label(PLACE, ["at_goal", "success"], True, at_goal_first=False)
        == "dropped_to_goal_success"
    )
    assert (
        legacy_label(PLACE, ["at_goal", "left_goal"], False, at_goal_first=True)
        == "place_in_goal_failure"
    )
    assert (
        legacy_label(PLACE, ["at_goal", "left_goal"], False, at_goal_first=False)
        == "drop_to_goal_failure"
    )


def test_published_events_count_from_nothing_at_the_first_action() -> None:
    held = history(is_grasped="1110", at_goal="0011", contact="1110", success="0001")
    assert legacy_history(PLACE, held) == ["placed_in_goal_success"], (
        "grasped counts although it was held before"
    )
    reset_only = history(contact="1000")
    assert legacy_history(PICK, reset_only) == ["mobility_failure"], (
        "the reset itself is not looked at"
    )
    flicker = history(contact="0101111", is_grasped="0000111", success="0000001")
    assert legacy_history(PICK, flicker) == ["straightforward_success"], (
        "repeats are dropped"
    )
    regrasp = history(contact="0110111", is_grasped="0010000", success="0000000")
    assert legacy_history(PICK, regrasp) == ["drop_failure"]


@pytest.mark.parametrize("kind", list(SubtaskKind))
def test_tracker_agrees_with_recorded_histories(kind: SubtaskKind) -> None:
    record = random_history(np.random.default_rng(2), kind, 12, 60)
    kinds = np.full(60, int(kind), dtype=np.int64)
    junk = random_history(np.random.default_rng(3), kind, 3, 60)
    tracker = SubtaskTracker(junk.row(0))
    tracker.step(kinds, junk.row(1), kinds)
    tracker.restart(np.ones(60, dtype=bool), record.row(0))
    live = np.ones(60, dtype=bool)
    told: list[list[str]] = [[] for _ in range(60)]
    for t in range(1, 12):
        for w, names in enumerate(
            tracker.step(kinds, record.row(t), np.full(60, t), live)
        ):
            told[w] += names
    frozen = tracker.step(kinds, junk.row(2), np.full(60, 99), ~live)
    assert frozen == [[]] * 60
    assert tracker.labels(kinds) == label_names(kinds, label_history(kinds, record))
    assert [tracker.legacy_label(w, kind) for w in range(60)] == legacy_history(
        kind, record
    )
    assert [[name for _, name in tracker.events(w)] for w in range(60)] == told
    assert all(1 <= step <= 11 for w in range(60) for step, _ in tracker.events(w))


def test_tracker_restarts_only_the_worlds_asked_for() -> None:
    record = random_history(np.random.default_rng(4), PICK, 6, 2)
    kinds = np.zeros(2, dtype=np.int64)
    tracker = SubtaskTracker(record.row(0))
    whole = SubtaskTracker(record.row(0))
    for t in range(1, 6):
        for each in (tracker, whole):
            each.step(kinds, record.row(t), np.full(2, t))
        if t == 3:
            tracker.restart(np.array([True, False]), record.row(3))
    assert (
        tracker.events(1) == whole.events(1)
        and tracker.labels(kinds)[1] == whole.labels(kinds)[1]
    )
    assert all(step > 3 for step, _ in tracker.events(0))


DIFFERENT: dict[str, tuple[int, dict[str, Any], str, str]] = {
    "grasped again at the goal": (
        PLACE,
        {"is_grasped": "1110100", "at_goal": "0111111", "success": "0000001"},
        "winding_success",
        "placed_in_goal_success",
    ),
    "let go twice outside": (
        PLACE,
        {"is_grasped": "1101000", "at_goal": "0000011", "success": "0000001"},
        "winding_success",
        "dropped_to_goal_success",
    ),
    "pushed through the goal": (
        PLACE,
        {"at_goal": "0010"},
        "drop_to_goal_failure",
        "didnt_grasp_failure",
    ),
    "grasped again after success": (
        PICK,
        {
            "is_grasped": "0011011",
            "contact": "0111011",
            "ee_contact": "0111011",
            "success": "0001000",
        },
        "success_then_drop",
        "winding_success",
    ),
    "touched by the palm": (
        PICK,
        {"ee_contact": "0110"},
        "mobility_failure",
        "cant_grasp_failure",
    ),
    "handle touched by the palm, open": (
        OPEN,
        {"ee_contact": "0110"},
        "cant_reach_articulation_failure",
        "cant_open_failure",
    ),
    "handle touched by the palm, close": (
        CLOSE,
        {"ee_contact": "0110"},
        "cant_reach_articulation_failure",
        "cant_close_failure",
    ),
    "open, then half": (
        OPEN,
        {
            "contact": "01111",
            "ee_contact": "01111",
            "slightly_opened": "00111",
            "opened": "00110",
            "success": "00010",
        },
        "open_success",
        "dubious_success",
    ),
    "closed, then half": (
        CLOSE,
        {
            "contact": "01111",
            "ee_contact": "01111",
            "slightly_closed": "00111",
            "closed": "00110",
            "success": "00010",
        },
        "closed_success",
        "dubious_success",
    ),
    "open for a moment": (
        OPEN,
        {
            "contact": "01111",
            "ee_contact": "01111",
            "slightly_opened": "00111",
            "opened": "00110",
        },
        "slightly_open_failure",
        "closed_after_open_failure",
    ),
    "moved and back": (
        CLOSE,
        {"contact": "0111", "ee_contact": "0111", "slightly_closed": "0110"},
        "open_after_closing_failure",
        "slightly_closed_failure",
    ),
    "lost on the way": (
        NAVIGATE,
        {
            "is_grasped": "1101111",
            "near": "0000111",
            "success": "0000011",
            "must_hold": True,
        },
        "success_then_dropped",
        "navigation_success",
    ),
}
"""Histories that the two sets of rules label differently: the table of docs/data/select.md."""


@pytest.mark.parametrize("name", DIFFERENT)
def test_where_published_and_own_labels_differ(name: str) -> None:
    kind, rows, legacy, own = DIFFERENT[name]
    record = history(**rows)
    kinds = np.array([int(kind)])
    assert legacy_history(kind, record) == [legacy]
    assert label_names(kinds, label_history(kinds, record)) == [own]
