"""The actor of MS-HAB's PPO (mshab/agents/ppo): the CNN of the Nature DQN paper per camera, one hidden layer."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from mjhab.paper.ms_hab.extractors import CnnSizes, Extractors
from mjhab.paper.ms_hab.network import ACTION_SIZE, Network, Shapes, mlp, output_sizes

TRAINING_ONLY = ("critic.",)
"""Prefixes of the parameters that inference does not need."""
_CNN = CnnSizes(channels=(32, 64, 64), kernels=(8, 4, 3), strides=(4, 2, 1), features=256)


class PpoNetwork(Network):
    """Takes stacked depth frames as 1 - tanh(mm / 1000), and one state."""

    def __init__(self, shapes: Shapes) -> None:
        super().__init__()
        self.feature_net = _Features(shapes)
        extractors = self.feature_net.extractors
        self.cameras = extractors.cameras
        self.frames = extractors.frames
        widths = output_sizes(shapes, "actor_mean.", 2, (512, ACTION_SIZE))
        self.actor_mean = mlp([extractors.width, *widths])
        # Not used in inference, but an entry of every checkpoint.
        self.actor_logstd = nn.Parameter(torch.zeros(1, widths[-1]))

    def plan(self, depth: Mapping[str, Tensor], state: Tensor, noise: Tensor) -> Tensor:
        """The mean of the Gaussian, (B, 1, 13)."""
        return self.actor_mean(self.feature_net.extractors.features(depth, state[:, -1]))[
            :, None
        ]


class _Features(nn.Module):
    def __init__(self, shapes: Shapes) -> None:
        super().__init__()
        self.extractors = Extractors(shapes, "feature_net.extractors.", _CNN)
