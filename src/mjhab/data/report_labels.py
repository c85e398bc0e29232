"""The table of labels: what was recorded next to what the MS-HAB paper published."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

from mjhab.data.facts import type_name
from mjhab.data.paper import ORDER, POLICIES, paper_row
from mjhab.rollout.metrics import wilson
from mjhab.rollout.records import EpisodeRecord, SubtaskRecord
from mjhab.rollout.report_plots import tone
from mjhab.tasks.labels import LABELS
from mjhab.tasks.plan import KIND_NAMES, SubtaskKind

_SHORT = {
    "success_then_excessive_collisions": "then collisions",
    "success_then_drop": "then dropped",
    "success_then_dropped": "then dropped",
    "excessive_collision": "collisions",
    "cant_reach_articulation": "cant reach",
    "navigation_success": "navigated",
    "navigation_failure": "not navigated",
}
"""Long labels in a head; the cells have them in full."""
ALL = "all"
CHAINS = "in chains"


@dataclass(frozen=True)
class Group:
    """Subtasks of one kind, task, split and target; ``way``: "" done alone, as in the paper, or CHAINS."""

    kind: str
    task: str
    split: str
    way: str
    target: str


def grouped(records: Iterable[EpisodeRecord]) -> dict[Group, list[SubtaskRecord]]:
    """Subtasks that ended by group, with a group of ALL targets where there are several."""
    groups: dict[Group, list[SubtaskRecord]] = defaultdict(list)
    for record in records:
        for subtask in record.subtasks:
            way = "" if record.subtask else CHAINS
            groups[Group(subtask.kind, record.task, record.split, way, type_name(subtask.target))].append(subtask)
    together: dict[Group, list[SubtaskRecord]] = defaultdict(list)
    several: Counter[Group] = Counter()
    for group, members in groups.items():
        whole = Group(group.kind, group.task, group.split, group.way, ALL)
        together[whole] += members
        several[whole] += 1
    found = {**groups, **{group: members for group, members in together.items() if several[group] > 1}}
    return {group: found[group] for group in sorted(found, key=_place)}


def _place(group: Group) -> tuple[str | bool, ...]:
    """Where a group stands: ALL after the targets it sums up."""
    return group.kind, group.task, group.split, group.way, group.target == ALL, group.target


def label_order(kind: str) -> tuple[str, ...]:
    """Labels of a kind in the order of the paper's tables; where it has none (Navigate), successes before failures."""
    names = LABELS[SubtaskKind(KIND_NAMES.index(kind))]
    return ORDER.get(kind) or tuple(sorted(names, key=lambda name: (name.endswith("_failure"), "_then_" in name)))


def label_table(kind: str, groups: Mapping[Group, Sequence[SubtaskRecord]]) -> str:
    """The table of a kind as HTML: ours in bold, the paper's rows for the same task, split and target below."""
    labels = label_order(kind)
    heads = "".join(f'<th class="n">{escape(name)}</th>' for name in ("n", "once", "at end"))
    # Turned by writing-mode, so that twelve columns fit on a page.
    turned = "writing-mode:vertical-rl;transform:rotate(180deg);padding:10px 4px 4px;text-align:left;white-space:nowrap"
    heads += "".join(f'<th style="{turned}">{escape(_short(name))}</th>' for name in labels)
    body = []
    for group, members in groups.items():
        body.append(_our_row(group, members, labels))
        if not group.way:
            body += _paper_rows(group, labels)
    head = f'<tr style="vertical-align:bottom"><th>task, split</th><th>target</th><th>policy</th>{heads}</tr>'
    return f'<div class="scroll"><table><thead>{head}</thead><tbody>{"".join(body)}</tbody></table></div>'


def _short(label: str) -> str:
    short = label.removesuffix("_failure").removesuffix("_success")
    return (_SHORT.get(label) or _SHORT.get(short, short)).replace("_", " ")


def _our_row(group: Group, members: Sequence[SubtaskRecord], labels: Sequence[str]) -> str:
    count = len(members)
    counts = Counter(member.label for member in members)
    once, end = (sum(getattr(m, name) for m in members) for name in ("success_once", "success_at_end"))
    low, high = wilson(once, count)
    way = f" {group.way}" if group.way else ""
    cells = f"<td>{escape(_task(group))}{way}</td><td>{escape(group.target)}</td><td>mjhab</td>"
    cells += f'<td class="n">{count}</td>'
    cells += f'<td class="n" title="95 %: {100 * low:.0f} to {100 * high:.0f}">{100 * once / count:.1f}</td>'
    cells += f'<td class="n">{100 * end / count:.1f}</td>'
    cells += "".join(_share(name, 100 * counts[name] / count, f"{counts[name]} of {count}") for name in labels)
    return f'<tr style="font-weight:600">{cells}</tr>'


def _paper_rows(group: Group, labels: Sequence[str]) -> list[str]:
    rows = []
    for policy in POLICIES:
        row = paper_row(group.task, group.kind, group.split, group.target, policy)
        if row is None:
            continue
        cells = f'<td></td><td></td><td style="color:var(--soft)">paper {escape(policy)}</td><td></td>'
        cells += f'<td class="n">{row.success_once:.1f}</td><td class="n">{row.success_at_end:.1f}</td>'
        cells += "".join(_share(name, row.labels[name], f"Table {row.table}") for name in labels)
        rows.append(f"<tr>{cells}</tr>")
    return rows


def _share(label: str, percent: float, title: str) -> str:
    """A cell in the colour of its label, the deeper the larger the share."""
    shade = f"background:color-mix(in srgb,var(--{tone(label)}) {min(70.0, 0.7 * percent):.0f}%,transparent)"
    text = f"{percent:.1f}" if percent else "·"
    return f'<td class="n" style="{shade};padding:7px 6px" title="{escape(label)}: {escape(title)}">{text}</td>'


def _task(group: Group) -> str:
    return f"{group.task.replace('_', ' ')}, {group.split}"
