"""The behaviour cloning network of MS-HAB (mshab/agents/bc): five convolutions per camera and an MLP."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from mjhab.paper.ms_hab.extractors import CnnSizes, Extractors
from mjhab.paper.ms_hab.network import ACTION_SIZE, Network, Shapes, mlp, output_sizes

_CNN = CnnSizes(
    channels=(24, 36, 48, 64, 64),
    kernels=(5, 5, 5, 3, 3),
    strides=(2, 2, 2, 1, 1),
    features=1024,
)


class Bc(Network):
    """Takes stacked depth frames as 1 - tanh(mm / 1000), and one state. The published checkpoints take one frame."""

    def __init__(self, shapes: Shapes) -> None:
        super().__init__()
        self.extractors = Extractors(shapes, "extractors.", _CNN)
        self.cameras = self.extractors.cameras
        self.frames = self.extractors.frames
        self.mlp = mlp(
            [
                self.extractors.width,
                *output_sizes(shapes, "mlp.", 2, (2048, 1024, 512, ACTION_SIZE)),
            ]
        )

    def plan(self, depth: Mapping[str, Tensor], state: Tensor, noise: Tensor) -> Tensor:
        """The action, (B, 1, 13)."""
        return self.mlp(self.extractors.features(depth, state[:, -1]))[:, None]
