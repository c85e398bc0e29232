"""Rules for Gymnasium's ArrayConversion and NumpyToTorch wrappers about entries of `info` that are not numeric.

Gymnasium converts every iterable: it turns a text into ``"<generator object ...>"`` and fails on arrays of objects. The
rules here leave texts, arrays of objects and read-only maps unchanged.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
from gymnasium.error import DependencyNotInstalled

from mjhab.core.typed.frozen import FrozenMap


def keep_what_is_no_number() -> None:
    """Register rules with Gymnasium's ``array_conversion`` that return non-numeric entries unchanged.

    Types that already have a rule keep it. Without the packages that ArrayConversion needs, nothing is registered.
    """
    try:
        from gymnasium.wrappers.array_conversion import array_conversion
    except (ImportError, DependencyNotInstalled):
        return
    # The rule that arrays had: those of numbers keep it.
    of_iterables = array_conversion.dispatch(list)

    def unchanged(value: Any, xp: ModuleType, device: Any = None) -> Any:
        return value

    def numbers_only(value: np.ndarray, xp: ModuleType, device: Any = None) -> Any:
        return value if value.dtype == object else of_iterables(value, xp, device)

    rules = {str: unchanged, FrozenMap: unchanged, np.ndarray: numbers_only}
    for kind, rule in rules.items():
        # A rule that the user has registered stays.
        if kind not in array_conversion.registry:
            array_conversion.register(kind, rule)
