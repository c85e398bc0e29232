"""Dense rewards: the normaliser, more is never worse, numpy against torch, worlds do not matter to each other."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mjhab.core.arrays import map_record
from mjhab.tasks.plan import SubtaskKind
from mjhab.tasks.rewards.table import RewardTable, RewardView
from mjhab.tasks.scoring import DenseReward, RewardOptions, reward_table
from mjhab.tasks.subtasks.registry import SUBTASKS, name_of
from tests.tasks.build import CONFIG, assert_same
from tests.tasks.rewards.states import (
    BEST,
    CLOSE,
    FULL,
    NAVIGATE,
    OPEN,
    PICK,
    PLACE,
    random_view,
    rows,
    view_of,
)

# -- the normaliser ----------------------------------------------------------------------------------------------------


def table_of(kind: int) -> RewardTable:
    return reward_table(name_of(kind))


@pytest.mark.parametrize("kind", SubtaskKind)
def test_the_best_state_reaches_the_normaliser(kind: SubtaskKind) -> None:
    scored = FULL.score(view_of([kind], **BEST[kind]))
    assert scored.total[0] == pytest.approx(
        {PICK: 29, PLACE: 44, NAVIGATE: 28, OPEN: 27, CLOSE: 36}[kind], abs=1e-12
    )
    assert (
        scored.normaliser[0]
        == table_of(kind).attainable
        == pytest.approx(scored.total[0], abs=1e-12)
    )


def test_published_normalisers_differ_where_the_original_is_off() -> None:
    differ = {
        name: reward_table(name).published
        for name in SUBTASKS
        if reward_table(name).published != reward_table(name).attainable
    }
    assert differ == {"pick": 28.0, "close": 37.0}


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32), st.floats(0.0, 1.0))
def test_no_state_earns_more_than_the_normaliser(seed: int, chance: float) -> None:
    scored = FULL.score(random_view(seed, 20, chance=chance))
    assert (scored.total <= scored.normaliser * (1 + 1e-12)).all()
    assert (scored.terms >= 0).all()
    np.testing.assert_allclose(scored.terms.sum(0), scored.total, rtol=1e-12)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32), st.lists(st.floats(-20, 20), min_size=5, max_size=5))
def test_no_state_earns_more_than_the_normaliser_of_other_scales(
    seed: int, drawn: list[float]
) -> None:
    scales = {
        name: {table_of(k).terms[k + 2].name: drawn[k]} for k, name in enumerate(SUBTASKS)
    }
    scored = DenseReward(CONFIG, RewardOptions(scales)).score(random_view(seed, 20))
    assert (scored.total <= scored.normaliser * (1 + 1e-12)).all()
    np.testing.assert_allclose(scored.terms.sum(0), scored.total, rtol=1e-12, atol=1e-12)


# -- properties --------------------------------------------------------------------------------------------------------


def with_reach(kind: int, d: float) -> RewardView:
    """A state of a subtask that is not done, ``d`` [m] from what it has to reach."""
    away = {
        PICK: {"object_pos": [0.5 + d, 0.0, 1.27]},
        PLACE: {"object_pos": [1.2 + d, 0.0, 0.5], "tcp_pos": [1.2 + d, 0.0, 0.5]},
        NAVIGATE: {"base_pose": [-5.0, 0.0, 0.0], "nav_distance": d},
        OPEN: {"handle_distance": d},
        CLOSE: {"handle_distance": d},
    }
    return view_of([kind], **away[kind])


@pytest.mark.parametrize("kind", SubtaskKind)
@settings(max_examples=25, deadline=None)
@given(near=st.floats(0.0, 3.0), more=st.floats(0.001, 1.0))
def test_nearer_is_better(kind: SubtaskKind, near: float, more: float) -> None:
    assert (
        FULL.score(with_reach(kind, near)).total[0]
        > FULL.score(with_reach(kind, near + more)).total[0]
    )


@pytest.mark.parametrize("kind", (OPEN, CLOSE))
@settings(max_examples=25, deadline=None)
@given(q=st.floats(0.02, 0.43), more=st.floats(0.001, 0.02))
def test_moving_the_joint_towards_its_end_is_better(
    kind: int, q: float, more: float
) -> None:
    less_open, more_open = (
        FULL.score(view_of([kind], joint_q=x)).total[0] for x in (q, q + more)
    )
    assert more_open > less_open if kind == OPEN else less_open > more_open


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from(["float64", "float32"]))
def test_numpy_and_torch_agree(seed: int, dtype: str) -> None:
    def cast(record: Any, make: Any) -> Any:
        def one(x: Any) -> Any:
            if dataclasses.is_dataclass(x):
                return map_record(one, x)
            return make(x.astype(dtype) if x.dtype == np.float64 else x)

        return map_record(one, record)

    view = random_view(seed, 12)
    ours = FULL.score(cast(view, np.asarray))
    theirs = FULL.score(cast(view, lambda x: torch.from_numpy(x.copy())))
    for name in ("terms", "total", "normaliser"):
        assert getattr(ours, name).dtype == dtype
        assert_same(
            getattr(ours, name),
            getattr(theirs, name),
            name,
            1e-12 if dtype == "float64" else 1e-5,
        )


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32))
def test_a_world_earns_the_same_whatever_is_beside_it(seed: int) -> None:
    view = random_view(seed, 9)
    together = FULL.score(view)
    for w in range(9):
        alone = FULL.score(rows(view, [w]))
        assert alone.total[0] == together.total[w]
        np.testing.assert_array_equal(alone.terms[:, 0], together.terms[:, w])
        kind = SubtaskKind(int(view.signals.kind[w]))
        only = DenseReward(CONFIG, kinds=(name_of(kind),))
        own = only.score(rows(view, [w]))
        assert own.total[0] == together.total[w]
        assert only.names == tuple(t.name for t in table_of(kind).terms)
        mine = [FULL.names.index(name) for name in only.names]
        np.testing.assert_array_equal(own.terms[:, 0], together.terms[mine, w])
