"""The actor of MS-HAB's SAC (mshab/agents/sac): a CNN per camera, projections to 50 features each, an MLP."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from mjhab.paper.ms_hab.network import (
    ACTION_SIZE,
    CAMERAS,
    STATE_SIZE,
    Network,
    Shapes,
    flat_size,
    mlp,
    names_below,
    output_sizes,
    size,
)

TRAINING_ONLY = ("critic.", "critic_target.")
"""Prefixes of the parameters that inference does not need."""
STRIDE_PX = 2
_CNNS = "actor.encoder.cnns."
_PIXELS = "actor.encoder.pixels_projections."
_STATE = "actor.encoder.state_projection.projection.0.weight"


class SacNetwork(Network):
    """Takes stacked depth frames in millimetres, unscaled, and one state."""

    def __init__(self, shapes: Shapes) -> None:
        super().__init__()
        self.cameras = names_below(shapes, _CNNS, CAMERAS)
        self.frames = size(shapes, f"{_CNNS}{self.cameras[0]}.layers.0.weight", 1, 3)
        self.actor = _SacActor(shapes, self.cameras, self.frames)

    def plan(self, depth: Mapping[str, Tensor], state: Tensor, noise: Tensor) -> Tensor:
        """The squashed mean of the Gaussian, (B, 1, 13)."""
        # The second half is the spread, which evaluation leaves out.
        mean, _ = self.actor.mlp(self.actor.encoder(depth, state[:, -1])).chunk(2, dim=-1)
        return torch.tanh(mean)[:, None]


class _SacActor(nn.Module):
    def __init__(self, shapes: Shapes, cameras: tuple[str, ...], frames: int) -> None:
        super().__init__()
        self.encoder = _Encoder(shapes, cameras, frames)
        widths = output_sizes(shapes, "actor.mlp.", 2, (256, 256, 256, 2 * ACTION_SIZE))
        self.mlp = mlp([self.encoder.width, *widths])


class _Encoder(nn.Module):
    def __init__(self, shapes: Shapes, cameras: tuple[str, ...], frames: int) -> None:
        super().__init__()
        self.cnns = nn.ModuleDict(
            {
                camera: _Cnn(shapes, f"{_CNNS}{camera}.layers.", frames)
                for camera in cameras
            }
        )
        self.pixels_projections = nn.ModuleDict()
        for camera, cnn in self.cnns.items():
            width = size(shapes, f"{_PIXELS}{camera}.projection.0.weight", 0, 50)
            self.pixels_projections[camera] = _Projection(flat_size(cnn, frames), width)
        state_width = size(shapes, _STATE, 0, 50)
        self.state_projection = _Projection(
            size(shapes, _STATE, 1, STATE_SIZE), state_width
        )
        self.width = state_width + sum(
            size(shapes, f"{_PIXELS}{camera}.projection.0.weight", 0, 50)
            for camera in cameras
        )

    def forward(self, depth: Mapping[str, Tensor], state: Tensor) -> Tensor:
        pixels = [
            self.pixels_projections[camera](cnn(depth[camera]))
            for camera, cnn in self.cnns.items()
        ]
        return torch.cat([*pixels, self.state_projection(state)], dim=1)


class _Cnn(nn.Module):
    def __init__(self, shapes: Shapes, prefix: str, frames: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = frames
        for i, width in enumerate(output_sizes(shapes, prefix, 2, (32, 64, 128, 256))):
            kernel = size(shapes, f"{prefix}{2 * i}.weight", 2, 3)
            layers += [nn.Conv2d(channels, width, kernel, STRIDE_PX), nn.ReLU()]
            channels = width
        # MS-HAB has no activation behind the last convolution: the projection normalizes.
        self.layers = nn.Sequential(*layers[:-1], nn.Flatten())

    def forward(self, pixels: Tensor) -> Tensor:
        return self.layers(pixels)


class _Projection(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.projection = nn.Sequential(
            nn.Linear(inputs, outputs), nn.LayerNorm(outputs), nn.Tanh()
        )

    def forward(self, features: Tensor) -> Tensor:
        return self.projection(features)
