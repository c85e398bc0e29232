"""The page of ``mjhab bench experts``: tables and charts of the experts next to the policies of the paper."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from mjhab.bench.experts.rows import ALL, CHAIN, PAPER_POLICY, Result
from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.reports import parts
from mjhab.reports.metrics import wilson
from mjhab.reports.paper import beside_the_paper, rules_of
from mjhab.reports.plots import LABEL_COLORS, Figure, labels_figure
from mjhab.reports.run import render_page
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
    results: Sequence[Result], groups: Sequence[Result], config: Mapping[str, Any]
) -> str:
    """The whole page, which needs no network.

    Args:
        results: every row. groups: rows over all targets, see `expert_rows.together`. config: what they have in common.
    """
    singles = [result for result in results if result.subtask != CHAIN]
    chains = [result for result in results if result.subtask == CHAIN]
    body = [_header(results, config), _cards(singles, chains)]
    plots = {}
    if groups:
        hint = (
            f"Success once within the horizon and the force limit of a subtask, all targets. {_GENTLE} {_PAPER} "
            f"{beside_the_paper(rules_of(config))}"
        )
        body.append(parts.section("Per subtask", hint, _table(groups)))
    if chains:
        hint = (
            "Share of episodes that completed at least so many subtasks of the plan, done one after the other without "
            "help. Solid: the robot is teleported to every goal, as in the paper; dashed: the expert drives."
        )
        places = ""
        for pack in dict.fromkeys(chain.pack for chain in chains):
            plots[f"chains-{pack}"] = _chain_figure(
                [chain for chain in chains if chain.pack == pack]
            )
            places += (
                f'<h3>{escape(pack)} homes</h3><div id="chains-{escape(pack)}"></div>'
            )
        body.append(parts.section("Whole tasks", hint, _chain_table(chains) + places))
    for kind in SUBTASKS:
        members = [result for result in singles if result.subtask == kind]
        if members:
            body.append(_kind_section(kind, members, plots))
    errors = [result for result in results if result.error]
    if errors:
        body.append(
            parts.section(
                "Not measured", "These rows stopped with an error.", _errors(errors)
            )
        )
    body.append(
        parts.section(
            "Run", "What all rows have in common.", parts.config_list(_flat(config))
        )
    )
    return render_page("Experts", "\n".join(body), {"plots": plots})


_PAPER = (
    f"Paper: {PAPER_POLICY} of the MS-HAB paper (Tables 6 to 13), one policy per object, trained by reinforcement "
    "learning on depth images, 1,008 episodes each. Experts know the state of the simulation, policies do not; the "
    "built-in homes are not those of the paper."
)


_GENTLE = "< 1,400 N: success once while the forces on the robot summed up to less than that, instead of the limit."


def _header(results: Sequence[Result], config: Mapping[str, Any]) -> str:
    shown = [
        (
            "homes",
            f"{', '.join(dict.fromkeys(r.pack for r in results))}, {config['split']}",
        ),
        ("seed", config["seed"]),
        ("rules", rules_of(config)),
        ("starts", config["spawn_rule"]),
        ("joints of furniture", config.get("joint_dynamics", OWN_DYNAMICS)),
    ]
    chips = "".join(
        f'<span class="chip">{escape(k)} <b>{escape(str(v))}</b></span>' for k, v in shown
    )
    left = sum(result.wanted - result.episodes for result in results)
    banner = ""
    if left:
        total = sum(result.wanted for result in results)
        banner = (
            f'<div class="banner">Partial: {left:,} of {total:,} episodes are left. The same command with --resume '
            "goes on.</div>"
        )
    return (
        "<header><h1>How often the experts succeed</h1><p>Scripted whole-body experts of mjhab with a robot in "
        f'furnished homes, simulated by MuJoCo.</p><div class="chips">{chips}</div>{banner}</header>'
    )


def _cards(singles: Sequence[Result], chains: Sequence[Result]) -> str:
    values = []
    if singles:
        count = sum(r.episodes for r in singles)
        once = sum(r.successes for r in singles)
        low, high = wilson(once, count)
        gentle = ordered_sum((r.gentle or 0.0) * r.episodes for r in singles)
        values += [
            ("single subtasks", f"{count:,}", f"episodes in {len(singles)} rows"),
            (
                "success once",
                _rate(once / count if count else None),
                f"{100 * low:.1f} to {100 * high:.1f} % (95 % CI)",
            ),
            (
                "under 1,400 N",
                _rate(gentle / count if count else None),
                "forces up to success, summed",
            ),
        ]
        both = [r.over_paper for r in singles if r.over_paper is not None]
        better = sum(points > 0 for points in both)
        values.append(
            (
                "above the paper",
                f"{better} / {len(both)}",
                f"rows, against {PAPER_POLICY}",
            )
        )
    if chains:
        count = sum(r.episodes for r in chains)
        once = sum(r.successes for r in chains)
        values.append(
            (
                "whole tasks",
                _rate(once / count if count else None),
                f"complete, of {count:,} episodes",
            )
        )
    asked = [r.met for r in (*singles, *chains) if r.met is not None]
    values.append(
        ("as much as asked", f"{sum(asked)} / {len(asked)}", "rows, by their rates")
    )
    tainted = sum(r.tainted for r in (*singles, *chains))
    values.append(
        ("tainted episodes", f"{tainted}", "flagged by the simulation, counted")
    )
    tiles = (
        f'<div class="card"><div class="name">{escape(name)}</div><div class="value">{escape(value)}</div>'
        f'<div class="more">{escape(more)}</div></div>'
        for name, value, more in values
    )
    return f'<div class="cards">{"".join(tiles)}</div>'


def _kind_section(kind: str, members: Sequence[Result], plots: dict[str, Figure]) -> str:
    body = ""
    if any(result.paper is not None for result in members):
        plots[f"paper-{kind}"] = _paper_figure(members)
        body += f'<div id="paper-{kind}"></div>'
    body += _table(members)
    counts = {
        _bar_name(result): Counter(result.labels) for result in members if result.episodes
    }
    if counts:
        figure = labels_figure(counts, tuple(counts))
        height = 90 + _ROW_HEIGHT * len(counts)
        figure["layout"] |= {"height": height + 60, "bargap": 0.25}
        figure["layout"]["legend"] |= {"y": -50 / height}
        plots[f"labels-{kind}"] = figure
        body += f'<h3>How it went</h3><div id="labels-{kind}"></div>'
    hint = (
        "Success once; whiskers are Wilson 95 % intervals. The dot says whether the rate is at least what the project "
        f"asks for. {_GENTLE} How it went is told by trajectory labels: {LABEL_COLORS}."
    )
    return parts.section(kind.capitalize(), hint, body)


def _table(results: Sequence[Result]) -> str:
    """Rows of single subtasks; a click on a head sorts. Columns that tell nothing apart are left out."""
    heads = [
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
    ]
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
    return _html_table(
        [head for head in heads if head[0] not in alike],
        [_cells(result) for result in results],
    )


def _cells(r: Result) -> dict[str, str]:
    """HTML of the cells of a row by the names of their columns."""
    paper = f'<td class="n" title="Table {r.paper_table}">{_rate(r.paper)}</td>'
    return {
        "homes": f"<td>{escape(r.pack)}</td>",
        "task": f"<td>{escape(r.task.replace('_', ' '))}</td>",
        "subtask": f"<td>{escape(r.subtask)}</td>",
        "target": f"<td>{escape('all' if r.target in ('', ALL) else r.target)}</td>",
        "navigate": f"<td>{escape(r.navigate)}</td>",
        "n": _number(r.episodes, f"{r.episodes:,}"),
        "once": _number(r.success_once, _rate(r.success_once), "font-weight:600"),
        "complete": _number(r.success_once, _rate(r.success_once), "font-weight:600"),
        "95 %": f"<td>{_interval(r)}</td>",
        "asked": _number(r.asked, _asked(r)),
        "paper": paper if r.paper is not None else "<td></td>",
        "difference": _number(
            r.over_paper, "" if r.over_paper is None else f"{r.over_paper:+.1f}", _sign(r)
        ),
        "< 1,400 N": _number(r.gentle, _rate(r.gentle)),
        "no peak of 1,400 N": _number(r.gentle_peak, _rate(r.gentle_peak)),
        "tainted": _number(r.tainted, str(r.tainted)),
        "failures": f'<td class="words">{_failures(r)}</td>',
    }


def _chain_table(chains: Sequence[Result]) -> str:
    heads = (
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
    return _html_table(heads, [_cells(result) for result in chains])


def _html_table(
    heads: Sequence[tuple[str, str]], rows: Sequence[Mapping[str, str]]
) -> str:
    head = "".join(f'<th class="{css}">{escape(name)}</th>' for name, css in heads)
    body = "".join(f"<tr>{''.join(row[name] for name, _ in heads)}</tr>" for row in rows)
    table = (
        f'<table class="sortable" style="font-size:13px"><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table>"
    )
    return f'<div class="scroll">{table}</div>'


def _number(value: float | None, text: str, style: str = "") -> str:
    return f'<td class="n" data-value="{"" if value is None else value}" style="{style}">{text}</td>'


def _rate(value: float | None) -> str:
    return "-" if value is None else parts.percent(value)


def _interval(r: Result) -> str:
    if r.success_once is None:
        return ""
    low, high = (100 * bound for bound in r.interval)
    return (
        f'<div class="rate" style="width:84px" title="{low:.1f} to {high:.1f} %">'
        f'<i style="width:{100 * r.success_once:.1f}%"></i>'
        f'<u style="left:{low:.1f}%;width:{high - low:.1f}%"></u></div>'
    )


def _asked(r: Result) -> str:
    if r.asked is None:
        return ""
    css = "none" if r.met is None else "good" if r.met else "bad"
    return f'<span class="dot {css}"></span>{100 * r.asked:.0f} %'


def _sign(r: Result) -> str:
    if r.over_paper is None:
        return ""
    return f"color:var(--{'good' if r.over_paper >= 0 else 'bad'})"


def _failures(r: Result) -> str:
    named = list(r.failures.items())[:_MOST_FAILURES]
    words = [
        f"{n} {name.removesuffix('_failure').replace('_', ' ')}" for name, n in named
    ]
    more = len(r.failures) - len(named)
    return escape(", ".join(words) + (f" and {more} more" if more > 0 else ""))


def _bar_name(r: Result) -> str:
    return f"{_short(r)}, {r.pack}"


def _short(r: Result) -> str:
    """Task and target in a few letters."""
    task = "".join(word[0] for word in r.task.split("_")).upper()
    return f"{task} {r.target.rpartition('/')[0] or r.target or ALL}"


def _pack_bars(results: Sequence[Result], pack: str, color: str) -> dict[str, Any]:
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


def _paper_bars(results: Sequence[Result]) -> dict[str, Any]:
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


def _paper_figure(results: Sequence[Result]) -> Figure:
    """Bars: ours in every asset pack, then the paper's."""
    names = list(dict.fromkeys(_short(result) for result in results))
    packs = dict.fromkeys(result.pack for result in results)
    data = [
        _pack_bars(results, pack, color)
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


def _chain_figure(chains: Sequence[Result]) -> Figure:
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


def _errors(results: Sequence[Result]) -> str:
    rows = "".join(
        f"<tr><td>{escape(r.pack)} {escape(r.task)} {escape(r.subtask)} {escape(r.target)}</td>"
        f'<td style="white-space:pre-wrap">{escape(r.error)}</td></tr>'
        for r in results
    )
    return f'<div class="scroll"><table><tbody>{rows}</tbody></table></div>'


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
