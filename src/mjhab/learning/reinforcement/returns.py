"""Advantages of a rollout; episodes that end by the time limit are bootstrapped with the value of their last state."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Rewards, values and episode ends of T control steps of W worlds; all arrays are (T, W).

    values: of the observation before each step. next_values: of the observation after it; at the end of an episode
    this is its last observation, not the first one of the next episode. terminated: the episode ended by success or
    failure. ended: the episode terminated or reached its time limit.
    """

    rewards: Tensor
    values: Tensor
    next_values: Tensor
    terminated: Tensor
    ended: Tensor


def advantages(outcomes: Outcomes, gamma: float, gae_lambda: float) -> Tensor:
    """Generalized advantage estimates (T, W) (arXiv 1506.02438, equation 16).

    An episode that ends by the time limit is bootstrapped with ``next_values``; only ``terminated`` sets the following
    value to zero. The next episode has no influence.
    """
    follow = outcomes.next_values * (~outcomes.terminated)
    errors = outcomes.rewards + gamma * follow - outcomes.values
    carried = torch.zeros_like(errors[0])
    found = torch.empty_like(errors)
    for t in range(len(errors) - 1, -1, -1):
        carried = errors[t] + gamma * gae_lambda * (~outcomes.ended[t]) * carried
        found[t] = carried
    return found


def finite_horizon_advantages(
    outcomes: Outcomes, gamma: float, gae_lambda: float
) -> Tensor:
    """Advantages (T, W) as MS-HAB computes them (``finite_horizon_gae`` in mshab/train_ppo.py).

    They average the k-step returns, for k = 1, 2, ... up to the end of the rollout or of the episode, with weights
    proportional to lambda^k. GAE differs in the last of them, which gets the weight of all longer returns.
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
