"""Stepping and resetting the worlds of a training environment, with the true last observation of each episode."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mjhab.core.errors import wrong_value
from mjhab.core.seeding import stream
from mjhab.learning.reinforcement.agent_encoder import AgentEncoder, AgentObs


@dataclass(frozen=True, eq=False)
class Transition:
    """Result of one control step in W worlds.

    reward (W,). next_seen: observation after the step; at the end of an episode, its last observation.
    terminated (W,) bool: the episode ended by success or failure. ended (W,) bool: it terminated or reached its time
    limit. succeeded (W,) bool: the episode has been in success at least once.
    """

    reward: Tensor
    next_seen: AgentObs
    terminated: Tensor
    ended: Tensor
    succeeded: Tensor


@dataclass(frozen=True)
class TrainingRules:
    """Rules of training episodes in addition to those of the environment.

    longest_first: the first episode of each world is truncated after a random number of control steps from 1 to this
    value, so that the worlds do not reset in the same step; 0 disables this.
    force_limit: on the cumulative force [N x control steps]. force_ends: an episode terminates when it exceeds the
    limit. force_cost: total reward subtracted over an episode whose cumulative force reaches the limit.
    success_ends: an episode terminates at its first success.
    paid_steps: the reward of the environment is paid in the last so many control steps of an episode; 0 for all.
    conditions: boolean keys of ``info`` whose frequency ``Worlds.held`` reports.
    """

    longest_first: int = 0
    force_limit: float = math.inf
    force_ends: bool = False
    force_cost: float = 0.0
    success_ends: bool = False
    paid_steps: int = 0
    conditions: tuple[str, ...] = ()

    def apply(
        self, reward: Tensor, terminated: Tensor, info: Mapping[str, Any]
    ) -> tuple[Tensor, Tensor]:
        """Reward and termination (W,) of a control step under these rules, from those of the environment."""
        if self.force_ends:
            exceeded = torch.as_tensor(info["cumulative_force"]) > self.force_limit
            terminated = terminated | exceeded
        if self.success_ends:
            terminated = terminated | torch.as_tensor(info["success"])
        if self.paid_steps:
            late = torch.as_tensor(info["steps_left"]) < self.paid_steps
            reward = reward * late
        if self.force_cost:
            share = torch.as_tensor(info["robot_force"]).float() / self.force_limit
            reward = reward - self.force_cost * share
        return reward, terminated


class Worlds:
    """The worlds of an environment with ``autoreset="disabled"``; this class resets the finished ones itself.

    So it can read the last observation of an episode, including the privileged inputs, to bootstrap the value. An
    environment that resets by itself returns only ``info["final_obs"]``.

    Args:
        env: environment of either backend, a `TaskLoop` or what steps like one. encoder: of the same environment.
        seed: of the first episodes. rules: additional rules of training episodes; none if not given.

    Raises:
        UsageError: the environment resets its worlds by itself.
    """

    def __init__(
        self,
        env: Any,
        encoder: AgentEncoder,
        seed: int,
        rules: TrainingRules | None = None,
    ) -> None:
        if env.config.autoreset != "disabled":
            raise wrong_value(
                "autoreset",
                env.config.autoreset,
                "'disabled': reinforcement learning resets the worlds itself",
            )
        self.env = env
        self.encoder = encoder
        self.count: int = env.num_envs
        self.device = encoder.device
        """Device of the networks, and of all that this class takes and returns."""
        at = encoder.env_device
        self.rules = rules or TrainingRules()
        self._holding = torch.zeros(len(self.rules.conditions), device=at)
        self._steps = 0
        self.seconds = 0.0
        """Wall time spent in the environment and in converting its observations [s]."""
        self._none = torch.zeros(self.count, dtype=torch.bool, device=at)
        self._succeeded = self._none
        self.seen: AgentObs = self.begin(seed)

    def begin(self, seed: int) -> AgentObs:
        """Start new episodes in all worlds; they depend on ``seed`` only.

        On the device they are starts of the environment's one pool that ``seed`` draws: to make another pool, as a
        reset with a seed does, takes longer than the training until the next checkpoint.
        """
        began = time.perf_counter()
        seen = self._begin(seed)
        self.seconds += time.perf_counter() - began
        return seen

    def _begin(self, seed: int) -> AgentObs:
        if not self._numpy:
            self.env.draw_starts(seed)
        obs, info = self.env.reset(seed=seed if self._numpy else None)
        every = ~self._none
        self._succeeded = self._none
        longest = self.rules.longest_first
        if longest:
            # Worlds that began together would end together, and all rollouts show the same part of an episode.
            drawn = stream(seed, "stagger").integers(1, longest + 1, self.count)
            self._left = torch.from_numpy(drawn).to(self._none.device)
        self.encoder.begin(every)
        self.seen = self.encoder.see(obs, info)
        return self.seen

    def step(self, actions: Tensor) -> Transition:
        """Take one control step, then reset the worlds whose episodes ended; ``seen`` holds the observations after."""
        began = time.perf_counter()
        transition = self._step(actions)
        self.seconds += time.perf_counter() - began
        return transition

    def _step(self, actions: Tensor) -> Transition:
        # The policy is told what was executed, which the environment would clip as well.
        taken = actions.clamp(-1.0, 1.0).to(self._none.device)
        given = taken.numpy() if self._numpy else taken
        obs, reward, terminated, truncated, info = self.env.step(given)
        rules = self.rules
        reward, terminated = rules.apply(
            torch.as_tensor(reward).float(), torch.as_tensor(terminated), info
        )
        ended = terminated | torch.as_tensor(truncated)
        if rules.longest_first:
            # It falls below 0 later, and equals 0 only once: this ends the first episode of a world alone.
            self._left -= 1
            ended = ended | (self._left == 0)
        self._count(info)
        succeeded = self._succeeded | torch.as_tensor(info["success"])
        self.encoder.executed(taken)
        # Before the reset: this is the last observation of the episodes that ended.
        following = self.encoder.see(obs, info)
        self.seen = following
        if bool(ended.any()):
            # All finished worlds at once: a reset costs the same for one and for many on a device.
            obs, info = self.env.reset(options={"reset_mask": self._mask(ended)})
            self.encoder.begin(ended)
            # The other worlds are seen twice in this step, and their histories must not move twice.
            self.seen = self.encoder.see(obs, info, again=True)
        self._succeeded = succeeded & ~ended
        return Transition(
            reward.to(self.device),
            following,
            terminated.to(self.device),
            ended.to(self.device),
            succeeded.to(self.device),
        )

    def _count(self, info: Mapping[str, Any]) -> None:
        for number, name in enumerate(self.rules.conditions):
            self._holding[number] += torch.as_tensor(info[name]).float().mean()
        self._steps += 1

    def held(self) -> dict[str, float]:
        """Fraction of the control steps since the last call in which each condition held, mean over the worlds."""
        shares = (self._holding / max(self._steps, 1)).tolist()
        self._holding.zero_()
        self._steps = 0
        return dict(zip(self.rules.conditions, shares, strict=True))

    @property
    def _numpy(self) -> bool:
        return isinstance(self.env.state.robot_q, np.ndarray)

    def _mask(self, ended: Tensor) -> Any:
        return ended.numpy() if self._numpy else ended
