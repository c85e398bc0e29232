"""Weights that were read from a file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from mjhab.core.errors import UsageError


def check_finite(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Refuse weights of which a number is NaN or infinite: they make no action.

    Args:
        path: the file, for the message.
        tensors: its content by name.

    Raises:
        UsageError: a tensor is not finite; the message names the first one and counts its numbers.
    """
    for name, tensor in tensors.items():
        wrong = int((~tensor.isfinite()).sum())
        if wrong:
            raise UsageError(
                f"{path} cannot act: {wrong:,} of the {tensor.numel():,} numbers of its tensor {name} are not finite "
                "(NaN or infinite). Give another checkpoint, such as one from before the training diverged."
            )
