"""Arrays in the one form that kernels are compiled for."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike


def read_only(values: np.ndarray, dtype: DTypeLike = np.float64) -> np.ndarray:
    """A contiguous read-only view of ``values``, or of a copy where they are not contiguous or of another type.

    Numba compiles a kernel again, which takes up to 15 s, for an array that differs in writeability or layout.
    """
    # A view of its own, so that the caller's array stays writeable.
    view = np.ascontiguousarray(values, dtype).view()
    view.flags.writeable = False
    return view
