"""Proximal policy optimization: the update of actor and value from one rollout (Schulman et al., arXiv 1707.06347)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mjhab.core.seeding import stream
from mjhab.learning.layout import Layout
from mjhab.learning.networks import Normalizer
from mjhab.learning.reinforcement import distributed
from mjhab.learning.reinforcement.configs import PpoConfig, ReinforcementConfig
from mjhab.learning.reinforcement.networks import Value
from mjhab.learning.reinforcement.returns import (
    Outcomes,
    advantages,
    finite_horizon_advantages,
)
from mjhab.learning.reinforcement.running import RunningStatistics
from mjhab.learning.reinforcement.sight import Seen
from mjhab.learning.reinforcement.worlds import Transition, Worlds
from mjhab.learning.runs.training import BrokenLossError
from mjhab.learning.students.heads import make_student
from mjhab.learning.students.student import Student


@dataclass(frozen=True, eq=False)
class Rollout:
    """T control steps of W worlds, as N = T x W rows: what was seen and done, and how it turned out."""

    seen: Seen
    actions: Tensor
    log_probabilities: Tensor
    advantages: Tensor
    returns: Tensor


class Ppo(nn.Module):
    """An actor whose actions spread around what a student would do, and a critic.

    Args:
        config: of the whole run. layout: what the actor sees and does. privileged: numbers that only the critic sees.
        seed: of the weights. start: a student that the actor begins from; it acts by the first action of its chunk.
    """

    def __init__(
        self,
        config: ReinforcementConfig,
        layout: Layout,
        privileged: int,
        seed: int,
        start: Student | None = None,
    ) -> None:
        super().__init__()
        assert config.ppo is not None
        self.config: PpoConfig = config.ppo
        self.actor = start or make_student(config.student, layout, seed)
        self.keeps_normalization = start is not None
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed + 1)
            if start is None:
                _act_little(self.actor)
            self.value = Value(config.student, layout, privileged)
        self.log_std = nn.Parameter(
            torch.full((len(layout.actions),), math.log(self.config.initial_std))
        )

    def acting_parameters(self) -> list[nn.Parameter]:
        """Parameters of the actor and of the spread of its actions."""
        return [*self.actor.parameters(), self.log_std]

    def mean(self, seen: Seen) -> Tensor:
        """Means (B, A) of the actions."""
        nothing = torch.zeros(0, device=seen.vector.device)
        return self.actor.chunk(seen.vector, seen.images, nothing)[:, 0]

    def log_probability(self, mean: Tensor, actions: Tensor) -> Tensor:
        """Logarithm of the density of actions (B, A) around means, (B,)."""
        distance = (actions - mean) / self.log_std.exp()
        density = -0.5 * distance**2 - self.log_std - 0.5 * math.log(2.0 * math.pi)
        return density.sum(dim=1)


def _act_little(actor: Student) -> None:
    """Let a new actor begin near zero actions."""
    head = getattr(actor, "head", None)
    if isinstance(head, nn.Linear):
        nn.init.orthogonal_(head.weight, 0.01)
        nn.init.zeros_(head.bias)


class PpoLearner:
    """Collects rollouts and updates an agent. Everything drawn is a function of (seed, update) alone.

    Args:
        agent: on the device of the worlds. worlds: to act in. config: of the whole run. seed: of this process.
    """

    def __init__(self, agent: Ppo, worlds: Worlds, config: ReinforcementConfig, seed: int) -> None:
        assert config.ppo is not None
        self.agent = agent
        self.worlds = worlds
        self.run = config
        self.config = config.ppo
        self.seed = seed
        self.updates = 0
        self.optimizer = torch.optim.Adam(
            agent.parameters(), lr=self.config.learning_rate, eps=self.config.adam_epsilon
        )
        device = worlds.device
        seen = worlds.seen
        self.statistics = RunningStatistics(agent.actor.layout.width, device)
        self.privileged = RunningStatistics(seen.privileged.shape[1], device)

    # -- acting -------------------------------------------------------------------------------------------------------

    def collect(self) -> tuple[Rollout, list[Transition]]:
        """Act for ``rollout_steps`` control steps in every world."""
        agent = self.agent.eval()
        random = self._random("act")
        rows: list[Seen] = []
        actions: list[Tensor] = []
        densities: list[Tensor] = []
        values: list[Tensor] = []
        next_values: list[Tensor] = []
        transitions: list[Transition] = []
        with torch.no_grad():
            for _ in range(self.config.rollout_steps):
                seen = self.worlds.seen
                mean = agent.mean(seen)
                noise = torch.randn(mean.shape, generator=random).to(mean.device)
                action = mean + agent.log_std.exp() * noise
                transition = self.worlds.step(action)
                rows.append(seen)
                actions.append(action)
                densities.append(agent.log_probability(mean, action))
                values.append(agent.value(seen))
                next_values.append(agent.value(transition.next_seen))
                transitions.append(transition)
        outcomes = Outcomes(
            torch.stack([t.reward for t in transitions]),
            torch.stack(values),
            torch.stack(next_values),
            torch.stack([t.terminated for t in transitions]),
            torch.stack([t.ended for t in transitions]),
        )
        estimate = finite_horizon_advantages if self.config.finite_horizon else advantages
        gains = estimate(outcomes, self.config.gamma, self.config.gae_lambda)
        rollout = Rollout(
            _joined(rows),
            torch.cat(actions),
            torch.cat(densities),
            gains.flatten(),
            (gains + outcomes.values).flatten(),
        )
        return rollout, transitions

    def _random(self, what: str) -> torch.Generator:
        drawn = stream(self.seed, f"ppo-{what}", self.updates).integers(1 << 62)
        return torch.Generator().manual_seed(int(drawn))

    # -- learning -----------------------------------------------------------------------------------------------------

    def update(self, rollout: Rollout, progress: float) -> dict[str, float]:
        """Learn from a rollout; ``progress``: share of all samples that were made.

        Raises:
            BrokenLossError: the loss is not finite.
        """
        config = self.config
        share = 1.0 - (1.0 - config.learning_rate_end) * progress
        for group in self.optimizer.param_groups:
            group["lr"] = config.learning_rate * share
        self.agent.train()
        random = self._random("shuffle")
        count = len(rollout.actions)
        size = count // config.minibatches
        told: list[tuple[float, float, float]] = []
        for _ in range(config.epochs):
            order = torch.randperm(count, generator=random).to(rollout.actions.device)
            for start in range(0, count, size):
                told.append(self._minibatch(rollout, order[start : start + size]))
            # Minibatches of an epoch are finished, so that all processes stop after the same one.
            divergence = torch.tensor(sum(row[2] for row in told[-config.minibatches :]))
            divergence /= config.minibatches
            distributed.average([divergence])
            if config.target_kl and float(divergence) > config.target_kl:
                break
        self.updates += 1
        means = torch.tensor(told).mean(dim=0).tolist()
        return dict(zip(("policy_loss", "value_loss", "kl"), means, strict=True)) | {
            "action_std": float(self.agent.log_std.detach().exp().mean())
        }

    def _minibatch(self, rollout: Rollout, rows: Tensor) -> tuple[float, float, float]:
        config = self.config
        agent = self.agent
        seen = rollout.seen.rows(rows)
        density = agent.log_probability(agent.mean(seen), rollout.actions[rows])
        logarithm = density - rollout.log_probabilities[rows]
        ratio = logarithm.exp()
        gains = rollout.advantages[rows]
        mean, spread = distributed.mean_and_spread(gains)
        gains = (gains - mean) / (spread + 1e-8)
        clipped = ratio.clamp(1.0 - config.clip, 1.0 + config.clip)
        policy_loss = -torch.minimum(gains * ratio, gains * clipped).mean()
        value_loss = 0.5 * ((agent.value(seen) - rollout.returns[rows]) ** 2).mean()
        loss = config.value_coefficient * value_loss
        if self.updates >= config.critic_updates:
            loss = loss + policy_loss
        if config.entropy_coefficient:
            loss = loss - config.entropy_coefficient * agent.log_std.sum()
        if not math.isfinite(float(loss.detach())):
            raise BrokenLossError(
                f"the loss became {float(loss.detach())} in update {self.updates + 1}. The last good checkpoint is "
                "kept; a smaller learning rate may help."
            )
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        parameters = list(agent.parameters())
        distributed.average_gradients(parameters)
        # Apart: the critic's gradients are larger, and would leave the actor little of one common limit.
        nn.utils.clip_grad_norm_(agent.acting_parameters(), config.clip_norm)
        nn.utils.clip_grad_norm_(agent.value.parameters(), config.clip_norm)
        self.optimizer.step()
        with torch.no_grad():
            divergence = ((ratio - 1.0) - logarithm).mean()
        return float(policy_loss.detach()), float(value_loss.detach()), float(divergence)

    def normalize(self, seen: Seen) -> None:
        """Take what was seen into the statistics that inputs are normalized by, if the config says so."""
        if not self.run.inputs.normalize:
            return
        layout = self.agent.actor.layout
        value = self.agent.value
        normalizers: list[Normalizer] = [value.encoder.normalizer, value.privileged]
        if not self.agent.keeps_normalization:
            normalizers.append(self.agent.actor.normalizer)
        # Of a history the newest observation says enough.
        self.statistics.add(seen.vector[:, -layout.width :])
        self.statistics.fit(
            [part for part in normalizers if part is not value.privileged], layout.measured_width
        )
        if seen.privileged.shape[1]:
            self.privileged.add(seen.privileged)
            self.privileged.fit([value.privileged], seen.privileged.shape[1])
        distributed.average([part.mean for part in normalizers])
        distributed.average([part.scale for part in normalizers])


def _joined(rows: list[Seen]) -> Seen:
    return Seen(
        torch.cat([row.vector for row in rows]),
        torch.cat([row.images for row in rows]),
        torch.cat([row.privileged for row in rows]),
    )
