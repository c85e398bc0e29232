"""The diffusion policy of MS-HAB: a 1-D UNet over action chunks, DDPM with 100 steps (mshab/agents/dp/agent.py).

Two things differ on purpose: demonstrations end soon after success, and evaluations use the moving average of the
weights, which MS-HAB computes but does not use.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from mjhab.learning.configs import StudentConfig
from mjhab.learning.devices import normal
from mjhab.learning.networks import Normalizer, PoolingEncoder
from mjhab.learning.observation.spec import ObservationSpec
from mjhab.learning.students.student import Batch, Student

STEP_FEATURES = 64
GROUPS = 8
KERNEL = 5
"""Width of the step embedding, groups of the group norms, and kernel size [actions]."""
MOST_BETA = 0.999
COSINE_OFFSET = 0.008
"""Parameters of the squared-cosine noise schedule (Nichol and Dhariwal 2021, arXiv 2102.09672, Eq. 17)."""


class DiffusionPolicy(Student):
    """Predicts the noise in a noisy chunk of actions; sampling removes it step by step."""

    kept: Tensor

    def __init__(self, config: StudentConfig, layout: ObservationSpec) -> None:
        super().__init__(config, layout)
        inputs = config.inputs
        self.vector_normalizer = Normalizer(layout.width)
        self.images = PoolingEncoder(
            sum(layout.image_channels),
            config.network.channels,
            config.network.image_features,
        )
        seen = inputs.history * (config.network.image_features + layout.width)
        self.unet = UNet(len(layout.actions), seen, config.network.unet)
        self.register_buffer(
            # Computed again from the config, so that checkpoints do not hold it.
            "kept",
            squared_cosine(config.sampling_steps),
            persistent=False,
        )

    @property
    def normalizer(self) -> Normalizer:
        return self.vector_normalizer

    @property
    def draws(self) -> int:
        return self.config.sampling_steps

    def see(self, vector: Tensor, images: Tensor) -> Tensor:
        """Features (B, F) of the observations."""
        history = self.config.inputs.history
        frames = images.float().div_(255.0).unflatten(1, (history, -1))
        features = self.images(frames.flatten(0, 1)).unflatten(0, (-1, history))
        normalized = self.vector_normalizer(vector.unflatten(1, (history, -1)))
        return torch.cat([features, normalized], dim=2).flatten(1)

    def loss(self, batch: Batch, random: torch.Generator) -> Tensor:
        target = self.targets(batch)
        noise = normal(target.shape, random, target)
        step = torch.randint(0, len(self.kept), (len(target),), generator=random).to(
            target.device
        )
        kept = self.kept[step][:, None, None]
        noisy = kept.sqrt() * target + (1.0 - kept).sqrt() * noise
        return self.error(
            self.unet(noisy, step, self.see(batch.vector, batch.images)), batch, noise
        )

    def chunk(self, vector: Tensor, images: Tensor, noise: Tensor) -> Tensor:
        seen = self.see(vector, images)
        limits = torch.ones(len(self.layout.actions), device=noise.device)
        least = self.action_normalizer(-limits)
        most = self.action_normalizer(limits)
        point = noise[:, 0]
        for step in reversed(range(len(self.kept))):
            predicted = self.unet(
                point, torch.full((len(noise),), step, device=noise.device), seen
            )
            kept = self.kept[step]
            before = self.kept[step - 1] if step else torch.ones_like(kept)
            clean = (point - (1.0 - kept).sqrt() * predicted) / kept.sqrt()
            # Where hardly any signal is left, the division blows errors up beyond all actions.
            clean = clean.clamp(least, most)
            fade = kept / before
            mean = before.sqrt() * (1.0 - fade) / (1.0 - kept) * clean
            mean = mean + fade.sqrt() * (1.0 - before) / (1.0 - kept) * point
            # The last step adds no noise: the result would keep it.
            if step:
                variance = (1.0 - before) / (1.0 - kept) * (1.0 - fade)
                mean = mean + variance.sqrt() * noise[:, step]
            point = mean
        return self.action_normalizer.restore(point)


def squared_cosine(steps: int) -> Tensor:
    """Cumulative product of 1 - beta (steps,) of the squared-cosine schedule ("alpha bar")."""

    def level(t: float) -> float:
        return math.cos((t + COSINE_OFFSET) / (1.0 + COSINE_OFFSET) * math.pi / 2.0) ** 2

    betas = [
        min(1.0 - level((k + 1) / steps) / level(k / steps), MOST_BETA)
        for k in range(steps)
    ]
    return torch.cumprod(1.0 - torch.tensor(betas), dim=0)


class ConvBlock(nn.Sequential):
    """Convolution over time, group norm, Mish."""

    def __init__(self, before: int, after: int, kernel: int) -> None:
        super().__init__(
            nn.Conv1d(before, after, kernel, padding=kernel // 2),
            nn.GroupNorm(GROUPS, after),
            nn.Mish(),
        )


class ResidualBlock(nn.Module):
    """Two convolution blocks with a residual connection; the condition (B, F) scales and shifts in between (FiLM)."""

    def __init__(self, before: int, after: int, condition: int, kernel: int) -> None:
        super().__init__()
        self.first = ConvBlock(before, after, kernel)
        self.second = ConvBlock(after, after, kernel)
        self.film = nn.Sequential(nn.Mish(), nn.Linear(condition, 2 * after))
        self.past = nn.Conv1d(before, after, 1) if before != after else nn.Identity()

    def forward(self, values: Tensor, condition: Tensor) -> Tensor:
        scale, shift = self.film(condition)[..., None].chunk(2, dim=1)
        return self.second(scale * self.first(values) + shift) + self.past(values)


class UNet(nn.Module):
    """Predicts the noise in a chunk (B, chunk, A) from the diffusion step (B,) and observation features (B, F).

    Args:
        actions: width of an action A.
        seen: width of the observation features F.
        levels: channels of each level.
        kernel: width of the convolutions over time [actions].
        step_features: width of what is made of the diffusion step.
    """

    frequencies: Tensor

    def __init__(
        self,
        actions: int,
        seen: int,
        levels: Sequence[int],
        kernel: int = KERNEL,
        step_features: int = STEP_FEATURES,
    ) -> None:
        super().__init__()
        half = step_features // 2
        last = max(half - 1, 1)
        self.register_buffer(
            "frequencies", torch.exp(-math.log(10_000.0) * torch.arange(half) / last)
        )
        self.clock = nn.Sequential(
            nn.Linear(step_features, 4 * step_features),
            nn.Mish(),
            nn.Linear(4 * step_features, step_features),
        )
        condition = step_features + seen

        def block(before: int, after: int) -> ResidualBlock:
            return ResidualBlock(before, after, condition, kernel)

        widths = (actions, *levels)
        self.down = nn.ModuleList()
        self.up = nn.ModuleList()
        for level, (before, after) in enumerate(itertools.pairwise(widths)):
            lowest = level == len(levels) - 1
            shrink = nn.Identity() if lowest else nn.Conv1d(after, after, 3, 2, 1)
            self.down.append(
                nn.ModuleList([block(before, after), block(after, after), shrink])
            )
        self.middle = nn.ModuleList(block(widths[-1], widths[-1]) for _ in range(2))
        for after, before in zip(widths[1:-1][::-1], widths[2:][::-1], strict=True):
            grow = nn.ConvTranspose1d(after, after, 4, 2, 1)
            self.up.append(
                nn.ModuleList([block(2 * before, after), block(after, after), grow])
            )
        self.out = nn.Sequential(
            ConvBlock(levels[0], levels[0], kernel), nn.Conv1d(levels[0], actions, 1)
        )

    def forward(self, chunk: Tensor, step: Tensor, seen: Tensor) -> Tensor:
        angles = step[:, None] * self.frequencies
        condition = torch.cat(
            [self.clock(torch.cat([angles.sin(), angles.cos()], dim=1)), seen], dim=1
        )
        values = chunk.transpose(1, 2)
        passed = []
        for first, second, shrink in self.down:  # type: ignore[misc]
            values = second(first(values, condition), condition)
            passed.append(values)
            values = shrink(values)
        for block in self.middle:
            values = block(values, condition)
        for first, second, grow in self.up:  # type: ignore[misc]
            values = torch.cat([values, passed.pop()], dim=1)
            values = grow(second(first(values, condition), condition))
        return self.out(values).transpose(1, 2)
