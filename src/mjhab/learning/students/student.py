"""What the algorithms have in common: a network that learns chunks of actions and gives them."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from mjhab.learning.configs import StudentConfig
from mjhab.learning.demos import Chunks, Demonstrations
from mjhab.learning.layout import Layout
from mjhab.learning.networks import Normalizer


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
            torch.from_numpy(chunks.vector),
            torch.from_numpy(chunks.images),
            torch.from_numpy(chunks.actions),
            torch.from_numpy(chunks.valid),
        )


class Student(nn.Module):
    """Base of the networks of all algorithms."""

    def __init__(self, config: StudentConfig, layout: Layout) -> None:
        super().__init__()
        self.config = config
        self.layout = layout
        self.action_normalizer = Normalizer(len(layout.actions))

    @property
    @abstractmethod
    def normalizer(self) -> Normalizer:
        """That of the vector."""

    @property
    def draws(self) -> int:
        """Chunks of noise that a chunk of actions takes; 0 for a student that always does the same."""
        return 0

    @abstractmethod
    def loss(self, batch: Batch, random: torch.Generator) -> Tensor:
        """The number to make small; ``random`` for what the algorithm draws."""

    @abstractmethod
    def chunk(self, vector: Tensor, images: Tensor, noise: Tensor) -> Tensor:
        """Actions (B, chunk, A) for what is seen; noise (B, draws, chunk, A) is standard normal."""

    def fit_normalizers(self, data: Demonstrations) -> None:
        """Take over the statistics of the first demonstrations; nothing if the config says so."""
        if self.config.inputs.normalize:
            self.normalizer.fit(data.vector[data.usable], self.layout.measured_width)
            self.action_normalizer.fit(data.actions[data.usable], data.actions.shape[1])

    def targets(self, batch: Batch) -> Tensor:
        """Normalized actions (B, chunk, A)."""
        return self.action_normalizer(batch.actions)

    def error(self, predicted: Tensor, batch: Batch, target: Tensor) -> Tensor:
        """Mean error over what is valid, in normalized actions: Huber, or squared if the config says so."""
        if self.config.huber:
            errors = nn.functional.huber_loss(
                predicted, target, reduction="none", delta=self.config.huber
            )
        else:
            errors = (predicted - target) ** 2
        weight = batch.valid[..., None].float()
        return (errors * weight).sum() / (weight.sum() * errors.shape[-1])

    @torch.no_grad()
    def act(self, vector: np.ndarray, images: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Chunks of actions (B, chunk, A) float32 in [-1, 1]."""
        chunk = self.chunk(
            torch.from_numpy(vector), torch.from_numpy(images), torch.from_numpy(noise)
        )
        return chunk.clamp(-1.0, 1.0).numpy()
