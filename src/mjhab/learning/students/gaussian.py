"""Actors of soft actor-critic: a Gaussian over one action, squashed into [-1, 1] by tanh."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor, nn

from mjhab.core.errors import UsageError, wrong_value
from mjhab.learning.configs import GAUSSIAN_ACTIONS, StudentConfig
from mjhab.learning.demos import Demonstrations
from mjhab.learning.devices import normal
from mjhab.learning.networks import Normalizer, Trunk
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.students.bc import BehaviourCloning
from mjhab.learning.students.student import Batch, Student

START_STD = 0.1
"""Standard deviation before squashing of an actor that begins from a student, whose exploration is local."""
LARGEST_ACTION = 0.98
"""Imitated actions are clipped to this absolute value, because tanh reaches 1 only at infinity."""


class SquashedGaussian(Student):
    """A trunk with heads for mean and log standard deviation of a Gaussian; the policy acts by the squashed mean.

    As a student it imitates one action at a time. Actions are not normalized, because tanh already gives [-1, 1].
    """

    def __init__(self, config: StudentConfig, layout: ObservationSpec) -> None:
        super().__init__(config, layout)
        self.trunk = Trunk(config, layout)
        self.mean = nn.Linear(self.trunk.width, len(layout.actions))
        self.log_std = nn.Linear(self.trunk.width, len(layout.actions))
        self.log_std_limits = config.network.log_std

    @property
    def normalizer(self) -> Normalizer:
        return self.trunk.normalizer

    def features(self, vector: Tensor, images: Tensor) -> Tensor:
        """Encoder features (B, F) of observations, the part that the critics may share."""
        return self.trunk.encoder.joined(vector, images)

    def distribution(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation before squashing, (B, A) each, for ``features`` (B, F)."""
        hidden = self.trunk.layers(features)
        least, most = self.log_std_limits
        spread = torch.tanh(self.log_std(hidden))
        return self._raw_mean(hidden), least + 0.5 * (most - least) * (spread + 1.0)

    def _raw_mean(self, hidden: Tensor) -> Tensor:
        """Mean (B, A) before squashing, of the trunk's features (B, H)."""
        return self.mean(hidden)

    def sample(self, features: Tensor, random: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw actions (B, A); also returns their log density (B,)."""
        mean, log_std = self.distribution(features)
        noise = normal(mean.shape, random, mean)
        raw = mean + log_std.exp() * noise
        density = -0.5 * noise**2 - log_std - 0.5 * math.log(2.0 * math.pi)
        # log(1 - tanh(x)^2), written so that it does not underflow.
        squash = 2.0 * (math.log(2.0) - raw - nn.functional.softplus(-2.0 * raw))
        return torch.tanh(raw), (density - squash).sum(dim=1)

    def fit_normalizers(self, data: Demonstrations) -> None:
        """Fit the normalizer of the vector input; actions stay unnormalized."""
        actions = self.action_normalizer
        super().fit_normalizers(data)
        actions.mean.zero_()
        actions.scale.fill_(1.0)

    def loss(self, batch: Batch, random: torch.Generator) -> Tensor:
        wanted = batch.actions[:, :1].clamp(-LARGEST_ACTION, LARGEST_ACTION)
        return self.error(
            self.chunk(batch.vector, batch.images, wanted), _first(batch), wanted
        )

    def chunk(self, vector: Tensor, images: Tensor, noise: Tensor) -> Tensor:
        mean, _ = self.distribution(self.features(vector, images))
        return torch.tanh(mean)[:, None]


class ActionGaussian(SquashedGaussian):
    """A SquashedGaussian whose layer ``mean`` outputs actions instead of their inverse tanh.

    So it can hold the last layer of a behaviour cloning student as it is, see `gaussian_of`. Actions are clipped to
    LARGEST_ACTION; gradients pass the clipping unchanged, since an actor must find the way back from the limit.
    """

    def _raw_mean(self, hidden: Tensor) -> Tensor:
        actions = self.mean(hidden)
        clipped = actions.clamp(-LARGEST_ACTION, LARGEST_ACTION)
        # The gradient passes as if nothing were clipped, so that an action can come back from the limit.
        return torch.atanh(actions + (clipped - actions).detach())


def gaussian_of(student: BehaviourCloning) -> ActionGaussian:
    """The actor whose mean is the first action of a behaviour cloning student, and whose spread is START_STD.

    Raises:
        UsageError: the student has the network of MS-HAB's behaviour cloning, which this actor has not.
    """
    if not isinstance(student.trunk, Trunk):
        raise UsageError(
            "an actor of sac and rlpd cannot begin from a student of preset paper: its network has other layers. Train "
            "one of preset small, quick or state, or use mjhab train ppo --start."
        )
    config = dataclasses.replace(
        student.config, algorithm=GAUSSIAN_ACTIONS, chunk=1, execute=1
    )
    made = ActionGaussian(config, student.layout)
    made.trunk.load_state_dict(student.trunk.state_dict())
    count = len(student.layout.actions)
    normalizer = student.action_normalizer
    least, most = made.log_std_limits
    if not least < math.log(START_STD) < most:
        raise wrong_value(
            "network.log_std",
            (least, most),
            f"around {math.log(START_STD):.2f}, the spread of an actor that begins from a student",
        )
    share = 2.0 * (math.log(START_STD) - least) / (most - least) - 1.0
    with torch.no_grad():
        # The first rows of the head are the first action of the chunk, normalized.
        made.mean.weight.copy_(student.head.weight[:count] * normalizer.scale[:, None])
        made.mean.bias.copy_(normalizer.restore(student.head.bias[:count]))
        # The same spread everywhere, whatever the student's features are.
        made.log_std.weight.zero_()
        made.log_std.bias.fill_(math.atanh(share))
    return made


def _first(batch: Batch) -> Batch:
    """The batch with only the first action of every chunk."""
    return Batch(batch.vector, batch.images, batch.actions[:, :1], batch.valid[:, :1])
