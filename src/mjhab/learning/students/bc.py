"""Behaviour cloning: predict the demonstrated chunk of actions. Preset ``paper`` is that of MS-HAB: one action."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mjhab.learning.configs import StudentConfig
from mjhab.learning.networks import Encoder, Normalizer, Trunk, mlp
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.students.routed import RoutedTrunk
from mjhab.learning.students.student import Batch, Student

PAPER_HIDDEN = (2048, 1024, 512)
"""Hidden layers of the published student (mshab/agents/bc/agent.py)."""


class PaperTrunk(nn.Module):
    """Layers of the MS-HAB network: 1,024 features each for images and state, then PAPER_HIDDEN.

    The features of the state are linear, those of the images pass a ReLU.
    """

    def __init__(self, config: StudentConfig, layout: ObservationSpec) -> None:
        super().__init__()
        self.encoder = Encoder(config, layout)
        width = config.network.image_features
        self.state = nn.Linear(self.encoder.vector_width, width)
        self.layers = mlp([(self.encoder.cameras + 1) * width, *PAPER_HIDDEN], norm=False)
        self.width = PAPER_HIDDEN[-1]

    @property
    def normalizer(self) -> Normalizer:
        """Normalizer of the vector input."""
        return self.encoder.normalizer

    def encoded(self, vector: Tensor, images: Tensor) -> Tensor:
        """Input (B, F) of the fully connected layers."""
        features, seen = self.encoder(vector, images)
        return torch.cat([*features, self.state(seen)], dim=1)

    def forward(self, vector: Tensor, images: Tensor) -> Tensor:
        return self.layers(self.encoded(vector, images))


class BehaviourCloning(Student):
    """A trunk and one linear layer that outputs all actions of the chunk."""

    def __init__(self, config: StudentConfig, layout: ObservationSpec) -> None:
        super().__init__(config, layout)
        self.trunk = _trunk_of(config)(config, layout)
        self.head = nn.Linear(self.trunk.width, config.chunk * len(layout.actions))

    @property
    def normalizer(self) -> Normalizer:
        return self.trunk.normalizer

    def predict(self, vector: Tensor, images: Tensor) -> Tensor:
        """Normalized actions (B, chunk, A)."""
        return self._read(self.trunk(vector, images))

    def _read(self, features: Tensor) -> Tensor:
        return self.head(features).unflatten(1, (self.config.chunk, -1))

    def chunk_of(self, features: Tensor) -> Tensor:
        """Actions (B, chunk, A) for the trunk's features (B, F)."""
        return self.action_normalizer.restore(self._read(features))

    def loss(self, batch: Batch, random: torch.Generator) -> Tensor:
        return self.error(
            self.predict(batch.vector, batch.images), batch, self.targets(batch)
        )

    def chunk(self, vector: Tensor, images: Tensor, noise: Tensor) -> Tensor:
        return self.chunk_of(self.trunk(vector, images))


def _trunk_of(
    config: StudentConfig,
) -> type[Trunk] | type[PaperTrunk] | type[RoutedTrunk]:
    if config.network.routes:
        return RoutedTrunk
    return PaperTrunk if config.network.encoder == "paper" else Trunk
