"""The guard of the torch path itself: it refuses what stalls a GPU and lets everything else through."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from tests.no_sync import NoSync

VALUES = torch.arange(6.0).reshape(2, 3)
ROWS = torch.tensor([0, 1])
FLAGS = torch.tensor([True, False])

STALLING: dict[str, Callable[[], object]] = {
    "item": lambda: VALUES[0, 0].item(),
    "float": lambda: float(VALUES[0, 0]),
    "if": lambda: 1 if FLAGS.any() else 0,
    "tolist": lambda: VALUES.tolist(),
    "numpy": lambda: VALUES.numpy(),
    "asarray of numpy": lambda: np.asarray(VALUES),
    "sum with numpy": lambda: VALUES + np.zeros(3),
    "flags as index": lambda: VALUES[FLAGS],
    "flags as index, written": lambda: VALUES.clone().__setitem__(FLAGS, 0.0),
    "list as index": lambda: VALUES[[0, 1]],
    "numpy as index": lambda: VALUES[np.array([0, 1])],
    "tensor as slice end": lambda: VALUES[: ROWS[1]],
    "nonzero": lambda: FLAGS.nonzero(),
    "masked_select": lambda: VALUES.masked_select(VALUES > 1),
    "unique": lambda: ROWS.unique(),
    "host values": lambda: torch.tensor([1.0]),
    "other device": lambda: VALUES.to("meta"),
    "solve": lambda: torch.linalg.solve(torch.eye(3), torch.ones(3)),
}
FINE: dict[str, Callable[[], object]] = {
    "where": lambda: torch.where(FLAGS[:, None], VALUES, 0.0),
    "index": lambda: VALUES[ROWS, ROWS],
    "index written": lambda: VALUES.clone().__setitem__((ROWS, ROWS), VALUES[:, 0]),
    "filled": lambda: VALUES.clone().__setitem__((slice(None), 0), 1.0),
    "dtype": lambda: VALUES.double(),
    "made": lambda: torch.zeros(3) + torch.arange(3),
    "rows": lambda: list(VALUES),
}


@pytest.mark.parametrize("name", STALLING)
def test_what_stalls_is_refused(name: str) -> None:
    with NoSync(), pytest.raises(AssertionError):
        STALLING[name]()


@pytest.mark.parametrize("name", FINE)
def test_what_does_not_stall_is_let_through(name: str) -> None:
    with NoSync() as watch:
        FINE[name]()
    assert watch.seen


def test_outside_everything_is_as_before() -> None:
    with NoSync():
        pass
    assert VALUES.tolist() == VALUES.numpy().tolist() and VALUES[FLAGS].shape == (1, 3)
