"""The page of ``mjhab bench experts``: tables and charts of the experts next to the policies of the paper."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from mjhab.bench.experts.rows import ALL, CHAIN, PAPER_POLICY, RowResult
from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.reports.metrics import wilson
from mjhab.reports.pages import render_page
from mjhab.reports.paper import beside_the_paper, rules_of
from mjhab.reports.plots import LABEL_COLORS, Figure, labels_figure
from mjhab.reports.words import interval, percent
from mjhab.scenes.spec import OWN_DYNAMICS
from mjhab.tasks.subtasks.registry import SUBTASKS

_COLORS = ("#0f8f80", "#3b82f6", "#f59e0b", "#8b5cf6", "#dc2626", "#64748b")
"""Of asset packs, or of tasks in them."""
_PAPER_COLOR = "#94a3b8"
_DASHES = {"teleport": "solid", "drive": "dash"}
_ROW_HEIGHT = 21
_MOST_FAILURES = 2
"""Labels of failures that a table names."""


def render_experts(
    results: Sequence[RowResult], groups: Sequence[RowResult], config: Mapping[str, Any]
) -> str:
    """The whole page, which needs no network.

    Args:
        results: every row. groups: rows over all targets, see `expert_rows.together`. config: what they have in common.
    """
    singles = [result for result in results if result.subtask != CHAIN]
    chains = [result for result in results if result.subtask == CHAIN]
    chain_packs = list(dict.fromkeys(chain.pack for chain in chains))
    plots = {
        f"chains-{pack}": _chain_figure([chain for chain in chains if chain.pack == pack])
        for pack in chain_packs
    }
    kinds = {}
    for kind in SUBTASKS:
        members = [result for result in singles if result.subtask == kind]
        if members:
            kinds[kind] = _kind(kind, members, plots)
    return render_page(
        "bench/experts/report.html",
        title="Experts",
        chips=_chips(results, config),
        left=sum(result.wanted - result.episodes for result in results),
        wanted=sum(result.wanted for result in results),
        numbers=_numbers(singles, chains),
        groups=groups,
        group_columns=_columns(groups),
        chains=chains,
        chain_columns=_CHAIN_COLUMNS,
        chain_packs=chain_packs,
        kinds=kinds,
        errors=[result for result in results if result.error],
        config=_flat(config),
        all_targets=ALL,
        paper_policy=PAPER_POLICY,
        beside_the_paper=beside_the_paper(rules_of(config)),
        label_colors=LABEL_COLORS,
        failures=_failures,
        plots=plots,
    )


def _chips(
    results: Sequence[RowResult], config: Mapping[str, Any]
) -> list[tuple[str, Any]]:
    packs = ", ".join(dict.fromkeys(r.pack for r in results))
    return [
        ("homes", f"{packs}, {config['split']}"),
        ("seed", config["seed"]),
        ("rules", rules_of(config)),
        ("starts", config["spawn_rule"]),
        ("joints of furniture", config.get("joint_dynamics", OWN_DYNAMICS)),
    ]


def _numbers(
    singles: Sequence[RowResult], chains: Sequence[RowResult]
) -> list[tuple[str, str, str]]:
    """The main numbers: name, value, and what is told more."""
    values = []
    if singles:
        count = sum(r.episodes for r in singles)
        once = sum(r.successes for r in singles)
        gentle = ordered_sum((r.gentle or 0.0) * r.episodes for r in singles)
        both = [r.over_paper for r in singles if r.over_paper is not None]
        better = sum(points > 0 for points in both)
        bounds = interval(*wilson(once, count), digits=1)
        values += [
            ("single subtasks", f"{count:,}", f"episodes in {len(singles)} rows"),
            ("success once", _share(once, count), bounds),
            ("under 1,400 N", _share(gentle, count), "forces up to success, summed"),
            (
                "above the paper",
                f"{better} / {len(both)}",
                f"rows, against {PAPER_POLICY}",
            ),
        ]
    if chains:
        count = sum(r.episodes for r in chains)
        once = sum(r.successes for r in chains)
        more = f"complete, of {count:,} episodes"
        values.append(("whole tasks", _share(once, count), more))
    asked = [r.met for r in (*singles, *chains) if r.met is not None]
    tainted = sum(r.tainted for r in (*singles, *chains))
    return [
        *values,
        ("as much as asked", f"{sum(asked)} / {len(asked)}", "rows, by their rates"),
        ("tainted episodes", f"{tainted}", "flagged by the simulation, counted"),
    ]


def _share(part: float, count: int) -> str:
    return percent(part / count) if count else "-"


def _kind(
    kind: str, members: Sequence[RowResult], plots: dict[str, Figure]
) -> dict[str, Any]:
    """What the section of a kind of subtask shows; its charts are added to ``plots``."""
    against_paper = any(result.paper is not None for result in members)
    if against_paper:
        plots[f"paper-{kind}"] = _paper_figure(members)
    counts = {
        f"{_short(result)}, {result.pack}": Counter(result.labels)
        for result in members
        if result.episodes
    }
    if counts:
        figure = labels_figure(counts, tuple(counts))
        height = 90 + _ROW_HEIGHT * len(counts)
        figure["layout"] |= {"height": height + 60, "bargap": 0.25}
        figure["layout"]["legend"] |= {"y": -50 / height}
        plots[f"labels-{kind}"] = figure
    return {
        "results": members,
        "columns": _columns(members),
        "against_paper": against_paper,
        "has_labels": bool(counts),
    }


_COLUMNS = (
    ("homes", ""),
    ("task", ""),
    ("subtask", ""),
    ("target", ""),
    ("n", "n"),
    ("once", "n"),
    ("95 %", ""),
    ("asked", "n"),
    ("paper", "n"),
    ("difference", "n"),
    ("< 1,400 N", "n"),
    ("tainted", "n"),
    ("failures", ""),
)
_CHAIN_COLUMNS = (
    ("homes", ""),
    ("task", ""),
    ("navigate", ""),
    ("n", "n"),
    ("complete", "n"),
    ("95 %", ""),
    ("asked", "n"),
    ("no peak of 1,400 N", "n"),
    ("tainted", "n"),
    ("failures", ""),
)
"""Columns of single subtasks and of whole tasks, with their classes: "n" for numbers."""


def _columns(results: Sequence[RowResult]) -> list[tuple[str, str]]:
    """Columns of single subtasks without those that tell nothing apart."""
    alike = {
        name
        for name in ("subtask", "target")
        if len({getattr(result, name) for result in results}) == 1
    }
    if all(result.asked is None for result in results):
        alike.add("asked")
    if all(result.paper is None for result in results):
        alike |= {"paper", "difference"}
    if not any(result.tainted for result in results):
        alike.add("tainted")
    return [column for column in _COLUMNS if column[0] not in alike]


def _failures(r: RowResult) -> str:
    """The most frequent failures of a row in words."""
    named = list(r.failures.items())[:_MOST_FAILURES]
    words = [
        f"{n} {name.removesuffix('_failure').replace('_', ' ')}" for name, n in named
    ]
    more = len(r.failures) - len(named)
    return ", ".join(words) + (f" and {more} more" if more > 0 else "")


def _short(r: RowResult) -> str:
    """Task and target in a few letters."""
    task = "".join(word[0] for word in r.task.split("_")).upper()
    return f"{task} {r.target.rpartition('/')[0] or r.target or ALL}"


def _pack_bars(results: Sequence[RowResult], pack: str, color: str) -> dict[str, Any]:
    """Bars of the success rates in the homes of one asset pack, with their intervals."""
    mine = [r for r in results if r.pack == pack and r.success_once is not None]
    rates = [r.success_once or 0.0 for r in mine]
    intervals = [r.interval for r in mine]
    return {
        "type": "bar",
        "name": f"expert, {pack} homes",
        "x": [_short(r) for r in mine],
        "y": rates,
        "marker": {"color": color},
        "error_y": {
            "type": "data",
            "symmetric": False,
            "array": [high - y for y, (_, high) in zip(rates, intervals, strict=True)],
            "arrayminus": [y - low for y, (low, _) in zip(rates, intervals, strict=True)],
            "thickness": 1.2,
            "width": 3,
        },
        "hovertemplate": "%{x}<br>%{y:.1%}<extra></extra>",
    }


def _paper_bars(results: Sequence[RowResult]) -> dict[str, Any]:
    """Bars of the success rates that the paper tells."""
    known = {_short(r): r.paper for r in results if r.paper is not None}
    return {
        "type": "bar",
        "name": f"paper, {PAPER_POLICY}",
        "x": list(known),
        "y": list(known.values()),
        "marker": {"color": _PAPER_COLOR},
        "hovertemplate": "%{x}<br>paper %{y:.1%}<extra></extra>",
    }


def _paper_figure(results: Sequence[RowResult]) -> Figure:
    """Bars: ours in every asset pack, then the paper's."""
    names = list(dict.fromkeys(_short(result) for result in results))
    packs = dict.fromkeys(result.pack for result in results)
    data = [
        _pack_bars(results, pack, color)
        # Colours over and over, as there may be more packs than colours.
        for pack, color in zip(packs, _COLORS * len(results), strict=False)
    ]
    return {
        "data": [*data, _paper_bars(results)],
        "layout": {
            "height": 440,
            "barmode": "group",
            "bargap": 0.25,
            "legend": {"orientation": "h", "y": 1.14},
            "yaxis": {"range": [0, 1.04], "tickformat": ".0%"},
            "xaxis": {
                "type": "category",
                "categoryorder": "array",
                "categoryarray": names,
                "tickangle": -40,
            },
        },
    }


def _chain_figure(chains: Sequence[RowResult]) -> Figure:
    """Progressive completion of every chain over the places of its plan."""
    tasks = dict.fromkeys(chain.task for chain in chains)
    colors = {task: _COLORS[i % len(_COLORS)] for i, task in enumerate(tasks)}
    data = []
    for chain in chains:
        name = f"{chain.task.replace('_', ' ')}, {chain.navigate}"
        line = {
            "color": colors[chain.task],
            "dash": _DASHES.get(chain.navigate, "dot"),
            "width": 2.5,
        }
        data.append(
            {
                "type": "scatter",
                "mode": "lines+markers",
                "name": name,
                "x": list(range(len(chain.progressive) + 1)),
                "y": [1.0, *chain.progressive],
                "line": line,
                "marker": {"size": 5},
                "hovertemplate": f"{name}<br>%{{x}} subtasks: %{{y:.1%}}<extra></extra>",
            }
        )
    return {
        "data": data,
        "layout": {
            "height": 380,
            "legend": {"orientation": "h", "y": -0.24},
            "yaxis": {
                "range": [0, 1.04],
                "tickformat": ".0%",
                "title": {"text": "episodes"},
            },
            "xaxis": {
                "title": {"text": "completed at least so many subtasks"},
                "dtick": 2,
            },
        },
    }


def _flat(config: Mapping[str, Any]) -> dict[str, Any]:
    """Config without nesting, for a list of words."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        flat |= (
            {f"{key}: {name}": entry for name, entry in value.items()}
            if isinstance(value, Mapping)
            else {key: value}
        )
    return flat
