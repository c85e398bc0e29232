"""Checkpoints with random weights under the names and with the shapes of MS-HAB's public code (mshab/agents), and what
its networks make of an observation, computed with plain functions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

Weights = dict[str, Tensor]
HEAD = "fetch_head_depth"
HAND = "fetch_hand_depth"


def _linear(name: str, outputs: int, inputs: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}


def _conv(name: str, outputs: int, *rest: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (outputs, *rest), f"{name}.bias": (outputs,)}


def _norm(name: str, width: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (width,), f"{name}.bias": (width,)}


def sac_shapes() -> dict[str, tuple[int, ...]]:
    """``Agent`` of mshab/agents/sac with configs/sac_pick.yml; its dict space lists the hand before the head."""
    shapes: dict[str, tuple[int, ...]] = {}

    def encoder(name: str) -> None:
        for camera in (HAND, HEAD):
            for i, (inputs, outputs) in enumerate(
                ((3, 32), (32, 64), (64, 128), (128, 256))
            ):
                shapes.update(
                    _conv(f"{name}.cnns.{camera}.layers.{2 * i}", outputs, inputs, 3, 3)
                )
        for camera in (HAND, HEAD):
            shapes.update(
                _linear(f"{name}.pixels_projections.{camera}.projection.0", 50, 12544)
            )
            shapes.update(_norm(f"{name}.pixels_projections.{camera}.projection.1", 50))
        shapes.update(_linear(f"{name}.state_projection.projection.0", 50, 42))
        shapes.update(_norm(f"{name}.state_projection.projection.1", 50))

    encoder("actor.encoder")
    for i, (inputs, outputs) in enumerate(
        ((150, 256), (256, 256), (256, 256), (256, 26))
    ):
        shapes.update(_linear(f"actor.mlp.{2 * i}", outputs, inputs))
    for critic in ("critic", "critic_target"):
        encoder(f"{critic}.encoder")
        for q in ("Q1", "Q2"):
            for i, (inputs, outputs) in enumerate(((163, 256), (256, 256), (256, 256))):
                shapes.update(_linear(f"{critic}.{q}.mlp.{3 * i}", outputs, inputs))
                shapes.update(_norm(f"{critic}.{q}.mlp.{3 * i + 1}", outputs))
            shapes.update(_linear(f"{critic}.{q}.mlp.9", 1, 256))
    return shapes


def ppo_shapes() -> dict[str, tuple[int, ...]]:
    """``Agent`` of mshab/agents/ppo."""
    shapes: dict[str, tuple[int, ...]] = {"actor_logstd": (1, 13)}
    for camera in (HEAD, HAND):
        name = f"feature_net.extractors.{camera}"
        shapes |= _conv(f"{name}.0.0", 32, 3, 8, 8) | _conv(f"{name}.0.2", 64, 32, 4, 4)
        shapes |= _conv(f"{name}.0.4", 64, 64, 3, 3) | _linear(f"{name}.1.0", 256, 9216)
    shapes |= _linear("feature_net.extractors.state", 256, 42)
    shapes |= _linear("critic.0", 512, 768) | _linear("critic.2", 1, 512)
    return shapes | _linear("actor_mean.0", 512, 768) | _linear("actor_mean.2", 13, 512)


def bc_shapes(frames: int = 1) -> dict[str, tuple[int, ...]]:
    """``Agent`` of mshab/agents/bc with configs/bc_pick.yml."""
    shapes: dict[str, tuple[int, ...]] = {}
    for camera in (HEAD, HAND):
        name = f"extractors.{camera}"
        sizes = ((frames, 24, 5), (24, 36, 5), (36, 48, 5), (48, 64, 3), (64, 64, 3))
        for i, (inputs, outputs, kernel) in enumerate(sizes):
            shapes |= _conv(f"{name}.0.{2 * i}", outputs, inputs, kernel, kernel)
        shapes |= _linear(f"{name}.1.0", 1024, 5184)
    shapes |= _linear("extractors.state", 1024, 42)
    for i, (inputs, outputs) in enumerate(
        ((3072, 2048), (2048, 1024), (1024, 512), (512, 13))
    ):
        shapes |= _linear(f"mlp.{2 * i}", outputs, inputs)
    return shapes


def dp_shapes() -> dict[str, tuple[int, ...]]:
    """``Agent`` of mshab/agents/dp with configs/dp_pick.yml."""
    shapes: dict[str, tuple[int, ...]] = {}
    for i, (inputs, outputs) in enumerate(((2, 16), (16, 32), (32, 64), (64, 128))):
        shapes |= _conv(f"visual_encoder.cnn.{3 * i}", outputs, inputs, 3, 3)
    shapes |= _conv("visual_encoder.cnn.12", 128, 128, 1, 1) | _linear(
        "visual_encoder.fc.0", 256, 128
    )
    condition = 64 + 2 * (256 + 42)

    def block(name: str, inputs: int, outputs: int) -> None:
        for i, width in enumerate((inputs, outputs)):
            shapes.update(_conv(f"{name}.blocks.{i}.block.0", outputs, width, 5))
            shapes.update(_norm(f"{name}.blocks.{i}.block.1", outputs))
        shapes.update(_linear(f"{name}.cond_encoder.1", 2 * outputs, condition))
        if inputs != outputs:
            shapes.update(_conv(f"{name}.residual_conv", outputs, inputs, 1))

    for i in range(2):
        block(f"noise_pred_net.mid_modules.{i}", 256, 256)
    shapes |= _linear("noise_pred_net.diffusion_step_encoder.1", 256, 64)
    shapes |= _linear("noise_pred_net.diffusion_step_encoder.3", 64, 256)
    for i, (inputs, outputs) in enumerate(((256, 128), (128, 64))):
        block(f"noise_pred_net.up_modules.{i}.0", 2 * inputs, outputs)
        block(f"noise_pred_net.up_modules.{i}.1", outputs, outputs)
        shapes |= _conv(f"noise_pred_net.up_modules.{i}.2.conv", outputs, outputs, 4)
    for i, (inputs, outputs) in enumerate(((13, 64), (64, 128), (128, 256))):
        block(f"noise_pred_net.down_modules.{i}.0", inputs, outputs)
        block(f"noise_pred_net.down_modules.{i}.1", outputs, outputs)
        if i < 2:
            shapes |= _conv(
                f"noise_pred_net.down_modules.{i}.2.conv", outputs, outputs, 3
            )
    shapes |= _conv("noise_pred_net.final_conv.0.block.0", 64, 64, 5) | _norm(
        "noise_pred_net.final_conv.0.block.1", 64
    )
    return shapes | _conv("noise_pred_net.final_conv.1", 13, 64, 1)


def random_weights(shapes: Mapping[str, tuple[int, ...]], seed: int = 0) -> Weights:
    """Normal numbers that keep the size of what goes through a layer."""
    generator = torch.Generator().manual_seed(seed)
    return {
        name: torch.randn(shape, generator=generator)
        * (math.prod(shape[1:]) ** -0.5 if len(shape) > 1 else 0.3)
        for name, shape in shapes.items()
    }


def save(path: Path, weights: Weights, **more: Any) -> Path:
    """Write a checkpoint as the original's train scripts do, with an optimizer beside the policy."""
    optimizer = {
        "state": {0: {"step": torch.tensor(1.0)}},
        "param_groups": [{"lr": 3e-4, "betas": (0.9, 0.999)}],
    }
    torch.save({"agent": weights, "optimizer": optimizer, **more}, path)
    return path


def _apply(w: Weights, name: str, x: Tensor) -> Tensor:
    return F.linear(x, w[f"{name}.weight"], w[f"{name}.bias"])


def _convolve(w: Weights, name: str, x: Tensor, **options: Any) -> Tensor:
    return F.conv2d(x, w[f"{name}.weight"], w[f"{name}.bias"], **options)


def sac_action(w: Weights, depth: dict[str, Tensor], state: Tensor) -> Tensor:
    """Of one world: depth by camera (F, 128, 128) [mm], state (F, 42); gives (13,)."""
    parts = []
    for camera in (HAND, HEAD):
        x = depth[camera][None]
        for i in range(4):
            x = _convolve(w, f"actor.encoder.cnns.{camera}.layers.{2 * i}", x, stride=2)
            x = x.relu() if i < 3 else x
        parts.append(
            (f"actor.encoder.pixels_projections.{camera}.projection", x.flatten())
        )
    parts.append(("actor.encoder.state_projection.projection", state[-1]))
    encoded = [
        F.layer_norm(
            _apply(w, f"{name}.0", x), (50,), w[f"{name}.1.weight"], w[f"{name}.1.bias"]
        ).tanh()
        for name, x in parts
    ]
    x = torch.cat(encoded)
    for i in range(4):
        x = _apply(w, f"actor.mlp.{2 * i}", x)
        x = x.relu() if i < 3 else x
    return x[:13].tanh()


def _extract(
    w: Weights,
    prefix: str,
    strides: tuple[int, ...],
    depth: dict[str, Tensor],
    state: Tensor,
) -> Tensor:
    parts = []
    for camera in (HEAD, HAND):
        x = 1 - torch.tanh(depth[camera][None] / 1000)
        for i, stride in enumerate(strides):
            x = _convolve(w, f"{prefix}{camera}.0.{2 * i}", x, stride=stride).relu()
        parts.append(_apply(w, f"{prefix}{camera}.1.0", x.flatten()).relu())
    return torch.cat([*parts, _apply(w, f"{prefix}state", state[-1])])


def ppo_action(w: Weights, depth: dict[str, Tensor], state: Tensor) -> Tensor:
    """Like ``sac_action``."""
    x = _extract(w, "feature_net.extractors.", (4, 2, 1), depth, state)
    return _apply(w, "actor_mean.2", _apply(w, "actor_mean.0", x).relu())


def bc_action(w: Weights, depth: dict[str, Tensor], state: Tensor) -> Tensor:
    """Like ``sac_action``."""
    x = _extract(w, "extractors.", (2, 2, 2, 1, 1), depth, state)
    for i in range(4):
        x = _apply(w, f"mlp.{2 * i}", x)
        x = x.relu() if i < 3 else x
    return x


def dp_plan(w: Weights, depth: dict[str, Tensor], state: Tensor, noise: Tensor) -> Tensor:
    """Of one world: 8 actions (8, 13) from noise (100, 16, 13)."""
    seen = []
    for frame in range(2):
        x = torch.stack(
            [1 - torch.tanh(depth[camera][frame] / 1000) for camera in (HAND, HEAD)]
        )[None]
        for i in range(4):
            x = F.max_pool2d(
                _convolve(w, f"visual_encoder.cnn.{3 * i}", x, padding=1).relu(), 2
            )
        x = (
            _convolve(w, "visual_encoder.cnn.12", x)
            .relu()
            .flatten(2)
            .max(dim=2)
            .values[0]
        )
        seen.append(torch.cat([_apply(w, "visual_encoder.fc.0", x).relu(), state[frame]]))
    observed = torch.cat(seen)
    # Ho et al. 2020, equations 6, 7 and 15, on the cosine schedule with its offset of 0.008.
    cosine = [math.cos((i / 100 + 0.008) / 1.008 * math.pi / 2) ** 2 for i in range(101)]
    betas = torch.tensor(
        [min(1 - cosine[i + 1] / cosine[i], 0.999) for i in range(100)],
        dtype=torch.float64,
    )
    alphas = 1 - betas
    bars = torch.cumprod(1 - betas, 0)
    x = noise[0]
    for t in reversed(range(100)):
        predicted = _unet(w, x, t, observed)
        bar = float(bars[t])
        bar_before = float(bars[t - 1]) if t else 1.0
        clean = ((x - math.sqrt(1 - bar) * predicted) / math.sqrt(bar)).clamp(-1, 1)
        x = (
            math.sqrt(bar_before) * float(betas[t]) / (1 - bar) * clean
            + math.sqrt(float(alphas[t])) * (1 - bar_before) / (1 - bar) * x
        )
        if t:
            x = (
                x
                + math.sqrt((1 - bar_before) / (1 - bar) * float(betas[t]))
                * noise[100 - t]
            )
    return x[1:9]


def _unet(w: Weights, actions: Tensor, step: int, observed: Tensor) -> Tensor:
    net = "noise_pred_net."
    rates = torch.exp(torch.arange(32) * (-math.log(10000) / 31))
    embedded = torch.cat([(step * rates).sin(), (step * rates).cos()])
    embedded = F.mish(_apply(w, f"{net}diffusion_step_encoder.1", embedded))
    condition = torch.cat(
        [_apply(w, f"{net}diffusion_step_encoder.3", embedded), observed]
    )

    def conv_block(name: str, x: Tensor) -> Tensor:
        x = F.conv1d(x, w[f"{name}.block.0.weight"], w[f"{name}.block.0.bias"], padding=2)
        return F.mish(
            F.group_norm(x, 8, w[f"{name}.block.1.weight"], w[f"{name}.block.1.bias"])
        )

    def block(name: str, x: Tensor) -> Tensor:
        film = _apply(w, f"{name}.cond_encoder.1", F.mish(condition)).reshape(2, -1, 1)
        inner = conv_block(
            f"{name}.blocks.1", film[0] * conv_block(f"{name}.blocks.0", x) + film[1]
        )
        key = f"{name}.residual_conv"
        return inner + (
            F.conv1d(x, w[f"{key}.weight"], w[f"{key}.bias"])
            if f"{key}.weight" in w
            else x
        )

    def pair(name: str, x: Tensor) -> Tensor:
        return block(f"{name}.1", block(f"{name}.0", x))

    x = actions.T[None]
    kept = []
    for i in range(3):
        name = f"{net}down_modules.{i}"
        x = pair(name, x)
        kept.append(x)
        if i < 2:
            x = F.conv1d(
                x,
                w[f"{name}.2.conv.weight"],
                w[f"{name}.2.conv.bias"],
                stride=2,
                padding=1,
            )
    x = pair(f"{net}mid_modules", x)
    for i in range(2):
        name = f"{net}up_modules.{i}"
        x = pair(name, torch.cat([x, kept[2 - i]], dim=1))
        x = F.conv_transpose1d(
            x, w[f"{name}.2.conv.weight"], w[f"{name}.2.conv.bias"], stride=2, padding=1
        )
    x = conv_block(f"{net}final_conv.0", x)
    return F.conv1d(x, w[f"{net}final_conv.1.weight"], w[f"{net}final_conv.1.bias"])[0].T
