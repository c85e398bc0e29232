"""Progressive completion: fractions of episodes that complete the first n subtasks of a plan."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjhab.core.typed.checks import check


def progressive(
    completed_counts: Sequence[int] | np.ndarray, n_subtasks: int
) -> np.ndarray:
    """Return the fraction of episodes that completed at least 1, 2, ..., ``n_subtasks`` subtasks.

    Args:
        completed_counts: (E,) number of subtasks each episode completed.
        n_subtasks: length of the plan.

    Returns:
        (n_subtasks,) fractions in [0, 1], never rising; NaN without episodes.

    Raises:
        UsageError: a count outside [0, n_subtasks].
    """
    counts = np.asarray(completed_counts, dtype=np.int64)
    if counts.size == 0:
        # No episode is not the same as none that completed.
        return np.full(n_subtasks, np.nan)
    check(
        counts.min() >= 0 and counts.max() <= n_subtasks,
        "completed counts",
        (counts.min(), counts.max()),
        f"in 0..{n_subtasks}",
        "Give the number of subtasks of the whole plan.",
    )
    return (counts[:, None] >= np.arange(1, n_subtasks + 1)).mean(axis=0)


def upper_bound(success_rates: Sequence[float] | np.ndarray) -> np.ndarray:
    """Compute the progressive completion of independent subtasks: the cumulative product of their success rates.

    It is reached if every subtask of a plan starts as favourably as in its own evaluation.

    Args:
        success_rates: (S,) success fraction of every subtask evaluated alone, in plan order; NaN where it is unknown.

    Returns:
        (S,) fractions; NaN from the first unknown one on, unless a rate of 0 comes before it.
    """
    rates = np.asarray(success_rates, dtype=np.float64)
    products = np.cumprod(rates)
    # A rate of 0 makes all later products 0, also where a rate is not known.
    return np.where(np.cumprod(np.nan_to_num(rates, nan=1.0)) == 0.0, 0.0, products)
