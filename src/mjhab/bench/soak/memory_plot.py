"""The memory curves of `mjhab bench soak` as an SVG picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

WIDTH = 760
HEIGHT = 300
MARGIN = 56
"""Size of the picture, and of the border with the axes [px]."""
COLORS = ("#2563eb", "#16a34a", "#ea580c", "#9333ea")
TICKS = 5


def memory_picture(runs: Mapping[str, Mapping[str, Any]]) -> str:
    """Draw resident memory over progress, from zero, one line for every run.

    Args:
        runs: what `soak.soak` returned, by name.
    """
    highest = 1.1 * max(mb for run in runs.values() for _, mb in run["curve"])
    parts = [*_axes(highest)]
    for number, (name, run) in enumerate(runs.items()):
        color = COLORS[number % len(COLORS)]
        total = run["curve"][-1][0]
        points = [_place(done / total, mb / highest) for done, mb in run["curve"]]
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        growth = 100 * run["growth_second_half"]
        legend = escape(f"{name}: {growth:+.1f} % over the second half")
        parts.append(
            f'<polyline points="{line}" fill="none" stroke="{color}" stroke-width="2"/>'
            f'<text x="{MARGIN + 12}" y="{20 + 18 * number}" fill="{color}">{legend}</text>'
        )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" '
        f'font-family="sans-serif" font-size="13">'
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>{"".join(parts)}</svg>\n'
    )


def _place(right: float, up: float) -> tuple[float, float]:
    """Pixel of a point, in shares of the axes."""
    x = MARGIN + right * (WIDTH - 1.5 * MARGIN)
    y = HEIGHT - MARGIN - up * (HEIGHT - 2 * MARGIN)
    return x, y


def _axes(highest: float) -> Sequence[str]:
    """Grid lines with their memory [MB] and the share of the run."""
    parts = []
    for share in (tick / TICKS for tick in range(TICKS + 1)):
        left, y = _place(0.0, share)
        right, _ = _place(1.0, share)
        x, bottom = _place(share, 0.0)
        parts.append(
            f'<line x1="{left}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}" stroke="#d4d4d8"/>'
            f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end" fill="#52525b">'
            f"{share * highest:.0f}</text>"
            f'<text x="{x:.1f}" y="{bottom + 18:.1f}" text-anchor="middle" fill="#52525b">'
            f"{100 * share:.0f} %</text>"
        )
    parts.append(
        f'<text x="{WIDTH / 2}" y="{HEIGHT - 14}" text-anchor="middle" fill="#52525b">'
        "share of the run; resident memory [MB] upwards</text>"
    )
    return parts
