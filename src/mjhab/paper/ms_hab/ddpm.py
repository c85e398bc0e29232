"""Sampling by denoising diffusion (Ho et al. 2020) on the squared-cosine schedule (Nichol and Dhariwal 2021)."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

STEPS = 100
"""Number of diffusion steps (mshab/agents/dp/agent.py)."""
OFFSET = 0.008
LARGEST_BETA = 0.999
"""Parameters of the squared-cosine schedule (Nichol and Dhariwal 2021)."""
SMALLEST_VARIANCE = 1e-20
"""Lower limit of the posterior variance."""


def squared_cosine_betas(steps: int = STEPS) -> Tensor:
    """Variance beta of the noise that each step adds, (steps,) float32."""

    def kept(share: float) -> float:
        return math.cos((share + OFFSET) / (1 + OFFSET) * math.pi / 2) ** 2

    betas = [
        min(1 - kept((i + 1) / steps) / kept(i / steps), LARGEST_BETA)
        for i in range(steps)
    ]
    return torch.tensor(betas, dtype=torch.float32)


def sample(predict_noise: Callable[[Tensor, Tensor], Tensor], noise: Tensor) -> Tensor:
    """Draw samples with the same number of steps S as in training.

    The estimate of the clean sample is clipped to [-1, 1] in every step; the variance is that of the posterior.

    Args:
        predict_noise: predicts the noise in a sample (B, ...) at the diffusion step (B,) int64, counted from 0.
        noise: (B, S, ...) standard normal numbers; the first of the S entries is the initial sample, the others are
            added after each step except the last.
    """
    steps = noise.shape[1]
    betas = squared_cosine_betas(steps).to(noise.device)
    kept = torch.cumprod(1 - betas, dim=0)
    current = noise[:, 0]
    for t in range(steps - 1, -1, -1):
        # Before the first step nothing of the sample is lost.
        before = kept[t - 1] if t > 0 else torch.ones_like(kept[0])
        step = torch.full((len(current),), t, dtype=torch.int64, device=noise.device)
        predicted = predict_noise(current, step)
        clean = ((current - (1 - kept[t]).sqrt() * predicted) / kept[t].sqrt()).clamp(
            -1, 1
        )
        alpha = kept[t] / before
        beta = 1 - alpha
        mean = (
            before.sqrt() * beta / (1 - kept[t]) * clean
            + alpha.sqrt() * (1 - before) / (1 - kept[t]) * current
        )
        # The last step adds no noise, or the actions would shake.
        if t == 0:
            return mean
        variance = ((1 - before) / (1 - kept[t]) * beta).clamp(min=SMALLEST_VARIANCE)
        current = mean + variance.sqrt() * noise[:, steps - t]
    raise ValueError("noise for at least one step is needed")
