"""Rollouts of PPO, and the update of actor and value from one."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait

import torch
from torch import Tensor, nn

from mjhab.core.arithmetic.sums import ordered_sum
from mjhab.learning.devices import generator, reduced
from mjhab.learning.networks import Normalizer
from mjhab.learning.reinforcement.agent_encoder import AgentObs
from mjhab.learning.reinforcement.configs import ReinforcementConfig
from mjhab.learning.reinforcement.finite import check_finite
from mjhab.learning.reinforcement.ppo.agent import Ppo
from mjhab.learning.reinforcement.ppo.rate import adapted_rate
from mjhab.learning.reinforcement.ppo.rollout import Rollout, outcomes_of
from mjhab.learning.reinforcement.replay import ReplayBuffer
from mjhab.learning.reinforcement.returns import (
    advantages,
    finite_horizon_advantages,
)
from mjhab.learning.reinforcement.running import RunningStatistics
from mjhab.learning.reinforcement.worlds import Transition, Worlds
from mjhab.learning.runs import distributed

IMITATION_RATE = 1e-3
"""Learning rate at the start of imitation; it falls to zero."""
IMITATION_HUBER = 0.5
"""Width of the quadratic part of the imitation loss [action units]."""
NORMALIZED_ROWS = 8192
"""Demonstrated observations from which the inputs' mean and std are estimated."""


class PpoLearner:
    """Collects rollouts and updates an agent. All random draws depend on (seed, number of the update) only.

    Args:
        agent: on the device of the worlds. worlds: where the agent acts. config: of the whole run.
        seed: of this process. shown: demonstrations to imitate, if any.
        threads: with more than one, an update computes the gradients of actor and critic at the same time. They share
            no weights, so that the results have the same bits.
    """

    def __init__(
        self,
        agent: Ppo,
        worlds: Worlds,
        config: ReinforcementConfig,
        seed: int,
        shown: ReplayBuffer | None = None,
        threads: int = 1,
    ) -> None:
        assert config.ppo is not None
        self.agent = agent
        self.worlds = worlds
        self.run = config
        self.config = config.ppo
        self.seed = seed
        self.shown = shown
        self.updates = 0
        self.learning_rate = self.config.learning_rate
        self.optimizer = torch.optim.Adam(
            [{"params": agent.acting_parameters()}, {"params": agent.value.parameters()}],
            lr=self.learning_rate,
            eps=self.config.adam_epsilon,
            fused=True,
        )
        self._beside = ThreadPoolExecutor(1, "critic") if threads > 1 else None
        device = worlds.device
        seen = worlds.seen
        self.statistics = RunningStatistics(agent.actor.layout.width, device)
        self.privileged = RunningStatistics(seen.privileged.shape[1], device)

    # -- acting -------------------------------------------------------------------------------------------------------

    def collect(self, tell: Callable[[Transition], object] = bool) -> Rollout:
        """Act for ``rollout_steps`` control steps in every world; ``tell`` gets the transition of each."""
        agent = self.agent.eval()
        random = self._random("act")
        rows: list[AgentObs] = []
        actions: list[Tensor] = []
        densities: list[Tensor] = []
        stds: list[Tensor] = []
        encoded: list[Tensor] = []
        transitions: list[Transition] = []
        with torch.no_grad():
            for _ in range(self.config.rollout_steps):
                seen = self.worlds.seen
                # Kept, because a frozen encoder gives the same for the update.
                encoded.append(agent.encoded(seen))
                drawn = agent.distribution_of(encoded[-1])
                action = drawn.sample(random)
                rows.append(seen)
                actions.append(action)
                densities.append(drawn.log_probability(action))
                stds.append(drawn.log_std.exp())
                transitions.append(self.worlds.step(action))
                tell(transitions[-1])
        seen = AgentObs.join(rows)
        outcomes = outcomes_of(self._value, seen, transitions)
        estimate = finite_horizon_advantages if self.config.finite_horizon else advantages
        gains = estimate(outcomes, self.config.gamma, self.config.gae_lambda)
        return Rollout(
            seen,
            torch.cat(actions),
            torch.cat(densities),
            torch.cat(stds),
            gains.flatten(),
            (gains + outcomes.values).flatten(),
            torch.cat(encoded) if self.config.freeze_encoder else None,
        )

    def _value(self, seen: AgentObs) -> Tensor:
        """Values (B,) in float32, computed in the precision of the run."""
        with reduced(self.run.network.precision, seen.vector.device):
            return self.agent.value(seen).float()

    def _random(self, what: str) -> torch.Generator:
        # Named by the update, so that a resumed run draws as one that went on.
        return generator(self.seed, f"ppo-{what}", self.updates)

    # -- learning -----------------------------------------------------------------------------------------------------

    def imitate(self, tell: Callable[[], object] = bool) -> float:
        """Let the actor imitate the demonstrations, for ``imitation_updates``; returns the loss of the last one.

        ``tell`` is called after every update; what it raises ends the imitation.
        """
        assert self.shown is not None
        agent = self.agent
        random = self._random("imitate")
        if self.run.inputs.normalize:
            self.normalize(self.shown.draw(NORMALIZED_ROWS, random).seen)
            normalizer = agent.actor.normalizer
            self.statistics.fit([normalizer], agent.actor.layout.measured_width)
            # Each process has its own demonstrations; their networks must stay the same.
            distributed.average([normalizer.mean, normalizer.scale])
        updates = self.config.imitation_updates
        parameters = list(agent.actor.parameters())
        # An optimizer of its own: the moments of imitation would steer the first updates of PPO.
        optimizer = torch.optim.Adam(parameters, lr=IMITATION_RATE, fused=True)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, max(updates, 1))
        loss = torch.zeros(())
        for _ in range(updates):
            loss = self._imitation_loss(random)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            distributed.average_gradients(parameters)
            optimizer.step()
            schedule.step()
            tell()
        return float(loss.detach())

    def _imitation_loss(self, random: torch.Generator) -> Tensor:
        """Mean Huber loss between the means of the actions and demonstrated ones."""
        assert self.shown is not None
        batch = self.shown.draw(self.config.imitation_batch, random)
        # What lies outside is clipped when executed, so that the mean need not follow it.
        with reduced(self.run.network.precision, batch.actions.device):
            mean = self.agent.mean(batch.seen)
        error = mean - batch.actions.clamp(-1.0, 1.0)
        return nn.functional.huber_loss(
            error, torch.zeros_like(error), delta=IMITATION_HUBER
        )

    def update(self, rollout: Rollout, progress: float) -> dict[str, float]:
        """Update the agent from a rollout; returns the metrics to report.

        ``progress`` is the fraction of the run's samples collected so far; it sets the learning rate.

        Raises:
            BrokenLossError: the loss or the gradient is not finite.
        """
        config = self.config
        share = 1.0 - (1.0 - config.learning_rate_end) * progress
        self.agent.train()
        random = self._random("shuffle")
        count = len(rollout.actions)
        size = count // config.minibatches
        measured: list[tuple[float, float, float]] = []
        stopped = False
        for _ in range(config.epochs):
            acting, valuing = self.optimizer.param_groups
            acting["lr"] = self.learning_rate * share
            valuing["lr"] = (config.critic_learning_rate or self.learning_rate) * share
            # Drawn on the CPU, so that the order is the same on every device.
            order = torch.randperm(count, generator=random).to(rollout.actions.device)
            for start in range(0, count, size):
                row = self._minibatch(rollout, order[start : start + size], random)
                if row is None:
                    stopped = True
                    break
                measured.append(row)
            if stopped:
                break
            # The test comes after a whole epoch, so that all processes stop after the same minibatch.
            divergence = torch.tensor(
                ordered_sum(row[2] for row in measured[-config.minibatches :])
            )
            divergence /= config.minibatches
            distributed.average([divergence])
            # While only the critic learns the policy does not move, and the rate would rise without end.
            if self.updates >= config.critic_updates:
                self.learning_rate = adapted_rate(
                    self.learning_rate, float(divergence), config
                )
            if config.target_kl and float(divergence) > config.target_kl:
                break
        self.updates += 1
        means = torch.tensor(measured).mean(dim=0).tolist()
        return dict(zip(("policy_loss", "value_loss", "kl"), means, strict=True)) | {
            "action_std": float(rollout.stds.mean()),
            "learning_rate": self.learning_rate,
        }

    def _imitation_weight(self) -> float:
        """Weight of the imitation loss in this update."""
        config = self.config
        per_update = config.rollout_steps * self.worlds.count
        done = self.updates * per_update * distributed.processes()
        # Fades out: at last the reward alone should decide.
        left = max(0.0, 1.0 - done / max(config.imitation_samples, 1))
        return config.imitation_coefficient * left if self.shown is not None else 0.0

    def _minibatch(
        self, rollout: Rollout, rows: Tensor, random: torch.Generator
    ) -> tuple[float, float, float] | None:
        """Take one optimizer step; returns losses of policy and value and the KL divergence before it.

        None: the divergence exceeds ``target_kl``, and nothing was changed.
        """
        agent = self.agent
        seen = rollout.seen.rows(rows)
        # Before anything learns, in whichever thread.
        self.optimizer.zero_grad(set_to_none=True)
        critics = (seen, rollout.returns[rows])
        valued = self._beside and self._beside.submit(self._learn_values, *critics)
        try:
            acted = self._learn_to_act(rollout, rows, seen, random)
        finally:
            # Nothing may be computing any more when an update ends, also by an error.
            wait([valued] if valued else [])
        if acted is None:
            return None
        value_loss = valued.result() if valued else self._learn_values(*critics)
        parameters = list(agent.parameters())
        distributed.average_gradients(parameters)
        # The critic's gradients are larger, and under one joint limit they would scale the actor's down.
        parts = (
            [parameters]
            if self.config.clip_jointly
            else [list(agent.acting_parameters()), list(agent.value.parameters())]
        )
        for part in parts:
            norm = nn.utils.clip_grad_norm_(part, self.config.clip_norm)
            check_finite(float(norm), "the norm of the gradient", self.updates + 1)
        self.optimizer.step()
        policy_loss, divergence = acted
        return policy_loss, value_loss, divergence

    def _learn_to_act(
        self, rollout: Rollout, rows: Tensor, seen: AgentObs, random: torch.Generator
    ) -> tuple[float, float] | None:
        """Add the gradient of the actor's losses: of the policy, of imitation and of entropy.

        Returns:
            The loss of the policy, and the KL divergence from the policy that acted; None if that is too large.

        Raises:
            BrokenLossError: a loss is not finite.
        """
        config = self.config
        agent = self.agent
        encoded = (
            agent.encoded(seen) if rollout.encoded is None else rollout.encoded[rows]
        )
        drawn = agent.distribution_of(encoded)
        density = drawn.log_probability(rollout.actions[rows])
        logarithm = density - rollout.log_probabilities[rows]
        ratio = logarithm.exp()
        # An estimate with less variance than the mean logarithm, and never negative (Schulman, "Approximating KL
        # divergence").
        divergence = ((ratio - 1.0) - logarithm).mean().detach()
        if config.stop_in_epoch and config.target_kl:
            distributed.average([divergence])
            if float(divergence) > config.target_kl:
                return None
        gains = rollout.advantages[rows]
        mean, spread = distributed.mean_and_spread(gains)
        # Of a minibatch without any spread the advantages are 0, not nan.
        gains = (gains - mean) / (spread + 1e-8)
        clipped = ratio.clamp(1.0 - config.clip, 1.0 + config.clip)
        policy_loss = -torch.minimum(gains * ratio, gains * clipped).mean()
        losses: list[Tensor] = []
        # An untrained critic's advantages would spoil an actor that can act already.
        if self.updates >= config.critic_updates:
            losses.append(policy_loss)
            imitation = self._imitation_weight()
            if imitation:
                losses.append(imitation * self._imitation_loss(random))
        if config.entropy_coefficient:
            # The entropy of a normal distribution is its log std plus a constant.
            entropy = drawn.log_std.sum(dim=1).mean()
            losses.append(-config.entropy_coefficient * entropy)
        if losses:
            self._add_gradient(torch.stack(losses).sum())
        return float(policy_loss.detach()), float(divergence)

    def _learn_values(self, seen: AgentObs, returns: Tensor) -> float:
        """Add the gradient of the critic's loss, and return that loss.

        Raises:
            BrokenLossError: it is not finite.
        """
        loss = 0.5 * ((self._value(seen) - returns) ** 2).mean()
        self._add_gradient(self.config.value_coefficient * loss)
        return float(loss.detach())

    def _add_gradient(self, loss: Tensor) -> None:
        # Before the gradient, so that the weights are still good.
        check_finite(float(loss.detach()), "the loss", self.updates + 1)
        loss.backward()

    def normalize(self, seen: AgentObs) -> None:
        """Update the running mean and std of the input normalizers, if the config normalizes inputs."""
        if not self.run.inputs.normalize:
            return
        layout = self.agent.actor.layout
        value = self.agent.value
        normalizers: list[Normalizer] = [value.encoder.normalizer, value.privileged]
        if not self.agent.keeps_normalization:
            normalizers.append(self.agent.actor.normalizer)
        # The newest observation of a history suffices: the older ones were added before.
        self.statistics.add(seen.vector[:, -layout.width :])
        self.statistics.fit(
            [part for part in normalizers if part is not value.privileged],
            layout.measured_width,
        )
        if seen.privileged.shape[1]:
            self.privileged.add(seen.privileged)
            self.privileged.fit([value.privileged], seen.privileged.shape[1])
        distributed.average([part.mean for part in normalizers])
        distributed.average([part.scale for part in normalizers])
