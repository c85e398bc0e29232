"""Running mean and standard deviation of observations, for the networks' normalizers."""

from __future__ import annotations

import torch
from torch import Tensor

from mjhab.learning.networks import LEAST_SPREAD, Normalizer


class RunningStatistics:
    """Mean and standard deviation of all rows so far, by the parallel update of Chan et al. (1979).

    Args:
        width: columns of a row. device: where the rows lie.
    """

    def __init__(self, width: int, device: torch.device) -> None:
        self.count = torch.zeros((), dtype=torch.float64, device=device)
        self.mean = torch.zeros(width, dtype=torch.float64, device=device)
        self.squares = torch.zeros(width, dtype=torch.float64, device=device)
        """(width,) sum of squared deviations from the mean."""

    def add(self, rows: Tensor) -> None:
        """Include rows (N, width)."""
        # The sum goes over all samples of a run: float32 would stop counting after some millions.
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
        """Write mean and standard deviation into the first ``measured`` columns of normalizers."""
        spread = (self.squares / self.count.clamp(min=1)).sqrt().clamp(min=LEAST_SPREAD)
        for normalizer in normalizers:
            # In place: the columns behind them, codes of the subtask, keep mean 0 and scale 1.
            normalizer.mean[:measured] = self.mean[:measured].float()
            normalizer.scale[:measured] = spread[:measured].float()

    def tensors(self) -> dict[str, Tensor]:
        """State as named tensors, for a checkpoint."""
        return {"count": self.count, "mean": self.mean, "squares": self.squares}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Load the state that ``tensors`` returned."""
        self.count.copy_(tensors["count"])
        self.mean.copy_(tensors["mean"])
        self.squares.copy_(tensors["squares"])
