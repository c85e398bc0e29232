"""Advantages against targets that were worked out by hand."""

from __future__ import annotations

import pytest
import torch

from mjhab.learning.reinforcement.returns import (
    Outcomes,
    advantages,
    finite_horizon_advantages,
)

GAMMA = 0.5
LAMBDA = 0.8


def outcomes(terminated: list[bool], ended: list[bool]) -> Outcomes:
    """Three steps of one world: rewards 1, 2, 4; values 10, 20, 30 before and 20, 30, 40 after them."""
    column = lambda values: torch.tensor(values)[:, None]  # noqa: E731
    return Outcomes(
        column([1.0, 2.0, 4.0]),
        column([10.0, 20.0, 30.0]),
        column([20.0, 30.0, 40.0]),
        column(terminated),
        column(ended),
    )


def test_an_episode_that_goes_on_takes_the_value_of_what_follows() -> None:
    found = advantages(outcomes([False] * 3, [False] * 3), GAMMA, LAMBDA)
    third = 4 + 0.5 * 40 - 30
    second = (2 + 0.5 * 30 - 20) + 0.4 * third
    first = (1 + 0.5 * 20 - 10) + 0.4 * second
    assert found.flatten().tolist() == pytest.approx([first, second, third])


def test_time_that_is_up_leaves_the_value_of_the_last_observation() -> None:
    found = advantages(outcomes([False] * 3, [False, True, False]), GAMMA, LAMBDA)
    third = 4 + 0.5 * 40 - 30
    second = (
        2 + 0.5 * 30 - 20
    )  # nothing of the next episode, but what would have followed
    first = (1 + 0.5 * 20 - 10) + 0.4 * second
    assert found.flatten().tolist() == pytest.approx([first, second, third])


def test_after_success_or_failure_nothing_follows() -> None:
    found = advantages(
        outcomes([False, True, False], [False, True, False]), GAMMA, LAMBDA
    )
    second = 2.0 - 20
    first = (1 + 0.5 * 20 - 10) + 0.4 * second
    assert found.flatten().tolist()[:2] == pytest.approx([first, second])


def test_finite_horizon_averages_the_returns_of_all_lengths() -> None:
    found = finite_horizon_advantages(outcomes([False] * 3, [False] * 3), GAMMA, LAMBDA)
    one = 1 + 0.5 * 20
    two = 1 + 0.5 * 2 + 0.25 * 30
    three = 1 + 0.5 * 2 + 0.25 * 4 + 0.125 * 40
    weighted = (one + 0.8 * two + 0.64 * three) / (1 + 0.8 + 0.64)
    assert float(found[0, 0]) == pytest.approx(weighted - 10)


def test_with_lambda_1_and_time_up_at_the_end_both_kinds_of_ends_differ_by_the_value() -> (
    None
):
    ends = [False, False, True]
    time_up = advantages(outcomes([False] * 3, ends), GAMMA, 1.0)
    failed = advantages(outcomes(ends, ends), GAMMA, 1.0)
    assert (time_up - failed).flatten().tolist() == pytest.approx(
        [GAMMA**3 * 40, GAMMA**2 * 40, GAMMA * 40]
    )
