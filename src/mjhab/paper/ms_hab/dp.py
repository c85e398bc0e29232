"""The diffusion policy of MS-HAB (mshab/agents/dp): a U-Net over time, conditioned on two observations.

Depth images are joined in the alphabetical order of their names (hand, head): MS-HAB takes the order from a
gymnasium.spaces.Dict, which sorts its keys.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from mjhab.learning.students.diffusion import UNet
from mjhab.paper.ms_hab import ddpm
from mjhab.paper.ms_hab.network import (
    ACTION_SIZE,
    CAMERAS,
    STATE_SIZE,
    Network,
    Shapes,
    size,
    squash_depth,
)

ACT_STEPS = 8
"""Number of actions of a plan that are executed."""
PLAN_STEPS = 16
"""Number of actions in a plan."""
_NET = "noise_pred_net."
_CONVS = (16, 32, 64, 128)


class Dp(Network):
    """Takes the last two observations, depth as 1 - tanh(mm / 1000), and plans 16 actions, 8 of which are executed."""

    cameras = tuple(sorted(CAMERAS))

    def __init__(self, shapes: Shapes) -> None:
        super().__init__()
        features = size(shapes, "visual_encoder.fc.0.weight", 0, 256)
        step_size = size(shapes, f"{_NET}diffusion_step_encoder.3.weight", 0, 64)
        condition = size(
            shapes,
            f"{_NET}mid_modules.0.cond_encoder.1.weight",
            1,
            step_size + 2 * (256 + STATE_SIZE),
        )
        self.frames = max(1, (condition - step_size) // (features + STATE_SIZE))
        self.visual_encoder = _VisualEncoder(shapes, len(self.cameras), features)
        self.noise_pred_net = PublishedUNet(
            shapes, step_size, self.frames * (features + STATE_SIZE)
        )
        self.noise_shape = (ddpm.STEPS, PLAN_STEPS, self.noise_pred_net.actions)

    def plan(self, depth: Mapping[str, Tensor], state: Tensor, noise: Tensor) -> Tensor:
        """The 8 actions to execute, (B, 8, 13)."""
        images = squash_depth(
            torch.stack([depth[camera] for camera in self.cameras], dim=2)
        )
        seen = self.visual_encoder(images.flatten(0, 1)).unflatten(0, images.shape[:2])
        condition = torch.cat([seen, state], dim=-1).flatten(1)

        def predict(actions: Tensor, step: Tensor) -> Tensor:
            return self.noise_pred_net(actions, step, condition)

        # The plan begins at the oldest frame; actions of the past are not executed.
        start = self.frames - 1
        return ddpm.sample(predict, noise)[:, start : start + ACT_STEPS]


class _VisualEncoder(nn.Module):
    def __init__(self, shapes: Shapes, cameras: int, features: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = cameras
        for i, published in enumerate(_CONVS):
            width = size(shapes, f"visual_encoder.cnn.{3 * i}.weight", 0, published)
            layers += [
                nn.Conv2d(channels, width, 3, padding=1),
                nn.ReLU(),
                nn.MaxPool2d(2),
            ]
            channels = width
        self.cnn = nn.Sequential(*layers, nn.Conv2d(channels, channels, 1), nn.ReLU())
        self.fc = nn.Sequential(nn.Linear(channels, features), nn.ReLU())

    def forward(self, images: Tensor) -> Tensor:
        return self.fc(self.cnn(images).amax(dim=(2, 3)))


class PublishedUNet(UNet):
    """The network of our own diffusion policy, with MS-HAB's sizes and names of parameters.

    Args:
        shapes: of the parameters of a checkpoint. step_size: width of what is made of the diffusion step. observed: of
            the observation features.
    """

    def __init__(self, shapes: Shapes, step_size: int, observed: int) -> None:
        actions = size(shapes, f"{_NET}final_conv.1.weight", 0, ACTION_SIZE)
        first = "blocks.0.block.0.weight"
        widths = [
            size(shapes, f"{_NET}down_modules.{i}.0.{first}", 0, published)
            for i, published in enumerate((64, 128, 256))
        ]
        kernel = size(shapes, f"{_NET}down_modules.0.0.{first}", 2, 5)
        super().__init__(actions, observed, widths, kernel, step_size)
        self.actions = actions
        half = step_size // 2
        # In this order of operations: the last bits of the published actions depend on it.
        rate = math.log(10000) / max(half - 1, 1)
        frequencies = torch.exp(-rate * torch.arange(half))
        # Not persistent: checkpoints of MS-HAB have no such entry.
        self.register_buffer("frequencies", frequencies, persistent=False)
        self.register_state_dict_post_hook(_publish_names)
        self.register_load_state_dict_pre_hook(_own_names)


_NAMES = (
    (r"^clock\.0", "diffusion_step_encoder.1"),
    (r"^clock\.2", "diffusion_step_encoder.3"),
    (r"^(down|up)\.(\d+)\.2", r"\1_modules.\2.2.conv"),
    (r"^(down|up)\.", r"\1_modules."),
    (r"^middle", "mid_modules"),
    (r"\.first\.", ".blocks.0.block."),
    (r"\.second\.", ".blocks.1.block."),
    (r"\.film\.", ".cond_encoder."),
    (r"\.past\.", ".residual_conv."),
    (r"^out\.0", "final_conv.0.block"),
    (r"^out\.1", "final_conv.1"),
)
"""Our names of parameters, and MS-HAB's."""


def _published(name: str) -> str:
    """MS-HAB's name of a parameter."""
    for ours, theirs in _NAMES:
        name = re.sub(ours, theirs, name)
    return name


def _publish_names(_: nn.Module, state: dict[str, Any], prefix: str, __: Any) -> None:
    for key in [key for key in state if key.startswith(prefix)]:
        state[prefix + _published(key.removeprefix(prefix))] = state.pop(key)


def _own_names(network: nn.Module, state: dict[str, Any], prefix: str, *_: Any) -> None:
    for name, _parameter in network.named_parameters():
        key = prefix + _published(name)
        if key in state:
            state[prefix + name] = state.pop(key)
