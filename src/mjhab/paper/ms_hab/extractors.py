"""Feature extractors of MS-HAB's PPO and BC (mshab/agents/ppo, mshab/agents/bc).

Each camera has a CNN and a linear layer, the state has a linear layer, and all features are concatenated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mjhab.paper.ms_hab.network import (
    CAMERAS,
    STATE_SIZE,
    Shapes,
    flat_size,
    names_below,
    output_sizes,
    size,
    squash_depth,
)

STATE = "state"


@dataclass(frozen=True)
class CnnSizes:
    """Published sizes of a CNN.

    channels, kernels [px], strides [px]: of its convolutions, in order. features: width of each camera's and of the
    state's output.
    """

    channels: tuple[int, ...]
    kernels: tuple[int, ...]
    strides: tuple[int, ...]
    features: int


class Extractors(nn.ModuleDict):
    """One extractor per camera and one for "state", in the order of the checkpoint."""

    def __init__(self, shapes: Shapes, prefix: str, published: CnnSizes) -> None:
        names = names_below(shapes, prefix, (*CAMERAS, STATE))
        super().__init__()
        cameras = [name for name in names if name != STATE] or list(CAMERAS)
        self.frames = size(shapes, f"{prefix}{cameras[0]}.0.0.weight", 1, 3)
        self.width = 0
        for name in names:
            module, width = self._make(
                shapes, f"{prefix}{name}.", published, is_state=name == STATE
            )
            self[name] = module
            self.width += width

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, in order."""
        return tuple(name for name in self if name != STATE)

    def features(self, depth: Mapping[str, Tensor], state: Tensor) -> Tensor:
        """All features (B, width) of depth images (B, F, H, W) [mm] and of a state (B, 42)."""
        parts = [
            module(state) if name == STATE else module(squash_depth(depth[name]))
            for name, module in self.items()
        ]
        return torch.cat(parts, dim=1)

    def _make(
        self, shapes: Shapes, prefix: str, published: CnnSizes, is_state: bool
    ) -> tuple[nn.Module, int]:
        """Make an extractor; also returns the number of its features."""
        if is_state:
            width = size(shapes, f"{prefix}weight", 0, published.features)
            return nn.Linear(size(shapes, f"{prefix}weight", 1, STATE_SIZE), width), width
        cnn = _cnn(shapes, f"{prefix}0.", self.frames, published)
        width = size(shapes, f"{prefix}1.0.weight", 0, published.features)
        return nn.Sequential(
            cnn, nn.Sequential(nn.Linear(flat_size(cnn, self.frames), width), nn.ReLU())
        ), width


def _cnn(shapes: Shapes, prefix: str, frames: int, published: CnnSizes) -> nn.Sequential:
    layers: list[nn.Module] = []
    channels = frames
    widths: Sequence[int] = output_sizes(shapes, prefix, 2, published.channels)[
        : len(published.strides)
    ]
    for i, width in enumerate(widths):
        kernel = size(shapes, f"{prefix}{2 * i}.weight", 2, published.kernels[i])
        layers += [nn.Conv2d(channels, width, kernel, published.strides[i]), nn.ReLU()]
        channels = width
    return nn.Sequential(*layers, nn.Flatten())
