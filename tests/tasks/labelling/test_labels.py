"""Labels: one per history, all reachable, the rules as written, running and folded alike, numpy and torch alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mjhab.tasks.label_state import (
    WATCHED,
    History,
    fold,
    get_row,
    restart,
    set_row,
    start,
    update,
)
from mjhab.tasks.labelling.labels import label, label_history, label_names
from mjhab.tasks.plan import SubtaskKind
from mjhab.tasks.subtasks.registry import spec_of
from tests.tasks.build import (
    HISTORY_FIELDS,
    assert_same,
    assert_same_record,
    history,
    random_history,
    to_torch,
)

KINDS = list(SubtaskKind)


def labels_of(kind: int, record: History) -> list[str]:
    kinds = np.full(record.success.shape[1], int(kind), dtype=np.int64)
    return label_names(kinds, label_history(kinds, record))


@st.composite
def any_history(draw: st.DrawFn) -> History:
    """Arbitrary signals of one world, physically possible or not."""
    steps = draw(st.integers(1, 8))
    bits = draw(arrays(bool, (len(HISTORY_FIELDS), steps, 1)))
    return History(**dict(zip(HISTORY_FIELDS, bits, strict=True)))


def expected_label(kind: int, h: History) -> str:
    """The decision lists once more, read off naively, for one world."""
    g, a, s = (getattr(h, n)[:, 0].tolist() for n in ("is_grasped", "at_goal", "success"))
    excess = not h.force_ok.all()
    touched = h.ee_contact.any()
    releases = [t for t in range(1, len(g)) if g[t - 1] and not g[t]]
    exits = [t for t in range(1, len(a)) if a[t - 1] and not a[t]]
    if any(s) and excess:
        return "success_then_excessive_collisions"
    if excess:
        return "excessive_collision_failure"
    if kind == SubtaskKind.PICK:
        if any(s):
            return (
                "success_then_drop"
                if not g[-1]
                else "winding_success"
                if releases
                else "straightforward_success"
            )
        if not any(g):
            return "cant_grasp_failure" if touched else "mobility_failure"
        return "too_slow_failure" if g[-1] else "drop_failure"
    if kind == SubtaskKind.PLACE:
        if any(s):
            if not a[-1]:
                return "dubious_success"
            before = [t for t in releases if t <= s.index(True)]
            dropped = not a[before[-1]] if before else not a[0]
            return (
                "winding_success"
                if exits
                else "dropped_to_goal_success"
                if dropped
                else "placed_in_goal_success"
            )
        if not any(g):
            return "didnt_grasp_failure"
        if not any(a):
            return "didnt_reach_goal_failure"
        if g[-1] or a[-1]:
            return "wont_let_go_failure" if g[-1] else "too_slow_failure"
        return "place_in_goal_failure" if a[releases[-1]] else "drop_to_goal_failure"
    if kind == SubtaskKind.NAVIGATE:
        lost = h.must_hold[0, 0] and not g[-1]
        if any(s):
            return "success_then_dropped" if lost else "navigation_success"
        return "dropped_failure" if lost else "navigation_failure"
    return expected_joint_label(kind, h)


def expected_joint_label(kind: int, h: History) -> str:
    """Open and Close without excessive force."""
    opening = kind == SubtaskKind.OPEN
    there = (h.opened if opening else h.closed)[:, 0].tolist()
    if h.success.any():
        return (
            "dubious_success"
            if not there[-1]
            else "open_success"
            if opening
            else "closed_success"
        )
    if not h.ee_contact.any():
        return "cant_reach_articulation_failure"
    if any(there):
        back = "closed_after_open_failure" if opening else "open_after_closing_failure"
        return "too_slow_failure" if there[-1] else back
    if opening:
        return "slightly_open_failure" if h.slightly_opened.any() else "cant_open_failure"
    return "slightly_closed_failure" if h.slightly_closed.any() else "cant_close_failure"


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=250, deadline=None)
@given(data=st.data())
def test_every_history_has_exactly_the_label_of_the_rules(
    kind: SubtaskKind, data: st.DataObject
) -> None:
    record = data.draw(any_history())
    names = labels_of(kind, record)
    assert len(names) == 1 and names[0] in spec_of(kind).labels
    assert names[0] == expected_label(kind, record)


@pytest.mark.parametrize("kind", KINDS)
def test_every_label_occurs_in_possible_histories(kind: SubtaskKind) -> None:
    rng = np.random.default_rng(7)
    seen = {
        name
        for steps in (2, 4, 8)
        for name in labels_of(kind, random_history(rng, kind, steps, 10_000))
    }
    assert seen == set(spec_of(kind).labels)


EXAMPLES: dict[tuple[int, str], History] = {
    (0, "success_then_excessive_collisions"): history(
        is_grasped="0111", success="0010", force_ok="1110"
    ),
    (0, "success_then_drop"): history(is_grasped="0110", success="0010"),
    (0, "winding_success"): history(is_grasped="01011", success="00001"),
    (0, "straightforward_success"): history(
        is_grasped="0011", ee_contact="0111", success="0001"
    ),
    (0, "excessive_collision_failure"): history(is_grasped="0111", force_ok="1110"),
    (0, "mobility_failure"): history(steps=4),
    (0, "cant_grasp_failure"): history(ee_contact="0100"),
    (0, "drop_failure"): history(is_grasped="0110"),
    (0, "too_slow_failure"): history(is_grasped="0101"),
    (1, "success_then_excessive_collisions"): history(
        at_goal="0111", success="0010", force_ok="1110"
    ),
    (1, "dubious_success"): history(is_grasped="1000", at_goal="0110", success="0010"),
    (1, "winding_success"): history(
        is_grasped="111100", at_goal="010111", success="000001"
    ),
    (1, "dropped_to_goal_success"): history(
        is_grasped="1100", at_goal="0001", success="0001"
    ),
    (1, "placed_in_goal_success"): history(
        is_grasped="1100", at_goal="0111", success="0001"
    ),
    (1, "excessive_collision_failure"): history(
        is_grasped="1100", at_goal="0011", force_ok="1110"
    ),
    (1, "didnt_grasp_failure"): history(at_goal="0011"),
    (1, "didnt_reach_goal_failure"): history(is_grasped="1100"),
    (1, "wont_let_go_failure"): history(is_grasped="1111", at_goal="0011"),
    (1, "too_slow_failure"): history(is_grasped="1100", at_goal="0011"),
    (1, "place_in_goal_failure"): history(is_grasped="1100", at_goal="0110"),
    (1, "drop_to_goal_failure"): history(is_grasped="1110", at_goal="0100"),
    (2, "success_then_excessive_collisions"): history(success="0100", force_ok="1100"),
    (2, "success_then_dropped"): history(
        success="0100", is_grasped="1110", must_hold=True
    ),
    (2, "navigation_success"): history(success="0100", is_grasped="1110"),
    (2, "excessive_collision_failure"): history(force_ok="1110"),
    (2, "dropped_failure"): history(is_grasped="1100", must_hold=True),
    (2, "navigation_failure"): history(is_grasped="1111", must_hold=True),
    (3, "success_then_excessive_collisions"): history(
        opened="0111", success="0010", force_ok="1110"
    ),
    (3, "dubious_success"): history(opened="0110", success="0010"),
    (3, "open_success"): history(opened="0111", success="0001"),
    (3, "excessive_collision_failure"): history(opened="0111", force_ok="1110"),
    (3, "cant_reach_articulation_failure"): history(steps=4),
    (3, "closed_after_open_failure"): history(ee_contact="0111", opened="0110"),
    (3, "too_slow_failure"): history(ee_contact="0111", opened="0101"),
    (3, "slightly_open_failure"): history(ee_contact="0111", slightly_opened="0010"),
    (3, "cant_open_failure"): history(ee_contact="0111"),
    (4, "success_then_excessive_collisions"): history(
        closed="0111", success="0010", force_ok="1110"
    ),
    (4, "dubious_success"): history(closed="0110", success="0010"),
    (4, "closed_success"): history(closed="0111", success="0001"),
    (4, "excessive_collision_failure"): history(closed="0111", force_ok="1110"),
    (4, "cant_reach_articulation_failure"): history(steps=4),
    (4, "open_after_closing_failure"): history(ee_contact="0111", closed="0110"),
    (4, "too_slow_failure"): history(ee_contact="0111", closed="0101"),
    (4, "slightly_closed_failure"): history(ee_contact="0111", slightly_closed="0010"),
    (4, "cant_close_failure"): history(ee_contact="0111"),
}


def test_there_is_an_example_of_every_label() -> None:
    assert set(EXAMPLES) == {
        (int(kind), name) for kind in KINDS for name in spec_of(kind).labels
    }


@pytest.mark.parametrize(("kind", "name"), EXAMPLES)
def test_example(kind: int, name: str) -> None:
    assert labels_of(kind, EXAMPLES[kind, name]) == [name]


def test_a_row_of_a_version_without_ee_contact_takes_it_from_touch() -> None:
    record = random_history(np.random.default_rng(3), SubtaskKind.PICK, 6, 40)
    state = fold(replace(record, ee_contact=record.touch))
    row = WATCHED.index("ee_contact")
    for w in range(40):
        whole = get_row(state, w)
        old = {
            **whole,
            "now": np.delete(whole["now"], row),
            "seen": np.delete(whole["seen"], row),
        }
        again = get_row(set_row(state, 0, old), 0)
        for name, values in whole.items():
            np.testing.assert_array_equal(again[name], values, err_msg=name)


@pytest.mark.parametrize("kind", KINDS)
def test_running_state_with_restarts_equals_the_fold_of_each_part(
    kind: SubtaskKind,
) -> None:
    record = random_history(np.random.default_rng(5), kind, 20, 500)
    kinds = np.full(500, int(kind), dtype=np.int64)
    cut = np.random.default_rng(6).integers(1, 19, 500)
    state = start(record.row(0))
    ended = np.full(500, -2)
    for t in range(1, 20):
        # At its cut a world's subtask ends; the same step is the start of its next one.
        state = update(state, record.row(t))
        mask = cut == t
        ended = np.where(mask, label(state, kinds), ended)
        state = restart(state, mask, record.row(t))
    steps = np.arange(20)[:, None]
    np.testing.assert_array_equal(ended, label_history(kinds, record, steps <= cut))
    for w in range(0, 500, 25):
        rest = History(
            **{n: getattr(record, n)[cut[w] :, w : w + 1] for n in HISTORY_FIELDS}
        )
        assert label_history(kinds[:1], rest)[0] == label(state, kinds)[w]


@pytest.mark.parametrize("kind", KINDS)
def test_torch_labels_the_same_in_value_and_dtype(kind: SubtaskKind) -> None:
    record = random_history(np.random.default_rng(8), kind, 10, 300)
    kinds = np.full(300, int(kind), dtype=np.int64)
    kinds[::7] = -1
    other = to_torch(record)
    torch_kinds = to_torch(History(**dict.fromkeys(HISTORY_FIELDS, kinds))).success
    assert_same_record(fold(record), fold(other))
    assert_same(label_history(kinds, record), label_history(torch_kinds, other))
    assert label_names(torch_kinds, label_history(torch_kinds, other))[0] == ""


def test_stacking_rows_gives_the_history_back() -> None:
    record = random_history(np.random.default_rng(9), 1, 5, 3)
    again = History.stack([record.row(t) for t in range(5)])
    for name in HISTORY_FIELDS:
        np.testing.assert_array_equal(getattr(again, name), getattr(record, name))
