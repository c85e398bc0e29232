"""The leaderboard: a page made of result files."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from mjhab.evaluation.score.capabilities import CAPABILITIES
from mjhab.evaluation.score.manifest import TRACKS
from mjhab.evaluation.score.result import Result

_HEAD = """# Leaderboard

Made by `mjhab score --table FILE ... --page docs/leaderboard.md` of result files, which `mjhab score --check FILE`
verifies by replay; edit none of it. [score.md](score.md) says what the numbers are. Intervals are Wilson 95 %.
"""


def leaderboard(results: Sequence[Result]) -> str:
    """A page in Markdown: per track a table of scores, best first, one by row, and one by capability."""
    parts = [_HEAD]
    for track, rows in TRACKS.items():
        some = [result for result in results if result.facts["track"] == track]
        if not some:
            continue
        some.sort(key=lambda result: (-result.summary["complete"], -result.summary["score"]))
        parts += [f"## Track: {track}", _scores(some)]
        parts += ["Score by row, per cent:", _rows(some, [row.name for row in rows])]
        parts += ["Profile by capability, per cent (of subtasks):", _profile(some)]
        meanings = [f"{name}: {entry.meaning}" for name, entry in CAPABILITIES.items()]
        parts.append(f"{'; '.join(meanings)}.")
    return "\n\n".join(part.strip() for part in parts) + "\n"


def _scores(results: Sequence[Result]) -> str:
    columns = ("policy", "split", "score", "episodes", "tainted", "errors", "mjhab", "digest")
    rows = []
    for result in results:
        summary = result.summary
        done = f"{summary['episodes']}" + ("" if summary["complete"] else " (incomplete)")
        rows.append(
            (
                result.facts["policy"],
                result.facts["split"],
                _percent(summary["score"]),
                done,
                summary["tainted"],
                summary["errors"],
                _version(result),
                f"`{result.digest[:12]}`",
            )
        )
    return _markdown(columns, rows)


def _rows(results: Sequence[Result], names: Sequence[str]) -> str:
    scores = [{row["name"]: row for row in result.summary["rows"]} for result in results]
    rows = [(name, *(_row_cell(score[name]) for score in scores)) for name in names]
    return _markdown(("row", *(result.facts["policy"] for result in results)), rows)


def _row_cell(row: Mapping[str, Any]) -> str:
    if not row["done"]:
        return "-"
    low, high = row["interval"]
    interval = f" ({100 * low:.0f} to {100 * high:.0f})" if row["subtask"] else ""
    return f"{_percent(row['score'])}{interval}"


def _profile(results: Sequence[Result]) -> str:
    rows = []
    for result in results:
        shown = result.summary["capabilities"]
        cells = [_capability_cell(shown[name]) for name in CAPABILITIES]
        rows.append((result.facts["policy"], *cells))
    return _markdown(("policy", *CAPABILITIES), rows)


def _capability_cell(entry: Mapping[str, Any]) -> str:
    return "-" if entry["rate"] is None else f"{_percent(entry['rate'])} ({entry['subtasks']})"


def _percent(rate: float) -> str:
    return f"{100 * rate:.1f}"


def _version(result: Result) -> str:
    return str(result.facts["versions"].get("mjhab", "?"))


def _markdown(columns: Sequence[object], rows: Sequence[Sequence[object]]) -> str:
    lines = [_line(columns), _line(["---"] * len(columns)), *(_line(row) for row in rows)]
    return "\n".join(lines)


def _line(cells: Sequence[object]) -> str:
    # Names of policies come from files: they are not to make markup or another column.
    shown = [re.sub(r"[|<>\[\]\n\r]", " ", str(cell)) for cell in cells]
    return f"| {' | '.join(shown)} |"
