"""The table of labels: those of the data set next to those published in the MS-HAB paper."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

from mjhab.core.names import kind_of
from mjhab.reports.metrics import wilson
from mjhab.reports.paper import POLICIES, paper_row
from mjhab.reports.plots import tone
from mjhab.rollout.records import EpisodeRecord, SubtaskRecord
from mjhab.tasks.subtasks.registry import SUBTASKS

ALL = "all"
CHAINS = "in chains"
PAPER_EPISODES = 1008
"""Episodes per policy, task, split and target (MS-HAB paper App. A.6)."""


@dataclass(frozen=True)
class Group:
    """Subtasks of one kind, task, split and target. way: "" for single subtasks, as in the paper, or CHAINS."""

    kind: str
    task: str
    split: str
    way: str
    target: str


def grouped(records: Iterable[EpisodeRecord]) -> dict[Group, list[SubtaskRecord]]:
    """Finished subtasks by group, with an additional group ALL if there are several targets."""
    groups: dict[Group, list[SubtaskRecord]] = defaultdict(list)
    for record in records:
        for subtask in record.subtasks:
            way = "" if record.subtask else CHAINS
            groups[
                Group(
                    subtask.kind, record.task, record.split, way, kind_of(subtask.target)
                )
            ].append(subtask)
    together: dict[Group, list[SubtaskRecord]] = defaultdict(list)
    several: Counter[Group] = Counter()
    for group, members in groups.items():
        whole = Group(group.kind, group.task, group.split, group.way, ALL)
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
        group.way,
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


def label_table(kind: str, groups: Mapping[Group, Sequence[SubtaskRecord]]) -> str:
    """The labels of a kind as HTML: one table per group, with a row per label.

    Labels that the kind does not have here, as of data of another version, have the last rows.

    Columns: this data set by the published rules (``legacy_label``) and by mjhab's rules (``label``), then the paper's
    policies on the same task, split and target by the published rules.
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
    tables = (
        _group_table(group, _columns(group, members), labels)
        for group, members in groups.items()
    )
    columns = "display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,560px),1fr));gap:18px 28px"
    return f'<div style="{columns}">{"".join(tables)}</div>'


@dataclass(frozen=True)
class _Column:
    """One column of a table of labels. shares: in percent by label. told: source of each share, by label."""

    name: str
    episodes: int
    success_once: float
    success_at_end: float
    shares: Mapping[str, float]
    told: Mapping[str, str]


def _columns(group: Group, members: Sequence[SubtaskRecord]) -> list[_Column]:
    columns = [
        _ours("mjhab, published rules", members, "legacy_label"),
        _ours("mjhab, own rules", members, "label"),
    ]
    for policy in POLICIES if not group.way else ():
        row = paper_row(group.task, group.kind, group.split, group.target, policy)
        if row is not None:
            told = dict.fromkeys(row.labels, f"Table {row.table}")
            column = _Column(
                f"paper {policy}",
                PAPER_EPISODES,
                row.success_once,
                row.success_at_end,
                row.labels,
                told,
            )
            columns.append(column)
    return columns


def _ours(name: str, members: Sequence[SubtaskRecord], which: str) -> _Column:
    count = len(members)
    counts = Counter(getattr(member, which) for member in members)
    return _Column(
        name,
        count,
        100 * sum(member.success_once for member in members) / count,
        100 * sum(member.success_at_end for member in members) / count,
        {label: 100 * number / count for label, number in counts.items()},
        {label: f"{number} of {count}" for label, number in counts.items()},
    )


def _group_table(group: Group, columns: Sequence[_Column], labels: Sequence[str]) -> str:
    way = f" {group.way}" if group.way else ""
    title = f"{group.task.replace('_', ' ')}, {group.split}{way}: <b>{escape(group.target)}</b>"
    heads = "".join(
        f'<th class="n" style="white-space:normal">{escape(column.name)}</th>'
        for column in columns
    )
    rows = [
        _row(
            "episodes", [f'<td class="n">{column.episodes:,}</td>' for column in columns]
        ),
        _row("success once", [_once(column) for column in columns]),
        _row(
            "success at end",
            [f'<td class="n">{column.success_at_end:.1f}</td>' for column in columns],
        ),
    ]
    rows += [
        _row(label.replace("_", " "), [_share(label, column) for column in columns])
        for label in labels
    ]
    head = f'<tr style="vertical-align:bottom"><th>{title}</th>{heads}</tr>'
    return f'<div class="scroll"><table><thead>{head}</thead><tbody>{"".join(rows)}</tbody></table></div>'


def _row(name: str, cells: Sequence[str]) -> str:
    return f"<tr><td>{escape(name)}</td>{''.join(cells)}</tr>"


def _once(column: _Column) -> str:
    low, high = wilson(
        round(column.success_once / 100 * column.episodes), column.episodes
    )
    title = f"95 %: {100 * low:.0f} to {100 * high:.0f}"
    return f'<td class="n" title="{title}">{column.success_once:.1f}</td>'


def _share(label: str, column: _Column) -> str:
    """A cell in the colour of its label; the colour is deeper for a larger share."""
    percent = column.shares.get(label, 0.0)
    shade = f"background:color-mix(in srgb,var(--{tone(label)}) {min(70.0, 0.7 * percent):.0f}%,transparent)"
    text = f"{percent:.1f}" if percent else "·"
    title = f"{column.name}, {label}: {column.told.get(label, 'none')}"
    return f'<td class="n" style="{shade}" title="{escape(title)}">{text}</td>'
