"""Normalization of what is seen while it changes: running mean and spread, kept in the networks' normalizers."""

from __future__ import annotations

import torch
from torch import Tensor

from mjhab.learning.networks import LEAST_SPREAD, Normalizer


class RunningStatistics:
    """Mean and spread of all rows so far, by the parallel update of Chan et al. (1979).

    Args:
        width: numbers of a row. device: where rows are.
    """

    def __init__(self, width: int, device: torch.device) -> None:
        self.count = torch.zeros((), dtype=torch.float64, device=device)
        self.mean = torch.zeros(width, dtype=torch.float64, device=device)
        self.squares = torch.zeros(width, dtype=torch.float64, device=device)
        """Sum of squared deviations from the mean."""

    def add(self, rows: Tensor) -> None:
        """Take rows (N, width) in."""
        values = rows.double()
        count = len(values)
        mean = values.mean(dim=0)
        total = self.count + count
        apart = mean - self.mean
        self.squares += ((values - mean) ** 2).sum(dim=0)
        self.squares += apart**2 * self.count * count / total
        self.mean += apart * count / total
        self.count = total

    def fit(self, normalizers: list[Normalizer], measured: int) -> None:
        """Let normalizers use them for their first ``measured`` numbers."""
        spread = (self.squares / self.count.clamp(min=1)).sqrt().clamp(min=LEAST_SPREAD)
        for normalizer in normalizers:
            normalizer.mean[:measured] = self.mean[:measured].float()
            normalizer.scale[:measured] = spread[:measured].float()

    def tensors(self) -> dict[str, Tensor]:
        """What a checkpoint keeps."""
        return {"count": self.count, "mean": self.mean, "squares": self.squares}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Take over what ``tensors`` gave."""
        self.count.copy_(tensors["count"])
        self.mean.copy_(tensors["mean"])
        self.squares.copy_(tensors["squares"])
