"""The images that were drawn last, so that a reset of some worlds draws no other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mjhab.sim.protocol import SimState


class DrawnImages:
    """Images of W worlds, and everything that they show: another place of a single body makes them outdated.

    Args:
        images: rows (W, ...) by their keys; copied, because the caller may change what it was given.
        state: what was drawn.
        homes: (W,) name of each world's home.
        target: (W, 3) centres of views of the target; None without such views.
    """

    def __init__(
        self,
        images: Mapping[str, np.ndarray],
        state: SimState,
        homes: Sequence[str],
        target: np.ndarray | None,
    ) -> None:
        # Copies: the caller may write into what it was given.
        self.images = {key: rows.copy() for key, rows in images.items()}
        self._shown = [rows.copy() for rows in _shown(state, homes, target)]

    def outdated(
        self, state: SimState, homes: Sequence[str], target: np.ndarray | None
    ) -> np.ndarray:
        """(W,) bool: worlds whose images would be others now."""
        pairs = zip(self._shown, _shown(state, homes, target), strict=True)
        # Exactly: a move of a micrometre may change a pixel.
        other = [(old != new).reshape(len(homes), -1).any(axis=1) for old, new in pairs]
        return np.logical_or.reduce(other)


def _shown(
    state: SimState, homes: Sequence[str], target: np.ndarray | None
) -> list[np.ndarray]:
    """Arrays (W, ...) that images depend on."""
    rows = [state.body_pos, state.body_mat, state.robot_q, np.array(homes)]
    return rows if target is None else [*rows, target]
