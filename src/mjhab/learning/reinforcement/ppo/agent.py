"""The agent of PPO: a Gaussian policy around a student network, and a value network."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mjhab.core.errors import wrong_value
from mjhab.learning.devices import normal
from mjhab.learning.networks import Trunk
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.reinforcement.agent_encoder import AgentObs
from mjhab.learning.reinforcement.configs import (
    LEAST_STD,
    MOST_STD,
    PpoConfig,
    ReinforcementConfig,
)
from mjhab.learning.reinforcement.networks import Value
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.heads import make_student
from mjhab.learning.students.routed import RoutedTrunk
from mjhab.learning.students.student import Student


class Ppo(nn.Module):
    """PPO agent: a Gaussian policy whose mean is a student network, and a state value network.

    Args:
        config: of the whole run. layout: observations and actions of the actor.
        privileged: width of the input that only the critic receives.
        seed: of the initial weights.
        start: student that initializes the actor; only the first action of its chunk is used.

    Raises:
        UsageError: ``freeze_encoder`` without ``start``.
    """

    def __init__(
        self,
        config: ReinforcementConfig,
        layout: ObservationSpec,
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
        if self.config.freeze_encoder:
            if start is None:
                raise wrong_value(
                    "freeze_encoder",
                    True,
                    "left out without a student",
                    "It keeps the weights of one: give one with --start.",
                )
            if isinstance(actor.trunk, RoutedTrunk):
                raise wrong_value(
                    "freeze_encoder",
                    True,
                    "left out with a student that `mjhab policy join` made: each of its parts has an encoder",
                )
            actor.trunk.requires_grad_(False)
            # The layers behind the encoder go on learning.
            actor.trunk.layers.requires_grad_(True)
        # An actor that can act already would act differently under other statistics.
        self.keeps_normalization = start is not None or self.config.demonstrations > 0
        # Torch's global generator is left as it was, so that what a caller draws afterwards does not depend on
        # this.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed + 1)
            if start is None:
                _act_little(self.actor)
            seen = layout if self.config.critic_images else layout.without_images()
            self.value = Value(config.student, seen, privileged)
            width = self.actor.trunk.width if self.config.state_std else 0
            self.spread = Spread(width, len(layout.actions), self.config.initial_std)
            if config.network.encoder == "nature" and start is None:
                _begin_as_published(self.actor, self.value)

    def acting_parameters(self) -> list[nn.Parameter]:
        """Parameters of the policy that are trained: of its mean and its standard deviation."""
        every = [*self.actor.parameters(), *self.spread.parameters()]
        return [parameter for parameter in every if parameter.requires_grad]

    def mean(self, seen: AgentObs) -> Tensor:
        """Means (B, A) of the actions."""
        return self.distribution(seen).mean

    def distribution(self, seen: AgentObs) -> Actions:
        """Distribution of the actions given observations."""
        return self.distribution_of(self.encoded(seen))

    def encoded(self, seen: AgentObs) -> Tensor:
        """What the actor's encoder makes of observations, (B, F)."""
        return self.actor.trunk.encoded(seen.vector, seen.images)

    def distribution_of(self, encoded: Tensor) -> Actions:
        """Distribution of the actions given encoded observations (B, F)."""
        features = self.actor.trunk.layers(encoded)
        mean = self.actor.chunk_of(features)[:, 0]
        return Actions(mean, self.spread(features).expand_as(mean))


@dataclass(frozen=True, eq=False)
class Actions:
    """Diagonal normal distributions of actions: mean (B, A), logarithm of the standard deviation (B, A)."""

    mean: Tensor
    log_std: Tensor

    def sample(self, random: torch.Generator) -> Tensor:
        """Draw actions (B, A)."""
        noise = normal(self.mean.shape, random, self.mean)
        return self.mean + self.log_std.exp() * noise

    def log_probability(self, actions: Tensor) -> Tensor:
        """Log density (B,) of actions (B, A)."""
        distance = (actions - self.mean) / self.log_std.exp()
        density = -0.5 * distance**2 - self.log_std - 0.5 * math.log(2.0 * math.pi)
        return density.sum(dim=1)


class Spread(nn.Module):
    """Logarithm of the standard deviation of the actions; actions range over [-1, 1].

    Args:
        features: width of the features that the standard deviation depends on; it then stays between LEAST_STD and
            MOST_STD. 0 learns one unlimited constant per action dimension, as MS-HAB does.
        actions: width of an action. initial_std: standard deviation before training.
    """

    def __init__(self, features: int, actions: int, initial_std: float) -> None:
        super().__init__()
        self._low = math.log(LEAST_STD)
        self._half = 0.5 * (math.log(MOST_STD) - self._low)
        begin = math.log(initial_std)
        if features:
            # The inverse of ``forward``, so that training begins with ``initial_std``.
            begin = math.atanh((begin - self._low) / self._half - 1.0)
        self.bias = nn.Parameter(torch.full((actions,), begin))
        # Zero, so that the spread is the same everywhere at first.
        self.weight = nn.Parameter(torch.zeros(actions, features)) if features else None

    def forward(self, features: Tensor) -> Tensor:
        """Log standard deviation: (B, A) for features (B, F), or the constant (A,)."""
        if self.weight is None:
            return self.bias
        raw = nn.functional.linear(features, self.weight, self.bias)
        return self._low + self._half * (torch.tanh(raw) + 1.0)


def _act_little(actor: BehaviourCloning) -> None:
    """Initialize the last layer of a new actor so that its actions are close to zero."""
    nn.init.orthogonal_(actor.head.weight, 0.01)
    nn.init.zeros_(actor.head.bias)


def _begin_as_published(actor: BehaviourCloning, value: Value) -> None:
    """Initialize the layers behind the encoders as MS-HAB does (mshab/agents/ppo): orthogonal, gain sqrt(2), no bias.

    The actor's last layer has a hundredth of that gain.
    """
    assert isinstance(actor.trunk, Trunk)
    for layer in (*actor.trunk.layers, *value.layers, actor.head):
        if isinstance(layer, nn.Linear):
            gain = 0.01 * math.sqrt(2.0) if layer is actor.head else math.sqrt(2.0)
            nn.init.orthogonal_(layer.weight, gain)
            nn.init.zeros_(layer.bias)
