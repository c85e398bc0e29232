"""Outcome labels of subtasks: exactly one label per subtask, from boolean signals.

The published labels (MS-HAB paper App. A.6) are rules on event lists, which overlap and leave gaps. Here each kind has
a decision list (`SubtaskSpec.label_rules`) over the signals of the steps t = 0 (start state) to T. The first rule that
holds gives the label, and the last one always holds, so that every history has exactly one label.

"Reached" and "touched" in labels refer to the end effector (fingers and hand), as ``F_ee,a`` of the paper: contact of
another link, such as the elbow, does not count.
"""

from __future__ import annotations

from mjhab.core.arrays import Array, namespace, to_numpy
from mjhab.tasks.label_state import History, LabelState, fold
from mjhab.tasks.subtasks.registry import SUBTASKS, check_kinds, spec_of


def label(state: LabelState, kind: Array) -> Array:
    """Return the label of every world as (W,) int64 codes: index into the ``labels`` of its kind's `SubtaskSpec`.

    Args:
        state: the steps seen so far.
        kind: (W,) int64 kinds of the subtasks; -1 gives code -1.

    Raises:
        UsageError: a kind that is not registered (numpy only, because asking a device would stall it).
    """
    check_kinds(kind)
    xp = namespace(kind)
    codes = xp.zeros_like(kind) - 1
    for number, spec in enumerate(SUBTASKS.values()):
        # The last one has no condition: it is what is left.
        *rules, _ = spec.label_rules
        code = xp.zeros_like(kind) + len(rules)
        # Backwards, so that an earlier rule overwrites a later one: the first that holds decides.
        for value in range(len(rules) - 1, -1, -1):
            code = xp.where(rules[value].holds(state), value, code)
        # For all kinds and worlds: selecting rows on a device would wait for it.
        codes = xp.where(kind == number, code, codes)
    return codes


def label_names(kind: Array, codes: Array) -> list[str]:
    """Return the labels behind the codes (W,), an empty string for -1."""
    pairs = zip(to_numpy(kind).tolist(), to_numpy(codes).tolist(), strict=True)
    return ["" if code < 0 else spec_of(k).labels[code] for k, code in pairs]


def label_history(kind: Array, history: History, valid: Array | None = None) -> Array:
    """Label a recorded history: (W,) int64 codes, the same as those of the running state.

    Args:
        kind: (W,) int64 kinds of the subtasks.
        history: (T+1, W) signals.
        valid: (T+1, W) bool, see `label_state.fold`.
    """
    return label(fold(history, valid), kind)
