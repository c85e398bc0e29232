"""Networks that the algorithms share: encoders of images and states, and the normalization of their inputs."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from mjhab.learning.configs import StudentConfig
from mjhab.learning.observation.spec import ObservationSpec

LEAST_SPREAD = 0.02
"""Smallest standard deviation to divide by, so that nearly constant inputs and actions are not amplified."""
MOST_SPREADS = 8.0
"""Normalized inputs are clipped to this absolute value [standard deviations]: the training data hold none beyond."""


class Normalizer(nn.Module):
    """Normalizes to mean 0 and standard deviation 1; the statistics are buffers and saved with the weights.

    Args:
        width: number of columns.
        most: normalized values are clipped to this absolute value.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, width: int, most: float = math.inf) -> None:
        super().__init__()
        self.most = most
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("scale", torch.ones(width))

    def fit(self, values: np.ndarray, measured: int) -> None:
        """Fit the first ``measured`` columns to values (N, width); the other columns stay unnormalized."""
        # A float32 sum over a million rows loses the digits that the spread is made of.
        mean = values[:, :measured].mean(axis=0, dtype=np.float64)
        spread = values[:, :measured].std(axis=0, dtype=np.float64)
        self.mean[:measured] = torch.from_numpy(mean.astype(np.float32))
        self.scale[:measured] = torch.from_numpy(
            np.maximum(spread, LEAST_SPREAD).astype(np.float32)
        )

    def forward(self, values: Tensor) -> Tensor:
        """Normalized values (..., width)."""
        return ((values - self.mean) / self.scale).clamp(-self.most, self.most)

    def restore(self, values: Tensor) -> Tensor:
        """Inverse of ``forward``, without the clipping: (..., width)."""
        return values * self.scale + self.mean


def mlp(widths: Sequence[int], norm: bool, last: bool = True) -> nn.Sequential:
    """Linear layers, each followed by layer norm (if ``norm``) and ReLU; without ``last`` the last one is linear."""
    layers: list[nn.Module] = []
    for number, (before, after) in enumerate(itertools.pairwise(widths)):
        layers.append(nn.Linear(before, after))
        if last or number + 2 < len(widths):
            if norm:
                layers.append(nn.LayerNorm(after))
            layers.append(nn.ReLU())
    return nn.Sequential(*layers)


class _ConvolvedCamera(nn.Module):
    """Encodes an image (B, C, H, W) to (B, features): convolutions with ReLU, and a linear layer with ``last`` behind.

    Args:
        frames: channels of an image.
        size: its width and height [px].
        layers: (channels, kernel, stride) of every convolution.
        features: width of the output.
        last: layers behind the linear one.
        padding: of the convolutions [px].
    """

    def __init__(
        self,
        frames: int,
        size: int,
        layers: Iterable[tuple[int, int, int]],
        features: int,
        last: Sequence[nn.Module],
        padding: int = 0,
    ) -> None:
        super().__init__()
        made: list[nn.Module] = []
        before = frames
        for after, kernel, stride in layers:
            made += [nn.Conv2d(before, after, kernel, stride, padding), nn.ReLU()]
            before = after
            size = (size + 2 * padding - kernel) // stride + 1
        self.convolutions = nn.Sequential(*made, nn.Flatten())
        linear = nn.Linear(before * size * size, features)
        self.head = nn.Sequential(linear, *last)

    def forward(self, image: Tensor) -> Tensor:
        return self.head(self.convolutions(image))


class CameraEncoder(_ConvolvedCamera):
    """Image encoder of the small presets: k6 s4, then k3 s2, a linear layer, layer norm and tanh.

    On a CPU this takes half the time of stride 2 throughout.
    """

    def __init__(
        self, frames: int, size: int, channels: Sequence[int], features: int
    ) -> None:
        layers = [
            (width, *((3, 2) if number else (6, 4)))
            for number, width in enumerate(channels)
        ]
        last = (nn.LayerNorm(features), nn.Tanh())
        super().__init__(frames, size, layers, features, last, padding=1)


class PaperCamera(_ConvolvedCamera):
    """Image encoder of MS-HAB's BC: k5 s2 three times, k3 s1 twice, a linear layer (mshab/agents/bc/agent.py)."""

    def __init__(
        self, frames: int, size: int, channels: Sequence[int], features: int
    ) -> None:
        layers = [
            (width, *((5, 2) if number < 3 else (3, 1)))
            for number, width in enumerate(channels)
        ]
        super().__init__(frames, size, layers, features, (nn.ReLU(),))


class NatureCamera(_ConvolvedCamera):
    """Image encoder of MS-HAB's PPO: k8 s4, k4 s2, k3 s1, a linear layer (mshab/agents/ppo)."""

    def __init__(
        self, frames: int, size: int, channels: Sequence[int], features: int
    ) -> None:
        layers = zip(channels, (8, 4, 3), (4, 2, 1), strict=True)
        super().__init__(frames, size, layers, features, (nn.ReLU(),))


class StridedCamera(_ConvolvedCamera):
    """Image encoder of MS-HAB's SAC: k3 s2 throughout, a linear layer, layer norm, tanh (mshab/agents/sac)."""

    def __init__(
        self, frames: int, size: int, channels: Sequence[int], features: int
    ) -> None:
        layers = [(width, 3, 2) for width in channels]
        last = (nn.LayerNorm(features), nn.Tanh())
        super().__init__(frames, size, layers, features, last)
        # The last convolution of the original has no ReLU behind it.
        *convolutions, _, flat = self.convolutions
        self.convolutions = nn.Sequential(*convolutions, flat)


CAMERA_ENCODERS: dict[str, type[nn.Module]] = {
    "small": CameraEncoder,
    "paper": PaperCamera,
    "nature": NatureCamera,
    "strided": StridedCamera,
}
"""Image encoders by name."""


class PoolingEncoder(nn.Module):
    """Image encoder of MS-HAB's diffusion policy: cameras are channels, k3 with pooling (mshab/agents/dp/agent.py)."""

    def __init__(self, frames: int, channels: Sequence[int], features: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        before = frames
        for after in channels:
            layers += [nn.Conv2d(before, after, 3, padding=1), nn.ReLU(), nn.MaxPool2d(2)]
            before = after
        layers += [
            nn.Conv2d(before, before, 1),
            nn.ReLU(),
            nn.AdaptiveMaxPool2d(1),
            nn.Flatten(),
        ]
        self.layers = nn.Sequential(*layers, nn.Linear(before, features), nn.ReLU())

    def forward(self, images: Tensor) -> Tensor:
        return self.layers(images)


class Encoder(nn.Module):
    """Encodes a student's observations: features per camera, and the normalized vector.

    ``forward`` takes vector (B, history * D) and images (B, history * C, H, W) uint8, whose C channels belong to
    ``cameras`` images. It returns one tensor (B, image_features) per image, and the normalized vector
    (B, vector_width).
    """

    def __init__(self, config: StudentConfig, layout: ObservationSpec) -> None:
        super().__init__()
        inputs = config.inputs
        network = config.network
        self.history = inputs.history
        self.channels = layout.image_channels
        self.image_features = network.image_features
        self.cameras = len(self.channels)
        self.normalizer = Normalizer(
            layout.width, MOST_SPREADS if inputs.normalize else math.inf
        )
        # "paper_dp" has one encoder for all cameras, which its student makes; those here are not used.
        build = CAMERA_ENCODERS.get(network.encoder, CameraEncoder)
        self.encoders = nn.ModuleList(
            build(
                inputs.history * channels,
                inputs.image_size,
                network.channels,
                network.image_features,
            )
            for channels in self.channels
        )
        self.stack_state = inputs.stack_state
        self.vector_width = (inputs.history if inputs.stack_state else 1) * layout.width
        self.state = nn.Identity()
        state_width = self.vector_width
        if network.state_features:
            state_width = network.state_features
            self.state = nn.Linear(self.vector_width, state_width)
            # MS-HAB's SAC normalizes its features of the state as it does those of images.
            if network.encoder == "strided":
                self.state = nn.Sequential(
                    self.state, nn.LayerNorm(state_width), nn.Tanh()
                )
        self.width = self.cameras * network.image_features + state_width

    def joined(self, vector: Tensor, images: Tensor) -> Tensor:
        """All features concatenated, (B, width)."""
        features, normalized = self(vector, images)
        return torch.cat([*features, self.state(normalized)], dim=1)

    def forward(self, vector: Tensor, images: Tensor) -> tuple[list[Tensor], Tensor]:
        split = vector.unflatten(1, (self.history, -1))
        if not self.stack_state:
            split = split[:, -1:]
        normalized = self.normalizer(split).flatten(1)
        if not self.cameras:
            return [], normalized
        # In place: the float copy is new, and images are the largest tensors of a batch.
        seen = images.float().div_(255.0).unflatten(1, (self.history, -1))
        split = seen.split(self.channels, dim=2)
        features = [
            # Images of one camera of all steps become channels of one, so that a camera has one encoder.
            encoder(image.flatten(1, 2))
            for encoder, image in zip(self.encoders, split, strict=True)
        ]
        return features, normalized


class Trunk(nn.Module):
    """Encoder and fully connected layers, from a student's observations to features (B, width)."""

    def __init__(self, config: StudentConfig, layout: ObservationSpec) -> None:
        super().__init__()
        network = config.network
        self.encoder = Encoder(config, layout)
        hidden = [network.hidden] * network.layers
        self.layers = mlp([self.encoder.width, *hidden], norm=network.norm)
        self.width = network.hidden if hidden else self.encoder.width

    @property
    def normalizer(self) -> Normalizer:
        """Normalizer of the vector input."""
        return self.encoder.normalizer

    def encoded(self, vector: Tensor, images: Tensor) -> Tensor:
        """Input (B, F) of the fully connected layers."""
        return self.encoder.joined(vector, images)

    def forward(self, vector: Tensor, images: Tensor) -> Tensor:
        return self.layers(self.encoded(vector, images))
