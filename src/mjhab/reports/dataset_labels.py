"""The tables of labels: those of the data set next to those published in the MS-HAB paper."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from mjhab.core.names import kind_of
from mjhab.reports.metrics import wilson
from mjhab.reports.paper import POLICIES, paper_row
from mjhab.rollout.records import EpisodeRecord, SubtaskRecord
from mjhab.tasks.subtasks.registry import SUBTASKS

ALL = "all"
CHAINS = "in chains"
PAPER_EPISODES = 1008
"""Episodes per policy, task, split and target (MS-HAB paper App. A.6)."""


@dataclass(frozen=True)
class Group:
    """Subtasks of one kind, task, split and target. suite: "" for single subtasks, as in the paper, or CHAINS."""

    kind: str
    task: str
    split: str
    suite: str
    target: str


def grouped(records: Iterable[EpisodeRecord]) -> dict[Group, list[SubtaskRecord]]:
    """Finished subtasks by group, with an additional group ALL if there are several targets."""
    groups: dict[Group, list[SubtaskRecord]] = defaultdict(list)
    for record in records:
        for subtask in record.subtasks:
            suite = "" if record.subtask else CHAINS
            groups[
                Group(
                    subtask.kind,
                    record.task,
                    record.split,
                    suite,
                    kind_of(subtask.target),
                )
            ].append(subtask)
    together: dict[Group, list[SubtaskRecord]] = defaultdict(list)
    several: Counter[Group] = Counter()
    for group, members in groups.items():
        whole = Group(group.kind, group.task, group.split, group.suite, ALL)
        together[whole] += members
        several[whole] += 1
    found = {
        **groups,
        **{group: members for group, members in together.items() if several[group] > 1},
    }
    return {group: found[group] for group in sorted(found, key=_place)}


def _place(group: Group) -> tuple[str | bool, ...]:
    """Sort key of a group; ALL comes after the targets that it sums up."""
    return (
        group.kind,
        group.task,
        group.split,
        group.suite,
        group.target == ALL,
        group.target,
    )


def label_order(kind: str) -> tuple[str, ...]:
    """Labels of a kind in the order of the paper's tables; without one (Navigate), successes before failures."""
    spec = SUBTASKS[kind]
    columns = spec.published.columns if spec.published else ()
    return columns or tuple(
        sorted(
            spec.labels, key=lambda name: (name.endswith("_failure"), "_then_" in name)
        )
    )


@dataclass(frozen=True)
class LabelColumn:
    """One column of a table of labels: rates in percent, ``shares`` of labels, too; ``meanings``: sources of shares."""

    name: str
    episodes: int
    success_once: float
    success_at_end: float
    shares: Mapping[str, float]
    meanings: Mapping[str, str]

    @property
    def interval(self) -> str:
        """Wilson 95 % interval of success once, in percent."""
        # The paper prints rates, from which its counts follow.
        low, high = wilson(round(self.success_once / 100 * self.episodes), self.episodes)
        return f"{100 * low:.0f} to {100 * high:.0f}"


@dataclass(frozen=True)
class LabelTable:
    """The labels of a group: a row per label of ``labels``.

    Columns: this data set by the published rules (``legacy_label``) and by mjhab's rules (``label``), then the paper's
    policies on the same task, split and target by the published rules.
    """

    group: Group
    columns: Sequence[LabelColumn]
    labels: Sequence[str]


def label_tables(
    kind: str, groups: Mapping[Group, Sequence[SubtaskRecord]]
) -> list[LabelTable]:
    """One table per group of a kind.

    Labels that the kind does not have here, as of data of another version, have the last rows.
    """
    known = label_order(kind)
    found = {
        label
        for members in groups.values()
        for member in members
        for label in (member.legacy_label, member.label)
        if label
    }
    labels = (*known, *sorted(found - set(known)))
    return [
        LabelTable(group, _columns(group, members), labels)
        for group, members in groups.items()
    ]


def _columns(group: Group, members: Sequence[SubtaskRecord]) -> list[LabelColumn]:
    columns = [
        _ours("mjhab, published rules", members, "legacy_label"),
        _ours("mjhab, own rules", members, "label"),
    ]
    # The paper labels single subtasks alone; beside chains its numbers would mislead.
    for policy in POLICIES if not group.suite else ():
        row = paper_row(group.task, group.kind, group.split, group.target, policy)
        if row is not None:
            meanings = dict.fromkeys(row.labels, f"Table {row.table}")
            column = LabelColumn(
                f"paper {policy}",
                PAPER_EPISODES,
                row.success_once,
                row.success_at_end,
                row.labels,
                meanings,
            )
            columns.append(column)
    return columns


def _ours(name: str, members: Sequence[SubtaskRecord], which: str) -> LabelColumn:
    count = len(members)
    counts = Counter(getattr(member, which) for member in members)
    return LabelColumn(
        name,
        count,
        100 * sum(member.success_once for member in members) / count,
        100 * sum(member.success_at_end for member in members) / count,
        {label: 100 * number / count for label, number in counts.items()},
        {label: f"{number} of {count}" for label, number in counts.items()},
    )
