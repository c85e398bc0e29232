"""Common base of the four MS-HAB networks: their interface, and sizes derived from the parameters' shapes."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

Shapes = Mapping[str, tuple[int, ...]]
"""Name of a parameter to its shape, in the order of the checkpoint."""
CAMERAS = ("fetch_head_depth", "fetch_hand_depth")
"""Names of the depth images in MS-HAB (mshab/envs/wrappers/observation.py)."""
IMAGE_SIDE_PX = 128
STATE_SIZE = 42
ACTION_SIZE = 13
DEPTH_SCALE_MM = 1000.0
"""Scale of the depth in ``squash_depth`` [mm]."""


class Network(nn.Module):
    """A policy network of MS-HAB; its modules have the names used there, so that the checkpoints load.

    Attributes:
        cameras: names of its depth images, in its order; a subset of CAMERAS.
        frames: number F of most recent observations that it takes.
        noise_shape: shape of the standard normal noise that one plan needs; () for none.
    """

    cameras: tuple[str, ...]
    frames: int
    noise_shape: tuple[int, ...] = ()

    def plan(self, depth: Mapping[str, Tensor], state: Tensor, noise: Tensor) -> Tensor:
        """Deterministic actions for the next K control steps.

        Args:
            depth: by camera (B, F, 128, 128) float32 [mm], oldest first.
            state: (B, F, 42) float32.
            noise: (B, *noise_shape) float32.

        Returns:
            (B, K, 13), not clipped.
        """
        raise NotImplementedError


def squash_depth(depth: Tensor) -> Tensor:
    """Depth [mm] as PPO, BC and the diffusion policy of MS-HAB take it: 1 - tanh(mm / 1000)."""
    return 1 - torch.tanh(depth / DEPTH_SCALE_MM)


def size(shapes: Shapes, key: str, axis: int, default: int) -> int:
    """Length of a parameter's axis; ``default`` (the published size) if there is no such parameter."""
    shape = shapes.get(key, ())
    return shape[axis] if axis < len(shape) else default


def names_below(shapes: Shapes, prefix: str, known: Sequence[str]) -> tuple[str, ...]:
    """Names among ``known`` that the ModuleDict ``prefix`` holds, in the checkpoint's order; all if it holds none."""
    found = dict.fromkeys(
        key.removeprefix(prefix).split(".")[0] for key in shapes if key.startswith(prefix)
    )
    return tuple(name for name in found if name in known) or tuple(known)


def output_sizes(
    shapes: Shapes, prefix: str, stride: int, default: Sequence[int]
) -> list[int]:
    """Output sizes of the weight layers of the nn.Sequential ``prefix``; their indices are ``stride`` apart."""
    indices = [
        key.removeprefix(prefix).split(".")[0] for key in shapes if key.startswith(prefix)
    ]
    last = max(
        (int(index) for index in indices if index.isdigit()),
        default=stride * (len(default) - 1),
    )
    published = [*default, *itertools.repeat(default[-1], last // stride)]
    return [
        size(shapes, f"{prefix}{stride * i}.weight", 0, published[i])
        for i in range(last // stride + 1)
    ]


def mlp(sizes: Sequence[int]) -> nn.Sequential:
    """Linear layers with ReLU between them."""
    layers: list[nn.Module] = []
    for width, following in itertools.pairwise(sizes):
        layers += [nn.Linear(width, following), nn.ReLU()]
    # The last layer gives numbers of either sign.
    return nn.Sequential(*layers[:-1])


def flat_size(cnn: nn.Module, channels: int) -> int:
    """Number of features that a CNN computes from a 128 x 128 image; 0 if the image is too small for it."""
    try:
        with torch.no_grad():
            return (
                cnn(torch.zeros(1, channels, IMAGE_SIDE_PX, IMAGE_SIDE_PX))
                .flatten(1)
                .shape[1]
            )
    # The sizes come from a file, which may be of images that this CNN cannot take.
    except RuntimeError:
        return 0
