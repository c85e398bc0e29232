"""What the adapters of torch learners show of observations: images scaled, channels first."""

from __future__ import annotations

import numpy as np
import torch

from mjhab.envs.wrappers import normalize_depth
from mjhab.integrations.tensors import observation_tensors

CAMERA = "sensor_data/fetch_hand"


def test_images_are_scaled_and_channels_come_first() -> None:
    rng = np.random.default_rng(0)
    depth = rng.integers(0, 32767, (2, 5, 4, 1)).astype(np.int16)
    rgb = rng.integers(0, 256, (2, 5, 4, 3)).astype(np.uint8)
    seg = rng.integers(0, 90, (2, 5, 4, 1)).astype(np.int16)
    shown = observation_tensors(
        {
            "agent/qpos": np.zeros((2, 3)),
            "state": np.zeros((2, 42)),
            f"{CAMERA}/depth": depth,
            f"{CAMERA}/rgb": rgb,
            f"{CAMERA}/seg": seg,
            f"{CAMERA}/pointcloud": np.zeros((2, 9, 4)),
        }
    )
    assert list(shown) == [
        "state",
        *(f"fetch_hand/{kind}" for kind in ("depth", "rgb", "seg")),
    ]
    assert all(value.dtype == torch.float32 for value in shown.values())
    wanted = np.moveaxis(normalize_depth(depth), -1, 1)
    np.testing.assert_allclose(shown["fetch_hand/depth"], wanted, atol=1e-6)
    np.testing.assert_allclose(shown["fetch_hand/rgb"], np.moveaxis(rgb, -1, 1) / 255)
    np.testing.assert_array_equal(shown["fetch_hand/seg"], np.moveaxis(seg, -1, 1))


def test_stacked_frames_are_channels() -> None:
    frames = np.arange(2 * 3 * 5 * 4 * 3).reshape(2, 3, 5, 4, 3).astype(np.uint8)
    shown = observation_tensors({"state": np.zeros((2, 1)), f"{CAMERA}/seg": frames})
    image = shown["fetch_hand/seg"]
    assert image.shape == (2, 9, 5, 4)
    np.testing.assert_array_equal(image[:, 3:6], np.moveaxis(frames[:, 1], -1, 1))
