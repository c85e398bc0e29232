"""The diffusion policy of MS-HAB (mshab/agents/dp): a U-Net over time, conditioned on two observations.

Depth images are joined in the alphabetical order of their names (hand, head): MS-HAB takes the order from a
gymnasium.spaces.Dict, which sorts its keys.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

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
GROUPS = 8
"""Groups of the group norms."""
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
        self.noise_pred_net = _UNet(
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


class _StepEmbedding(nn.Module):
    """Sines and cosines of the diffusion step at geometrically spaced frequencies, (B,) to (B, width)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.frequencies = width // 2

    def forward(self, step: Tensor) -> Tensor:
        rate = math.log(10000) / (self.frequencies - 1)
        angle = (
            step[:, None]
            * torch.exp(-rate * torch.arange(self.frequencies, device=step.device))[None]
        )
        return torch.cat([angle.sin(), angle.cos()], dim=-1)


class _ConvBlock(nn.Module):
    def __init__(self, inputs: int, outputs: int, kernel: int) -> None:
        super().__init__()
        conv = nn.Conv1d(inputs, outputs, kernel, padding=kernel // 2)
        self.block = nn.Sequential(conv, nn.GroupNorm(GROUPS, outputs), nn.Mish())

    def forward(self, x: Tensor) -> Tensor:
        return self.block(x)


class _ResidualBlock(nn.Module):
    """Two convolutions over time; the condition scales and shifts the features in between (FiLM)."""

    def __init__(self, inputs: int, outputs: int, condition: int, kernel: int) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(
            [_ConvBlock(inputs, outputs, kernel), _ConvBlock(outputs, outputs, kernel)]
        )
        self.cond_encoder = nn.Sequential(nn.Mish(), nn.Linear(condition, 2 * outputs))
        self.residual_conv = (
            nn.Conv1d(inputs, outputs, 1) if inputs != outputs else nn.Identity()
        )

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        scale, shift = self.cond_encoder(condition)[..., None].chunk(2, dim=1)
        return self.blocks[1](scale * self.blocks[0](x) + shift) + self.residual_conv(x)


class _Resample(nn.Module):
    def __init__(self, conv: nn.Module) -> None:
        super().__init__()
        self.conv = conv

    def forward(self, x: Tensor) -> Tensor:
        return self.conv(x)


class _UNet(nn.Module):
    def __init__(self, shapes: Shapes, step_size: int, observed: int) -> None:
        super().__init__()
        self.actions = size(shapes, f"{_NET}final_conv.1.weight", 0, ACTION_SIZE)
        first = "blocks.0.block.0.weight"
        widths = [
            size(shapes, f"{_NET}down_modules.{i}.0.{first}", 0, published)
            for i, published in enumerate((64, 128, 256))
        ]
        kernel = size(shapes, f"{_NET}down_modules.0.0.{first}", 2, 5)
        condition = step_size + observed

        def block(inputs: int, outputs: int) -> _ResidualBlock:
            return _ResidualBlock(inputs, outputs, condition, kernel)

        self.diffusion_step_encoder = nn.Sequential(
            _StepEmbedding(step_size),
            nn.Linear(step_size, 4 * step_size),
            nn.Mish(),
            nn.Linear(4 * step_size, step_size),
        )
        self.down_modules = nn.ModuleList()
        for i, (above, width) in enumerate(
            zip([self.actions, *widths], widths, strict=False)
        ):
            last = i == len(widths) - 1
            shrink = (
                nn.Identity() if last else _Resample(nn.Conv1d(width, width, 3, 2, 1))
            )
            self.down_modules.append(
                nn.ModuleList([block(above, width), block(width, width), shrink])
            )
        self.mid_modules = nn.ModuleList(
            [block(widths[-1], widths[-1]), block(widths[-1], widths[-1])]
        )
        self.up_modules = nn.ModuleList()
        for above, width in reversed(list(itertools.pairwise(widths))):
            grow = _Resample(nn.ConvTranspose1d(above, above, 4, 2, 1))
            self.up_modules.append(
                nn.ModuleList([block(2 * width, above), block(above, above), grow])
            )
        self.final_conv = nn.Sequential(
            _ConvBlock(widths[0], widths[0], kernel),
            nn.Conv1d(widths[0], self.actions, 1),
        )

    def forward(self, actions: Tensor, step: Tensor, observed: Tensor) -> Tensor:
        """Predict the noise in actions (B, 16, 13) at the diffusion step (B,), given observation features (B, C)."""
        condition = torch.cat([self.diffusion_step_encoder(step), observed], dim=-1)
        x = actions.transpose(1, 2)
        skipped = []
        for first, second, shrink in self.down_modules:  # type: ignore[misc]
            x = second(first(x, condition), condition)
            skipped.append(x)
            x = shrink(x)
        for middle in self.mid_modules:
            x = middle(x, condition)
        for first, second, grow in self.up_modules:  # type: ignore[misc]
            x = torch.cat([x, skipped.pop()], dim=1)
            x = grow(second(first(x, condition), condition))
        return self.final_conv(x).transpose(1, 2)
