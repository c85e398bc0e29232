"""What a rollout of PPO holds, and the values of its observations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from mjhab.learning.reinforcement.agent_encoder import AgentObs
from mjhab.learning.reinforcement.returns import Outcomes
from mjhab.learning.reinforcement.worlds import Transition

VALUED_ROWS = 1024
"""Batch size of the critic outside of updates; it bounds the memory that images take."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """T control steps of W worlds, flattened to N = T x W rows.

    seen: observations. actions (N, A). log_probabilities (N,): of the actions under the policy that took them.
    stds (N, A): standard deviations of that policy. advantages (N,). returns (N,): targets of the critic.
    encoded (N, F): observations as the actor's encoder sees them, None if the encoder is trained.
    """

    seen: AgentObs
    actions: Tensor
    log_probabilities: Tensor
    stds: Tensor
    advantages: Tensor
    returns: Tensor
    encoded: Tensor | None = None


@torch.no_grad()
def outcomes_of(
    critic: Callable[[AgentObs], Tensor], seen: AgentObs, transitions: list[Transition]
) -> Outcomes:
    """Rewards, values and episode ends of a rollout.

    The observation after a step is the one before the next step, except where an episode or the rollout ends: only
    there the critic evaluates ``next_seen`` separately.

    Args:
        critic: values (B,) of B observations.
        seen: observations before the steps, T x W rows.
        transitions: of the T control steps.
    """
    ended = torch.stack([t.ended for t in transitions])
    is_last = ended.clone()
    is_last[-1] = True
    last = [t.next_seen.rows(mask) for t, mask in zip(transitions, is_last, strict=True)]
    values = _values(critic, seen).view(ended.shape)
    next_values = torch.empty_like(values)
    # Values are computed once for each observation, as the one after a step is the one before the next.
    next_values[:-1] = values[1:]
    next_values[is_last] = _values(critic, AgentObs.join(last))
    return Outcomes(
        torch.stack([t.reward for t in transitions]),
        values,
        next_values,
        torch.stack([t.terminated for t in transitions]),
        ended,
    )


def _values(critic: Callable[[AgentObs], Tensor], seen: AgentObs) -> Tensor:
    """Values (N,) of N observations, computed in batches of VALUED_ROWS."""
    count = len(seen.vector)
    starts = range(0, count, VALUED_ROWS)
    return torch.cat(
        [critic(seen.rows(slice(start, start + VALUED_ROWS))) for start in starts]
    )
