"""Refusal of updates whose loss or gradient is not finite."""

from __future__ import annotations

import math
from collections.abc import Iterable

from torch import nn

from mjhab.learning.runs.training import BrokenLossError


def check_finite(value: float, what: str, update: int) -> None:
    """Refuse NaN and infinity.

    Args:
        value: a loss, or the norm of a gradient.
        what: of what, for the message.
        update: number of the update, from 1.

    Raises:
        BrokenLossError: it is not finite. Earlier minibatches of the update may have changed the weights already, so
            a run keeps those of its last checkpoint.
    """
    # One step with it would make all weights nan, and the next checkpoint with them.
    if not math.isfinite(value):
        raise BrokenLossError(
            f"{what} became {value} in update {update}. The student is that of the last checkpoint, "
            "if there is one; a smaller learning rate may help."
        )


def gradient_norm(parameters: Iterable[nn.Parameter]) -> float:
    """Norm of all gradients together."""
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    return float(nn.utils.get_total_norm(gradients)) if gradients else 0.0
