"""Weights in a quarter of the space: 8-bit integers with one scale per row."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

SCALE = "scale/"
"""Prefix of the name of a tensor's scales."""
LEAST_NUMBERS = 1024
"""Smaller tensors stay as they are: biases, normalizers."""
LARGEST = 127
LEAST_SCALE = 1e-12


def compacted(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Large matrices and kernels (N, ...) as int8, with scales (N,) under another name; everything else as it is.

    The error of a weight is at most 0.4 % of the largest one in its row.
    """
    found: dict[str, Tensor] = {}
    for name, tensor in tensors.items():
        if tensor.ndim < 2 or tensor.numel() < LEAST_NUMBERS:
            found[name] = tensor
            continue
        rows = tensor.detach().flatten(1)
        scale = (rows.abs().amax(dim=1) / LARGEST).clamp_min(LEAST_SCALE)
        found[name] = (rows / scale[:, None]).round().to(torch.int8).view(tensor.shape)
        found[SCALE + name] = scale
    return found


def expanded(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Inverse of `compacted`, up to rounding; tensors that were not compacted stay as they are."""
    found: dict[str, Tensor] = {}
    for name, tensor in tensors.items():
        if name.startswith(SCALE):
            continue
        scale = tensors.get(SCALE + name)
        if scale is None:
            found[name] = tensor
        else:
            wide = scale.view(-1, *[1] * (tensor.ndim - 1))
            found[name] = tensor.to(scale.dtype) * wide
    return found
