"""Shortest ways over a raster: its free cells as a graph for ``scipy.sparse.csgraph``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix

Move = tuple[int, int]
EIGHT: tuple[Move, ...] = ((1, 0), (0, 1), (1, 1), (1, -1))
"""Steps to the neighbours of a cell, one of each pair of opposite ones; ways are up to 8.2 % longer than straight."""
SIXTEEN: tuple[Move, ...] = (*EIGHT, (1, 2), (2, 1), (1, -2), (2, -1))
"""Knight's moves too; ways are up to 2.8 % longer than straight."""


def grid_graph(
    free: np.ndarray,
    cell: float,
    moves: Sequence[Move] = EIGHT,
    price: np.ndarray | None = None,
) -> csr_matrix:
    """The graph of a raster; node i * Y + j is cell (i, j). Every edge is there once: use it undirected.

    Args:
        free: (X, Y) bool, cells that may be passed. A long move passes the cells between its ends too.
        cell: edge of a cell [m].
        moves: steps (dx, dy) with dx >= 0, each at most 2 cells.
        price: (X, Y) cost of a metre in each cell; 1 if absent. An edge costs the mean of its ends.
    """
    number = np.arange(free.size).reshape(free.shape)
    starts = []
    ends = []
    costs = []
    for dx, dy in moves:
        a = _window(free, (dx, dy), (0, 0))
        b = _window(free, (dx, dy), (dx, dy))
        both = free[a] & free[b]
        # A knight's move passes two cells between its ends; without this test ways would cut corners.
        if max(abs(dx), abs(dy)) == 2:
            step = (int(np.sign(dx)), int(np.sign(dy)))
            straight = (step[0], 0) if abs(dx) == 2 else (0, step[1])
            both = (
                both
                & free[_window(free, (dx, dy), straight)]
                & free[_window(free, (dx, dy), step)]
            )
        length = np.full(int(both.sum()), np.hypot(dx, dy) * cell)
        if price is not None:
            # The mean of both ends makes the price of a way the same in both directions.
            length = np.hypot(dx, dy) * cell * 0.5 * (price[a] + price[b])[both]
        starts.append(number[a][both])
        ends.append(number[b][both])
        costs.append(length)
    triple = (np.concatenate(costs), (np.concatenate(starts), np.concatenate(ends)))
    return csr_matrix(triple, shape=(free.size, free.size))


def _window(free: np.ndarray, move: Move, offset: Move) -> tuple[slice, slice]:
    """The cells at ``offset`` from all cells from which ``move`` stays on the raster."""
    (nx, ny) = free.shape
    (dx, dy) = move
    x = offset[0]
    y = max(0, -dy) + offset[1]
    return slice(x, x + max(nx - dx, 0)), slice(y, y + max(ny - abs(dy), 0))
