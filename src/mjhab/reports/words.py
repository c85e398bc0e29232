"""Numbers as a reader is told them: rates, times, forces."""

from __future__ import annotations

from mjhab.core.timing import STEP_SECONDS

NOT_JUDGED = "by teleport"
"""In place of rates of subtasks that the environment did itself."""


def percent(value: float) -> str:
    """A rate in 0..1 as text."""
    # Without a decimal only where nothing is rounded away.
    return f"{100 * value:.0f} %" if value in (0.0, 1.0) else f"{100 * value:.1f} %"


def interval(low: float, high: float, digits: int = 0) -> str:
    """A 95 % interval of a rate in 0..1 as text."""
    return f"{100 * low:.{digits}f} to {100 * high:.{digits}f} % (95 % CI)"


def duration(steps: float | None) -> str:
    """Control steps as seconds; "-" for None."""
    return "-" if steps is None else f"{steps * STEP_SECONDS:.1f} s"


def newtons(force: float | None) -> str:
    """A force [N] as text; "-" for None."""
    return "-" if force is None else f"{force:,.0f} N"


def spaced(name: str) -> str:
    """A name of code as words: "too_slow_failure" becomes "too slow failure"."""
    return name.replace("_", " ")
