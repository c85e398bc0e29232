"""Base class of the student policies: networks that map an observation to a chunk of actions."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from mjhab.learning.batches import Chunks
from mjhab.learning.configs import StudentConfig
from mjhab.learning.demos import Demonstrations
from mjhab.learning.networks import Normalizer
from mjhab.learning.observation.spec import ObservationSpec


@dataclass(frozen=True, eq=False)
class Batch:
    """`Chunks` as tensors: vector (B, V), images (B, I, H, W) uint8, actions (B, chunk, A), valid (B, chunk) bool."""

    vector: Tensor
    images: Tensor
    actions: Tensor
    valid: Tensor

    @classmethod
    def of(cls, chunks: Chunks) -> Batch:
        """Share the memory of ``chunks``."""
        return cls(
            torch.as_tensor(chunks.vector),
            torch.as_tensor(chunks.images),
            torch.as_tensor(chunks.actions),
            torch.as_tensor(chunks.valid),
        )


class Student(nn.Module):
    """Base class of the networks of all imitation algorithms."""

    def __init__(self, config: StudentConfig, layout: ObservationSpec) -> None:
        super().__init__()
        self.config = config
        self.layout = layout
        self.action_normalizer = Normalizer(len(layout.actions))

    @property
    @abstractmethod
    def normalizer(self) -> Normalizer:
        """Normalizer of the vector input."""

    @property
    def draws(self) -> int:
        """Number of noise chunks that sampling one action chunk takes; 0 for a deterministic student."""
        return 0

    @abstractmethod
    def loss(self, batch: Batch, random: torch.Generator) -> Tensor:
        """Training loss of a batch; ``random`` is the source of the algorithm's random draws."""

    @abstractmethod
    def chunk(self, vector: Tensor, images: Tensor, noise: Tensor) -> Tensor:
        """Actions (B, chunk, A) for observations; noise (B, draws, chunk, A) is standard normal."""

    def fit_normalizers(self, data: Demonstrations) -> None:
        """Fit the normalizers to demonstrations, if the config normalizes inputs."""
        if self.config.inputs.normalize:
            self.normalizer.fit(data.vector[data.usable], self.layout.measured_width)
            self.action_normalizer.fit(data.actions[data.usable], data.actions.shape[1])

    def targets(self, batch: Batch) -> Tensor:
        """Normalized demonstrated actions (B, chunk, A)."""
        return self.action_normalizer(batch.actions)

    def error(self, predicted: Tensor, batch: Batch, target: Tensor) -> Tensor:
        """Mean error over the valid actions, normalized: Huber with delta ``config.huber``, or squared if that is 0."""
        if self.config.huber:
            errors = nn.functional.huber_loss(
                predicted, target, reduction="none", delta=self.config.huber
            )
        else:
            errors = (predicted - target) ** 2
        # Repeated actions past the end of an episode would teach to stand still.
        weight = batch.valid[..., None].float()
        return (errors * weight).sum() / (weight.sum() * errors.shape[-1])

    @torch.no_grad()
    def act(
        self, vector: np.ndarray, images: np.ndarray, noise: np.ndarray
    ) -> np.ndarray:
        """Chunks of actions (B, chunk, A) float32 in [-1, 1]."""
        chunk = self.chunk(
            torch.from_numpy(vector), torch.from_numpy(images), torch.from_numpy(noise)
        )
        return chunk.clamp(-1.0, 1.0).numpy()
