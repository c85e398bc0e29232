"""The policies that know nothing."""

from __future__ import annotations

import numpy as np

from mjhab.rollout.policy import RandomPolicy, ZeroPolicy


def info_of(*indices: int | None) -> dict[str, list[dict[str, int] | None]]:
    return {
        "episode_spec": [None if index is None else {"index": index} for index in indices]
    }


def test_zero_policy_is_zero_for_every_world() -> None:
    policy = ZeroPolicy()
    policy.reset(np.ones(3, bool))
    actions = policy.act(None, info_of(0, 1, 2))
    assert actions.shape == (3, 13) and actions.dtype == np.float32 and not actions.any()


def test_random_actions_follow_the_episode_not_the_world() -> None:
    a = RandomPolicy(0)
    b = RandomPolicy(0)
    a.reset(np.ones(2, bool))
    b.reset(np.ones(2, bool))
    for _ in range(3):
        first = a.act(None, info_of(5, 6))
        swapped = b.act(None, info_of(6, 5))
        np.testing.assert_array_equal(first, swapped[::-1])
    assert (
        first.dtype == np.float32
        and np.abs(first).max() <= 1.0
        and len(np.unique(first)) == 26
    )


def test_a_reset_world_starts_its_stream_again_and_others_go_on() -> None:
    policy = RandomPolicy(0)
    policy.reset(np.ones(2, bool))
    start = policy.act(None, info_of(5, 6))
    policy.reset(np.array([True, False]))
    again = policy.act(None, info_of(5, 6))
    np.testing.assert_array_equal(start[0], again[0])
    assert (start[1] != again[1]).all()


def test_worlds_without_an_episode_are_accepted() -> None:
    policy = RandomPolicy(0)
    policy.reset(np.array([True, False]))
    assert policy.act(None, info_of(1, None)).shape == (2, 13)
