"""The actor of soft actor-critic: a Gaussian over one action, squashed into [-1, 1] by tanh."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from mjhab.learning.configs import StudentConfig
from mjhab.learning.demos import Demonstrations
from mjhab.learning.devices import normal
from mjhab.learning.layout import Layout
from mjhab.learning.networks import Normalizer, Trunk
from mjhab.learning.students.student import Batch, Student

LEAST_LOG_STD = -5.0
MOST_LOG_STD = 1.0
"""Limits of the logarithm of the standard deviation before squashing."""
LARGEST_ACTION = 0.98
"""Imitated actions are clipped to this absolute value, because tanh reaches 1 only at infinity."""


class SquashedGaussian(Student):
    """A trunk with heads for mean and log standard deviation of a Gaussian; the policy acts by the squashed mean.

    As a student it imitates one action at a time. Actions are not normalized, because tanh already gives [-1, 1].
    """

    def __init__(self, config: StudentConfig, layout: Layout) -> None:
        super().__init__(config, layout)
        self.trunk = Trunk(config, layout)
        self.mean = nn.Linear(self.trunk.width, len(layout.actions))
        self.log_std = nn.Linear(self.trunk.width, len(layout.actions))

    @property
    def normalizer(self) -> Normalizer:
        return self.trunk.normalizer

    def features(self, vector: Tensor, images: Tensor) -> Tensor:
        """Encoder features (B, F) of observations, the part that the critics may share."""
        return self.trunk.encoder.joined(vector, images)

    def distribution(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation before squashing, (B, A) each, for ``features`` (B, F)."""
        hidden = self.trunk.layers(features)
        spread = torch.tanh(self.log_std(hidden))
        log_std = LEAST_LOG_STD + 0.5 * (MOST_LOG_STD - LEAST_LOG_STD) * (spread + 1.0)
        return self.mean(hidden), log_std

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
        return self.error(self.chunk(batch.vector, batch.images, wanted), _first(batch), wanted)

    def chunk(self, vector: Tensor, images: Tensor, noise: Tensor) -> Tensor:
        mean, _ = self.distribution(self.features(vector, images))
        return torch.tanh(mean)[:, None]


def _first(batch: Batch) -> Batch:
    """The batch with only the first action of every chunk."""
    return Batch(batch.vector, batch.images, batch.actions[:, :1], batch.valid[:, :1])
