"""The global random generators of the process, which libraries of others draw from; mjhab itself never does."""

from __future__ import annotations

import random
import sys
from typing import Any

import numpy as np

_NUMPY_SEEDS = 1 << 32


class SeededGlobals:
    """While it is entered, the global generators of Python, numpy and torch begin from a seed.

    Afterwards they go on as if nothing had been drawn.

    Torch is seeded if it is loaded, at the beginning or by the time of `take_torch`.

    Args:
        seed: any whole number >= 0.
    """

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._python: Any = None
        self._numpy: Any = None
        self._torch: tuple[Any, list[Any]] | None = None

    def __enter__(self) -> SeededGlobals:
        """Keep the states of the generators, and seed them."""
        self._python = random.getstate()
        self._numpy = np.random.get_state()
        random.seed(self._seed)
        # numpy takes 32 bits.
        np.random.seed(self._seed % _NUMPY_SEEDS)
        self.take_torch()
        return self

    def take_torch(self) -> None:
        """Seed torch if it was loaded since."""
        # Not imported: it would take a second, and most policies do not need it.
        torch: Any = sys.modules.get("torch")
        # A module that is being imported has not got everything yet.
        if self._torch is not None or not hasattr(torch, "manual_seed"):
            return
        devices = (
            torch.cuda.get_rng_state_all()
            # Asking for the state would initialise CUDA and take its memory.
            if torch.cuda.is_available() and torch.cuda.is_initialized()
            else []
        )
        self._torch = (torch.get_rng_state(), devices)
        torch.manual_seed(self._seed)

    def __exit__(self, *exception: object) -> None:
        """Put the generators back."""
        random.setstate(self._python)
        np.random.set_state(self._numpy)
        if self._torch is not None:
            torch = sys.modules["torch"]
            state, devices = self._torch
            torch.set_rng_state(state)
            if devices:
                torch.cuda.set_rng_state_all(devices)
