"""Distance fields around furniture on the device, as one table for all goals.

`envs.parts.nav_distance` is the counterpart on the host.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from mjhab.core.errors import UsageError
from mjhab.scenes.freespace import FreeMap

MAX_BYTES = 4 << 30
"""Largest size of the table in device memory; a goal in an apartment of 10 x 7.6 m takes 61 kB."""
_STEPS = int(np.iinfo(np.int16).max)


class GoalFields:
    """Path lengths to each of N goals over the free floor of their homes.

    The fields of `FreeMap.distances_to` are stored as one int16 tensor (F, X, Y), each in units of its largest value /
    32767. `at` differs from `NavDistance.at` by less than 1 mm in homes whose paths are shorter than 60 m. Goals of one
    home that are equal to the millimetre share a field. Computing a field takes about 10 ms.

    Args:
        goals: N pairs of home name and goal x, y (, z) [m].
        maps: function from the name of a home to its free floor (`SpawnSampler.map`).
        device: device of the tensors.

    Attributes:
        index: (N,) int64 on the device, index of every goal's field.

    Raises:
        UsageError: the fields need more than MAX_BYTES, or the base fits nowhere in a home.
    """

    def __init__(
        self,
        goals: Sequence[tuple[str, Sequence[float]]],
        maps: Callable[[str], FreeMap],
        device: torch.device | str,
    ) -> None:
        keys = [
            (home, round(float(goal[0]), 3), round(float(goal[1]), 3))
            for home, goal in goals
        ]
        # Backwards, so that the first of equal goals is the one that stays.
        first = {key: n for n, key in reversed(list(enumerate(keys)))}
        different = sorted(first, key=first.__getitem__)
        rows = {key: f for f, key in enumerate(different)}
        free = {home: maps(home) for home in dict.fromkeys(key[0] for key in different)}
        table, tops = _fields(
            [(free[goals[first[key]][0]], goals[first[key]][1]) for key in different]
        )
        places = [
            (*free[key[0]].origin, free[key[0]].cell, *free[key[0]].blocked.shape)
            for key in different
        ]
        # A row although there is no goal, so that look-ups have something to read.
        numbers = np.array(places or [(0.0, 0.0, 1.0, 1.0, 1.0)], np.float32)
        self.index = torch.as_tensor(
            np.array([rows[key] for key in keys], np.int64), device=device
        )
        self._table = torch.as_tensor(table, device=device)
        self._step = torch.as_tensor(tops / _STEPS, device=device)
        self._origin = torch.as_tensor(numbers[:, :2], device=device)
        self._cell = torch.as_tensor(numbers[:, 2], device=device)
        self._last = torch.as_tensor(numbers[:, 3:] - 1.0, device=device)

    def at(self, index: torch.Tensor, xy: torch.Tensor) -> torch.Tensor:
        """Path length (W,) [m] from base positions ``xy`` (W, 2) to the goals of the fields ``index`` (W,) int64.

        0 where the index is -1. Outside the map the distance to the map is added. See `NavDistance.at`.
        """
        # A world without a goal reads some field, and its result is not used.
        field = torch.clamp(index, min=0)
        cell = self._cell[field]
        last = self._last[field]
        wanted = (xy - self._origin[field]) / cell[:, None] - 0.5
        inside = torch.minimum(torch.clamp(wanted, min=0.0), last)
        # One before the last cell at most, so that there is a neighbour to interpolate with.
        low = torch.minimum(torch.floor(inside), torch.clamp(last - 1.0, min=0.0))
        high = torch.minimum(low + 1.0, last)
        (u, v) = (inside - low).unbind(1)
        off = wanted - inside
        (i, j) = low.long().unbind(1)
        (k, m) = high.long().unbind(1)
        near, far = (
            # Interpolated before it is scaled: the table holds whole numbers.
            (1 - v) * self._table[field, row, j].to(xy.dtype)
            + v * self._table[field, row, m].to(xy.dtype)
            for row in (i, k)
        )
        beyond = torch.sqrt(off[:, 0] * off[:, 0] + off[:, 1] * off[:, 1]) * cell
        length = ((1 - u) * near + u * far) * self._step[field] + beyond
        return torch.where(index < 0, 0.0, length)


def _fields(
    goals: Sequence[tuple[FreeMap, Sequence[float]]],
) -> tuple[np.ndarray, np.ndarray]:
    """Distance fields of goals on their maps: (F, X, Y) int16 table, and the largest distance of each (F,) [m]."""
    shapes = [free.blocked.shape for free, _ in goals]
    size = tuple(max((shape[axis] for shape in shapes), default=1) for axis in (0, 1))
    needed = 2 * len(goals) * size[0] * size[1]
    # Said before the fields are computed, which takes minutes.
    if needed > MAX_BYTES:
        raise UsageError(
            f"path lengths to {len(goals)} navigation goals need {needed / 2**30:.1f} GiB of the device, more than "
            f"{MAX_BYTES / 2**30:.0f}; take fewer starts (starts=), or a reward_mode that needs none"
        )
    table = np.zeros((max(len(goals), 1), *size), np.int16)
    tops = np.ones(max(len(goals), 1), np.float32)
    for f, (free, goal) in enumerate(goals):
        field = free.distances_to(np.asarray(goal, float)[:2])
        # A home of one cell would divide by 0.
        tops[f] = max(float(field.max()), 1e-3)
        table[f, : field.shape[0], : field.shape[1]] = np.rint(field * (_STEPS / tops[f]))
    return table, tops
