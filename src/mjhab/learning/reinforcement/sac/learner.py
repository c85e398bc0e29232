"""Batches of SAC, and the update of actor and critics from one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from mjhab.learning.devices import generator
from mjhab.learning.reinforcement.agent_encoder import AgentObs
from mjhab.learning.reinforcement.configs import ReinforcementConfig, SacConfig
from mjhab.learning.reinforcement.finite import check_finite, gradient_norm
from mjhab.learning.reinforcement.replay import ReplayBuffer, Transitions
from mjhab.learning.reinforcement.sac.agent import Sac
from mjhab.learning.runs import distributed
from mjhab.learning.students.gaussian import LARGEST_ACTION


class SacLearner:
    """Updates an agent from replay buffers. Update k depends on the weights, the buffers, the seed and k only.

    Args:
        agent: on the device of the buffers. config: of the whole run. seed: of this process.
    """

    def __init__(self, agent: Sac, config: ReinforcementConfig, seed: int) -> None:
        assert config.sac is not None
        self.agent = agent
        self.config: SacConfig = config.sac
        self.seed = seed
        self.updates = 0
        actor = agent.actor
        acting = [*actor.trunk.layers.parameters(), *actor.mean.parameters()]
        acting += actor.log_std.parameters()
        self.judging = list(agent.judge.parameters())
        # What is shared learns from the critics' errors alone.
        shared = set(self.judging)
        acting += [p for p in actor.trunk.encoder.parameters() if p not in shared]
        rate = self.config.learning_rate
        betas = (self.config.adam_beta, 0.999)
        self.acting = acting
        self.optimizers = {
            "actor": torch.optim.Adam(acting, lr=rate, betas=betas),
            "judge": torch.optim.Adam(self.judging, lr=rate, betas=betas),
            "alpha": torch.optim.Adam([agent.log_alpha], lr=rate, betas=betas),
        }

    def random(self, what: str) -> torch.Generator:
        """Random generator of the current update for one purpose, named by ``what``."""
        return generator(self.seed, f"sac-{what}", self.updates)

    def batch(
        self, online: ReplayBuffer, demonstrations: ReplayBuffer | None
    ) -> Transitions:
        """Draw a batch: demonstrations first, if there are any, then transitions of the agent."""
        random = self.random("batch")
        count = self.config.batch
        if demonstrations is None:
            return online.draw(count, random)
        shown = round(self.config.demonstration_share * count)
        return _joined(
            demonstrations.draw(shown, random), online.draw(count - shown, random)
        )

    def update(
        self, batch: Transitions, demonstrated: int, imitation: float, frozen: bool
    ) -> dict[str, float]:
        """Update the critics and, at every ``policy_delay``-th call, the actor and the target critics.

        Args:
            batch: transitions; the first ``demonstrated`` rows are demonstrations.
            imitation: weight of the squared distance between the actor's and the demonstrated actions.
            frozen: train the actor by imitation only, because the critics are not trained yet.

        Returns:
            Metrics of the update by name.

        Raises:
            BrokenLossError: a loss or a gradient is not finite.
        """
        random = self.random("update")
        measured = {"critic_loss": self._judge(batch, random)}
        if self.updates % self.config.policy_delay == 0:
            measured |= self._act(batch, demonstrated, imitation, frozen, random)
            self._follow()
        self.updates += 1
        return measured

    def _judge(self, batch: Transitions, random: torch.Generator) -> float:
        agent = self.agent
        critics = agent.judge.critics
        # An episode that the time limit ended goes on in the value of its last state.
        goes_on = (~batch.terminated).float()
        with torch.no_grad():
            following = batch.next_seen
            features = agent.actor.features(following.vector, following.images)
            actions, density = agent.actor.sample(features, random)
            said = agent.target(following, actions)
            worth = agent.target.critics.values(said)
            entropy = agent.log_alpha.exp() * density
            # The whole distribution of the critic that expects least, so that it stays one distribution.
            least = worth.argmin(dim=0)
            if self.config.atoms:
                index = least[None, :, None].expand(1, -1, self.config.atoms)
                probabilities = said.softmax(dim=-1).gather(0, index)[0]
                value = critics.support[None] - entropy[:, None]
                returns = (
                    batch.reward[:, None] + self.config.gamma * goes_on[:, None] * value
                )
                wanted = critics.project(probabilities, returns)
            else:
                value = worth.min(dim=0).values - entropy
                wanted = batch.reward + self.config.gamma * goes_on * value
        said = agent.judge(batch.seen, batch.actions)
        if self.config.atoms:
            loss = (
                -(wanted[None] * said.log_softmax(dim=-1)).sum(dim=-1).mean(dim=1).sum()
            )
        else:
            loss = ((said[..., 0] - wanted[None]) ** 2).mean(dim=1).sum()
        self._step("judge", loss, self.judging)
        return float(loss.detach())

    def _act(
        self,
        batch: Transitions,
        demonstrated: int,
        imitation: float,
        frozen: bool,
        random: torch.Generator,
    ) -> dict[str, float]:
        agent = self.agent
        alpha = agent.log_alpha.exp()
        with _frozen(self.judging):
            features = agent.actor.features(batch.seen.vector, batch.seen.images)
            actions, density = agent.actor.sample(features, random)
            # A frozen actor may still imitate.
            loss = torch.zeros((), device=actions.device)
            if not frozen:
                worth = agent.judge.critics.values(agent.judge(batch.seen, actions))
                loss = (alpha.detach() * density - worth.min(dim=0).values).mean()
        if imitation and demonstrated:
            mean, _ = agent.actor.distribution(features[:demonstrated])
            # The demonstrations are the first rows, see `batch`.
            wanted = batch.actions[:demonstrated].clamp(-LARGEST_ACTION, LARGEST_ACTION)
            loss = loss + imitation * ((torch.tanh(mean) - wanted) ** 2).mean()
        self._step("actor", loss, self.acting)
        measured = {"actor_loss": float(loss.detach())}
        if not frozen:
            surplus = (density.detach() + agent.target_entropy).mean()
            self._step("alpha", -alpha * surplus, [agent.log_alpha])
            measured["alpha"] = float(alpha.detach())
        return measured

    def _step(self, name: str, loss: Tensor, parameters: list[nn.Parameter]) -> None:
        update = self.updates + 1
        check_finite(float(loss.detach()), f"the loss of the {name}", update)
        # A frozen actor that imitates nothing has nothing to learn from.
        if not loss.requires_grad:
            return
        self.optimizers[name].zero_grad(set_to_none=True)
        loss.backward()
        distributed.average_gradients(parameters)
        check_finite(
            gradient_norm(parameters), f"the norm of the gradient of the {name}", update
        )
        self.optimizers[name].step()

    @torch.no_grad()
    def _follow(self) -> None:
        """Move the target critics towards the critics by the factor tau."""
        pairs = zip(
            self.agent.target.parameters(), self.agent.judge.parameters(), strict=True
        )
        for kept, new in pairs:
            # Parameters alone: the normalizers of both were fitted together.
            kept.lerp_(new, self.config.tau)


@contextmanager
def _frozen(parameters: list[nn.Parameter]) -> Iterator[None]:
    """Within this context the parameters receive no gradient."""
    for parameter in parameters:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in parameters:
            parameter.requires_grad_(True)


def _joined(first: Transitions, second: Transitions) -> Transitions:
    return Transitions(
        AgentObs.join([first.seen, second.seen]),
        torch.cat([first.actions, second.actions]),
        torch.cat([first.reward, second.reward]),
        AgentObs.join([first.next_seen, second.next_seen]),
        torch.cat([first.terminated, second.terminated]),
    )
