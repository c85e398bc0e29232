"""Metrics of a set of episode records."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from mjhab.core.names import kind_of
from mjhab.rollout.records import EpisodeRecord, SubtaskRecord, skip_counts
from mjhab.tasks.progressive import progressive, upper_bound

Z95 = 1.959964
"""Two-sided 95 % quantile of the normal distribution."""


@dataclass(frozen=True)
class SubtaskRow:
    """Success of one group of subtasks: those at one position of the plan, or those of one kind and target.

    ``position`` in the plan counts from 0 and is None for a group over positions. ``reached`` counts the subtasks that
    ended, ``successes`` those that succeeded. Rates are over ``reached``, in 0..1, and ``interval`` is the Wilson 95 %
    interval of ``success_once``. ``steps_to_success`` is the median over the successes (None without any), in control
    steps from the start of the subtask. ``peak_force`` and ``peak_finger_force`` [N] are medians over ``reached`` (None
    if nothing was, or if the records do not hold it); limits count the first alone. ``judged`` is False where the
    environment did every one by teleport, so that success says nothing about the policy.
    """

    position: int | None
    kind: str
    target: str
    reached: int
    successes: int
    success_once: float
    success_at_end: float
    interval: tuple[float, float]
    steps_to_success: float | None
    peak_force: float | None
    peak_finger_force: float | None
    judged: bool


def wilson(successes: int, total: int) -> tuple[float, float]:
    """Return the Wilson 95 % interval of a rate to 4 digits; (0, 1) if there is no trial."""
    if total == 0:
        return (0.0, 1.0)
    rate = successes / total
    shrink = 1.0 + Z95**2 / total
    centre = (rate + Z95**2 / (2 * total)) / shrink
    half = Z95 * math.sqrt(rate * (1 - rate) / total + Z95**2 / (4 * total**2)) / shrink
    return (round(max(0.0, centre - half), 4), round(min(1.0, centre + half), 4))


AloneRates = Mapping[tuple[str, str], float]
"""Success rate of subtasks evaluated alone, by kind and type of target; target "" is the rate of the whole kind."""


def alone_rates(records: Iterable[EpisodeRecord]) -> dict[tuple[str, str], float]:
    """Return the success-once rates of episodes of a single subtask."""
    outcomes: dict[tuple[str, str], list[bool]] = {}
    for record in records:
        if record.subtask is not None:
            for subtask in record.subtasks:
                for target in ("", kind_of(subtask.target)):
                    outcomes.setdefault((subtask.kind, target), []).append(
                        subtask.success_once
                    )
    return {key: float(np.mean(values)) for key, values in outcomes.items()}


def progress_curves(
    records: Sequence[EpisodeRecord], alone: AloneRates | None = None
) -> tuple[list[float], list[float | None]]:
    """Return progressive completion and its independent upper bound, each with one value per position of the plan.

    The bound is the running product of the subtasks' success rates. If ``alone`` has a rate for the kind (preferably
    for the target), it is the rate from a spawned start; else it is the rate in this run among the episodes that
    reached the subtask. Without any ``alone`` rate the bound equals the curve. It is None from the first subtask on
    whose rate is unknown, since no episode ended it (the policy failed before, for instance).
    """
    rows = rows_by_position(records)
    if not rows:
        return [], []
    known = alone or {}
    rates = []
    for row in rows:
        in_chain = row.successes / row.reached if row.reached else math.nan
        rates.append(
            known.get((row.kind, row.target), known.get((row.kind, ""), in_chain))
        )
    curve = progressive([record.completed for record in records], len(rows))
    return [round(float(v), 4) for v in curve], [
        None if math.isnan(v) else round(float(v), 4) for v in upper_bound(rates)
    ]


def summarize(
    records: Sequence[EpisodeRecord], seconds: float, alone: AloneRates | None = None
) -> dict[str, Any]:
    """Return the summary as JSON data; rates are fractions in 0..1, and 0 without episodes.

    Args:
        records: finished episodes of one run.
        seconds: wall time of the run [s].
        alone: rates for the upper bound, see ``progress_curves``.

    Returns:
        ``episodes``; ``success_once`` and ``success_at_end`` of whole episodes; ``progressive``: fraction of episodes
        that completed at least k+1 subtasks; ``upper_bound``: the same if every subtask started well, None where
        nothing is known of it; ``labels``: count of every trajectory label; ``legacy_labels``: likewise by the rules of
        the published code; ``tainted``: number of episodes whose simulation raised a flag (they are counted in all
        rates); ``errors``: number of episodes that the policy could not finish, likewise counted;
        ``skipped_homes``: how often each home that had no room was skipped, empty without any; ``subtasks``:
        the fields of `SubtaskRow` per position of the plan, of episodes of a single subtask per target;
        ``seconds``.
    """
    curve, bound = progress_curves(records, alone)
    subtasks = [subtask for record in records for subtask in record.subtasks]
    return {
        "episodes": len(records),
        "success_once": mean(record.success_once for record in records),
        "success_at_end": mean(record.success_at_end for record in records),
        "progressive": curve,
        "upper_bound": bound,
        "labels": label_counts(subtask.label for subtask in subtasks),
        "legacy_labels": label_counts(subtask.legacy_label for subtask in subtasks),
        "tainted": sum(bool(record.taint) for record in records),
        "errors": sum(bool(record.error) for record in records),
        "skipped_homes": skip_counts(record.skipped_homes for record in records),
        "subtasks": [asdict(row) for row in rows_of(records)],
        "seconds": round(seconds, 2),
    }


def label_counts(labels: Iterable[str | None]) -> dict[str, int]:
    """Count every label except None, the most frequent first."""
    counts = Counter(label for label in labels if label is not None)
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def mean(values: Iterable[float]) -> float:
    """Return the mean to 4 digits; 0 for no values."""
    values = list(values)
    return round(float(np.mean(values)), 4) if values else 0.0


def rows_of(records: Sequence[EpisodeRecord]) -> list[SubtaskRow]:
    """Return the rows that sum up a run: along the plan, or per target in episodes of a single subtask."""
    if all(record.subtask for record in records):
        return rows_by_kind(records)
    return rows_by_position(records)


def rows_by_position(records: Sequence[EpisodeRecord]) -> list[SubtaskRow]:
    """Return one row per position of the plan, also for positions that no episode reached."""
    rows = []
    for position in range(max((len(record.plan) for record in records), default=0)):
        entries = [
            record.plan[position] for record in records if position < len(record.plan)
        ]
        ended = [
            subtask
            for record in records
            for subtask in record.subtasks
            if subtask.index == position
        ]
        kinds = sorted({entry.kind for entry in entries})
        targets = sorted({kind_of(entry.target) for entry in entries})
        shown = targets[0] if len(targets) == 1 else f"{len(targets)} targets"
        rows.append(_row(position, " / ".join(kinds), shown, ended))
    return rows


def rows_by_kind(records: Sequence[EpisodeRecord]) -> list[SubtaskRow]:
    """Return one row per kind and type of target that ended at least once."""
    groups: dict[tuple[str, str], list[SubtaskRecord]] = {}
    for record in records:
        for subtask in record.subtasks:
            groups.setdefault((subtask.kind, kind_of(subtask.target)), []).append(subtask)
    return [
        _row(None, kind, target, groups[kind, target]) for kind, target in sorted(groups)
    ]


def _row(
    position: int | None, kind: str, target: str, ended: Sequence[SubtaskRecord]
) -> SubtaskRow:
    once = sum(subtask.success_once for subtask in ended)
    return SubtaskRow(
        position=position,
        kind=kind,
        target=target,
        reached=len(ended),
        successes=once,
        success_once=mean(subtask.success_once for subtask in ended),
        success_at_end=mean(subtask.success_at_end for subtask in ended),
        interval=wilson(once, len(ended)),
        steps_to_success=_median(
            # The environment did these at once; their time says nothing about the policy.
            subtask.steps_to_success
            for subtask in ended
            if not subtask.teleported
        ),
        peak_force=_median(subtask.peak_force for subtask in ended),
        peak_finger_force=_median(subtask.peak_finger_force for subtask in ended),
        judged=not ended or not all(subtask.teleported for subtask in ended),
    )


def _median(values: Iterable[float | None]) -> float | None:
    """Median of the values that there are and that are finite, to a tenth; None without any."""
    found = [value for value in values if value is not None and math.isfinite(value)]
    return round(float(np.median(found)), 1) if found else None


def labels_by_kind(records: Sequence[EpisodeRecord]) -> dict[str, Counter[str]]:
    """Return the count of every label per kind of subtask."""
    counts: dict[str, Counter[str]] = {}
    for record in records:
        for subtask in record.subtasks:
            if subtask.label is not None:
                counts.setdefault(subtask.kind, Counter())[subtask.label] += 1
    return counts
