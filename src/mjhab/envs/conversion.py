"""What Gymnasium's ArrayConversion and NumpyToTorch do with entries of `info` that are no arrays of numbers.

Gymnasium converts everything that can be iterated: it makes ``"<generator object ...>"`` of a text and stops at arrays
of objects. Here both stay as they are, and so do read-only maps.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
from gymnasium.error import DependencyNotInstalled

from mjhab.core.frozen import FrozenMap


def keep_what_is_no_number() -> None:
    """Tell Gymnasium's ``array_conversion`` to return texts, arrays of objects and read-only maps unchanged.

    A type for which Gymnasium itself has a rule keeps that rule. Without the packages that ArrayConversion needs there
    is nothing to tell.
    """
    try:
        from gymnasium.wrappers.array_conversion import array_conversion
    except (ImportError, DependencyNotInstalled):
        return
    of_iterables = array_conversion.dispatch(list)

    def unchanged(value: Any, xp: ModuleType, device: Any = None) -> Any:
        return value

    def numbers_only(value: np.ndarray, xp: ModuleType, device: Any = None) -> Any:
        return value if value.dtype == object else of_iterables(value, xp, device)

    rules = {str: unchanged, FrozenMap: unchanged, np.ndarray: numbers_only}
    for kind, rule in rules.items():
        if kind not in array_conversion.registry:
            array_conversion.register(kind, rule)
