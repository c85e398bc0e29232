"""Observations as the tensors that adapters of torch learners give to networks."""

from __future__ import annotations

from typing import Any

import torch

from mjhab.core.conventions.images import COLOURS, TARGET_DEPTH
from mjhab.envs.observations.modes import image_output

MM_PER_METRE = 1000.0
BYTE = 255.0


def observation_tensors(obs: dict[str, Any]) -> dict[str, torch.Tensor]:
    """The state and every image of an observation, float32, by "state" and "<camera>/<output>".

    Images are (W, channels, height, width); frames of `FrameStack` become channels, oldest first.

    Depth is ``1 - tanh(metres)``, as in `wrappers.normalize_depth`: 1 at the
    lens and where nothing is hit, 0.24 at 1 m. Colours and views of the target are in [0, 1]. Segmentation stays ids.
    """
    shown = {"state": torch.as_tensor(obs["state"]).float()}
    for key, value in obs.items():
        output = image_output(key)
        if output:
            image = torch.as_tensor(value).float().movedim(-1, -3)
            image = image.flatten(1, -3)
            shown[key.removeprefix("sensor_data/")] = _scaled(image, output)
    return shown


def _scaled(image: torch.Tensor, output: str) -> torch.Tensor:
    if output == "depth":
        # Equal to 1 - tanh(m), but without the cancellation that would cost far depths their digits.
        return 2.0 / (torch.exp(image * (2.0 / MM_PER_METRE)) + 1.0)
    return image / BYTE if output in (*COLOURS, TARGET_DEPTH) else image
