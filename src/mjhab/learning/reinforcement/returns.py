"""Advantages of a rollout, with the value of what follows where an episode ends by time."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Outcomes:
    """What T control steps of W worlds brought; all (T, W).

    rewards. values: of what was seen before each step. next_values: of what was seen after it, which at the end of an
    episode is its last observation, not the first of the next one. terminated: the episode ended by success or
    failure, so nothing follows. ended: it ended by that, or by time.
    """

    rewards: Tensor
    values: Tensor
    next_values: Tensor
    terminated: Tensor
    ended: Tensor


def advantages(outcomes: Outcomes, gamma: float, gae_lambda: float) -> Tensor:
    """Generalized advantage estimates (T, W) (arXiv 1506.02438, equation 16).

    An episode that ends by time goes on as far as its value is concerned: only ``terminated`` takes away
    ``next_values``. Nothing of the next episode enters.
    """
    follow = outcomes.next_values * (~outcomes.terminated)
    errors = outcomes.rewards + gamma * follow - outcomes.values
    carried = torch.zeros_like(errors[0])
    found = torch.empty_like(errors)
    for t in range(len(errors) - 1, -1, -1):
        carried = errors[t] + gamma * gae_lambda * (~outcomes.ended[t]) * carried
        found[t] = carried
    return found


def finite_horizon_advantages(outcomes: Outcomes, gamma: float, gae_lambda: float) -> Tensor:
    """Advantages (T, W) as the original computes them (``finite_horizon_gae`` in mshab/train_ppo.py).

    The returns of 1, 2, ... steps up to the end of the rollout or of the episode are averaged with weights lambda^k
    that sum to 1, where GAE gives the last of them all the weight of the infinitely many that would follow.
    """
    found = torch.empty_like(outcomes.rewards)
    weights = torch.zeros_like(outcomes.rewards[0])
    rewards = torch.zeros_like(weights)
    values = torch.zeros_like(weights)
    follow = outcomes.next_values * (~outcomes.terminated)
    for t in range(len(found) - 1, -1, -1):
        goes_on = ~outcomes.ended[t]
        weights = 1.0 + gae_lambda * weights * goes_on
        rewards = gae_lambda * gamma * rewards * goes_on + weights * outcomes.rewards[t]
        values = gae_lambda * gamma * values * goes_on + gamma * follow[t]
        found[t] = (rewards + values) / weights - outcomes.values[t]
    return found
