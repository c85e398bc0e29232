"""One owner of sums of floats.

Results are promised to be the same, bit by bit, under every version of Python (docs/reproducibility.md). The built-in
``sum`` breaks that: since Python 3.12 it compensates rounding errors. ``tests/bits/test_source.py`` forbids it for
floats.
"""

from __future__ import annotations

from collections.abc import Iterable


def ordered_sum(values: Iterable[float]) -> float:
    """Sum floats from left to right, every addition rounded to double: what ``sum`` did before Python 3.12.

    >>> ordered_sum([0.1] * 10)
    0.9999999999999999
    >>> ordered_sum([])
    0.0

    Args:
        values: finite or not; NumPy numbers are taken as doubles.
    """
    total = 0.0
    for value in values:
        total += float(value)
    return total
