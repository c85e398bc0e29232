"""Means over the rows of a reproduction, beside the paper's over the same rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from mjhab.reports.metrics import mean
from mjhab.reports.paper import SUCCESS_COLUMNS


def means(results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Means over the rows of Table 1 that a variant has results of, ours as a fraction, the paper's [%] as there.

    Returns:
        {"rules", "rows": their number, "success_once", "paper"}, for variants with two rows or more.
    """
    found = []
    for rules in dict.fromkeys(result["rules"] for result in results):
        done = [
            result
            for result in results
            if result["rules"] == rules and result["success_once"] is not None
        ]
        # A mean over one row would only repeat it.
        if len(done) < 2:
            continue
        # A policy of the paper has a mean over the same rows, or none.
        papers = {
            name: mean(result["paper"][name] for result in done)
            for name in SUCCESS_COLUMNS
            if all(name in result["paper"] for result in done)
        }
        ours = mean(result["success_once"] for result in done)
        found.append(
            {"rules": rules, "rows": len(done), "success_once": ours, "paper": papers}
        )
    return found
