"""Length of the path from every world's base to its navigation goal around furniture, from distance fields."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from mjhab.core.errors import unknown_name
from mjhab.layout.layout import Layout
from mjhab.scenes.freespace import FreeMap, look_up, shared_map


class GoalPaths(Protocol):
    """Lengths of the paths to the goals of W worlds, however they are found."""

    def begin(self, world: int, home: str, goal_xy: np.ndarray) -> None:
        """Set the goal (2,) [m] of a world."""
        ...

    def at(self, base_xy: np.ndarray) -> np.ndarray:
        """(W,) lengths [m] from base positions (W, 2); 0 in worlds without a goal."""
        ...


class NavDistance:
    """Path lengths in W worlds, each with its own home and goal.

    Args:
        layout: layout of the homes.
        num_worlds: W.
        maps: function from the name of a home to its free floor, to reuse existing maps (`SpawnSampler.map`).
    """

    def __init__(
        self,
        layout: Layout,
        num_worlds: int,
        maps: Callable[[str], FreeMap] | None = None,
    ) -> None:
        self._homes = layout.pack.homes_by_name
        self._pack = layout.pack
        self._given = maps or self._shared
        # Single precision is exact to micrometres at these lengths, and halves the memory.
        self._fields = np.zeros((num_worlds, 1, 1), np.float32)
        self._origin = np.zeros((num_worlds, 2))
        self._cell = np.ones(num_worlds)
        self._begun = np.zeros(num_worlds, bool)
        self._shape = np.ones((num_worlds, 2), np.int64)

    def begin(self, world: int, home: str, goal_xy: np.ndarray) -> None:
        """Set the goal of a world to ``goal_xy`` (2,) [m] in ``home``; computing the field of a new goal takes 10 ms.

        Raises:
            UsageError: no such home, or the base fits nowhere in it.
        """
        if home not in self._homes:
            raise unknown_name("home", home, self._homes)
        found = self._given(home)
        field = found.distances_to(goal_xy)
        worlds, x, y = self._fields.shape
        # One array for all worlds, as large as the largest home so far: it is looked up in one call.
        if field.shape[0] > x or field.shape[1] > y:
            grown = np.zeros(
                (worlds, max(x, field.shape[0]), max(y, field.shape[1])), np.float32
            )
            grown[:, :x, :y] = self._fields
            self._fields = grown
        self._fields[world, : field.shape[0], : field.shape[1]] = field
        self._origin[world] = found.origin
        self._cell[world] = found.cell
        self._shape[world] = field.shape
        self._begun[world] = True

    def at(self, base_xy: np.ndarray) -> np.ndarray:
        """Path length (W,) [m] from base positions ``base_xy`` (W, 2) to the goals, see `FreeMap.distances_to`.

        0 in worlds without a goal. Outside the map the distance to the map is added.
        """
        found = look_up(self._fields, self._origin, self._cell, self._shape, base_xy)
        return np.where(self._begun, found, 0.0)

    def _shared(self, home: str) -> FreeMap:
        return shared_map(self._homes[home], self._pack)
