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
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.heads import make_student
from mjhab.learning.students.student import Student

LEAST_STD = 0.02
MOST_STD = 1.0
"""Of the actions [share of full scale]."""
RATE_STEP = 1.5
LEAST_RATE = 1e-5
MOST_RATE = 3e-3
"""Steps and limits of a learning rate that follows the divergence (as in rsl_rl and rl_games)."""
VALUED_ROWS = 1024
"""Observations that the critic values at a time outside of updates: images take much memory."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """T control steps of W worlds, as N = T x W rows: what was seen and done, and how it turned out.

    stds (N, A): standard deviations of the actions.
    """

    seen: Seen
    actions: Tensor
    log_probabilities: Tensor
    stds: Tensor
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
        actor = start or make_student(config.student, layout, seed)
        assert isinstance(actor, BehaviourCloning)
        self.actor = actor
        self.keeps_normalization = start is not None
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed + 1)
            if start is None:
                _act_little(self.actor)
            self.value = Value(config.student, layout, privileged)
            width = self.actor.trunk.width if self.config.state_std else 0
            self.spread = Spread(width, len(layout.actions), self.config.initial_std)

    def acting_parameters(self) -> list[nn.Parameter]:
        """Parameters of the actor and of the spread of its actions."""
        return [*self.actor.parameters(), *self.spread.parameters()]

    def mean(self, seen: Seen) -> Tensor:
        """Means (B, A) of the actions."""
        return self.distribution(seen).mean

    def distribution(self, seen: Seen) -> Actions:
        """How the actions are distributed."""
        features = self.actor.trunk(seen.vector, seen.images)
        mean = self.actor.chunk_of(features)[:, 0]
        return Actions(mean, self.spread(features).expand_as(mean))


@dataclass(frozen=True, eq=False)
class Actions:
    """Normal distributions of actions: mean (B, A), logarithm of the standard deviation (B, A)."""

    mean: Tensor
    log_std: Tensor

    def sample(self, random: torch.Generator) -> Tensor:
        """Draw actions (B, A)."""
        noise = torch.randn(self.mean.shape, generator=random).to(self.mean.device)
        return self.mean + self.log_std.exp() * noise

    def log_probability(self, actions: Tensor) -> Tensor:
        """Logarithm of the density of actions (B, A), (B,)."""
        distance = (actions - self.mean) / self.log_std.exp()
        density = -0.5 * distance**2 - self.log_std - 0.5 * math.log(2.0 * math.pi)
        return density.sum(dim=1)


class Spread(nn.Module):
    """Logarithm of the standard deviation of the actions [share of full scale].

    Args:
        features: numbers that it depends on, then it stays between LEAST_STD and MOST_STD; 0 for one number per part of
            an action, the same everywhere and without limits, as in the original.
        actions: numbers of an action. initial_std: before anything is learned.
    """

    def __init__(self, features: int, actions: int, initial_std: float) -> None:
        super().__init__()
        self._low = math.log(LEAST_STD)
        self._half = 0.5 * (math.log(MOST_STD) - self._low)
        begin = math.log(initial_std)
        if features:
            begin = math.atanh((begin - self._low) / self._half - 1.0)
        self.bias = nn.Parameter(torch.full((actions,), begin))
        self.weight = nn.Parameter(torch.zeros(actions, features)) if features else None

    def forward(self, features: Tensor) -> Tensor:
        """(B, A) for features (B, F); (A,) if it depends on nothing."""
        if self.weight is None:
            return self.bias
        raw = nn.functional.linear(features, self.weight, self.bias)
        return self._low + self._half * (torch.tanh(raw) + 1.0)


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
        self.learning_rate = self.config.learning_rate
        self.optimizer = torch.optim.Adam(
            agent.parameters(), lr=self.learning_rate, eps=self.config.adam_epsilon, fused=True
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
        stds: list[Tensor] = []
        transitions: list[Transition] = []
        with torch.no_grad():
            for _ in range(self.config.rollout_steps):
                seen = self.worlds.seen
                drawn = agent.distribution(seen)
                action = drawn.sample(random)
                rows.append(seen)
                actions.append(action)
                densities.append(drawn.log_probability(action))
                stds.append(drawn.log_std.exp())
                transitions.append(self.worlds.step(action))
        seen = _joined(rows)
        outcomes = self._outcomes(seen, transitions)
        estimate = finite_horizon_advantages if self.config.finite_horizon else advantages
        gains = estimate(outcomes, self.config.gamma, self.config.gae_lambda)
        rollout = Rollout(
            seen,
            torch.cat(actions),
            torch.cat(densities),
            torch.cat(stds),
            gains.flatten(),
            (gains + outcomes.values).flatten(),
        )
        return rollout, transitions

    @torch.no_grad()
    def _outcomes(self, seen: Seen, transitions: list[Transition]) -> Outcomes:
        """What the rollout brought, with values.

        The observation after a step is that before the next one, but where an episode or the rollout ends: only these
        are valued apart.
        """
        ended = torch.stack([t.ended for t in transitions])
        apart = ended.clone()
        apart[-1] = True
        last = [t.next_seen.rows(mask) for t, mask in zip(transitions, apart, strict=True)]
        values = self._values(seen).view(ended.shape)
        next_values = torch.empty_like(values)
        next_values[:-1] = values[1:]
        next_values[apart] = self._values(_joined(last))
        return Outcomes(
            torch.stack([t.reward for t in transitions]),
            values,
            next_values,
            torch.stack([t.terminated for t in transitions]),
            ended,
        )

    def _values(self, seen: Seen) -> Tensor:
        """Values (N,) of N rows, a part of them at a time."""
        count = len(seen.vector)
        parts = [slice(start, start + VALUED_ROWS) for start in range(0, count, VALUED_ROWS)]
        return torch.cat([self.agent.value(seen.rows(part)) for part in parts])

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
        self.agent.train()
        random = self._random("shuffle")
        count = len(rollout.actions)
        size = count // config.minibatches
        told: list[tuple[float, float, float]] = []
        for _ in range(config.epochs):
            for group in self.optimizer.param_groups:
                group["lr"] = self.learning_rate * share
            order = torch.randperm(count, generator=random).to(rollout.actions.device)
            for start in range(0, count, size):
                told.append(self._minibatch(rollout, order[start : start + size]))
            # Minibatches of an epoch are finished, so that all processes stop after the same one.
            divergence = torch.tensor(sum(row[2] for row in told[-config.minibatches :]))
            divergence /= config.minibatches
            distributed.average([divergence])
            self._adapt(float(divergence))
            if config.target_kl and float(divergence) > config.target_kl:
                break
        self.updates += 1
        means = torch.tensor(told).mean(dim=0).tolist()
        return dict(zip(("policy_loss", "value_loss", "kl"), means, strict=True)) | {
            "action_std": float(rollout.stds.mean()),
            "learning_rate": self.learning_rate,
        }

    def _adapt(self, divergence: float) -> None:
        """Change the learning rate so that an epoch changes the policy by about ``desired_kl``."""
        wanted = self.config.desired_kl
        if not wanted:
            return
        if divergence > 2.0 * wanted:
            self.learning_rate /= RATE_STEP
        elif divergence < 0.5 * wanted:
            self.learning_rate *= RATE_STEP
        self.learning_rate = min(max(self.learning_rate, LEAST_RATE), MOST_RATE)

    def _minibatch(self, rollout: Rollout, rows: Tensor) -> tuple[float, float, float]:
        config = self.config
        agent = self.agent
        seen = rollout.seen.rows(rows)
        drawn = agent.distribution(seen)
        density = drawn.log_probability(rollout.actions[rows])
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
            loss = loss - config.entropy_coefficient * drawn.log_std.sum(dim=1).mean()
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
