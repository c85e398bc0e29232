"""Normalisation of images to floats, and its inverse."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv

from mjhab.core.conventions.images import COLOURS
from mjhab.core.errors import unknown_name
from mjhab.core.typed.checks import check
from mjhab.envs.observations.cameras import DEPTH_MAX, DEPTH_SCALE
from mjhab.envs.spaces import ordered_dict, with_entries
from mjhab.envs.wrappers.base import ImageLeaf, ObservationMap, dict_space, require_images

DEPTH_WAYS = ("tanh", "linear", "raw")
RGB_WAYS = ("unit", "imagenet", "raw")
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
"""Mean and standard deviation of sRGB channels in 0..1, as the models of torchvision expect them."""
DEPTH_CLIP = 10.0
"""Default of the distance [m] at which "linear" clips."""


def normalize_depth(
    mm: np.ndarray, curve: str = "tanh", clip: float = DEPTH_CLIP
) -> np.ndarray:
    """Depth [mm], any shape, as float32 in [0, 1].

    ``curve`` "tanh": 1 - tanh(mm / 1000), as the networks of MS-HAB have it (mshab/agents): 1 at the lens, 0.24 at 1 m,
    and 1 where nothing is hit. "linear": min(mm / 1000, clip) / clip, 0 where nothing is hit.
    """
    metres = np.asarray(mm, np.float32) * np.float32(1.0 / DEPTH_SCALE)
    if curve == "linear":
        return np.minimum(metres, np.float32(clip)) * np.float32(1.0 / clip)
    # Equal to 1 - tanh(m), but without the cancellation that would cost far depths their digits.
    return np.float32(2.0) / (np.exp(np.float32(2.0) * metres) + np.float32(1.0))


def denormalize_depth(
    value: np.ndarray, curve: str = "tanh", clip: float = DEPTH_CLIP
) -> np.ndarray:
    """Inverse of `normalize_depth`: int16 [mm]; depths beyond ``clip`` come back as ``clip``."""
    given = np.asarray(value, np.float64)
    positive = np.maximum(given, np.finfo(np.float32).tiny)
    metres = given * clip if curve == "linear" else 0.5 * np.log(2.0 / positive - 1.0)
    return np.clip(np.rint(metres * DEPTH_SCALE), 0, DEPTH_MAX).astype(np.int16)


class NormalizeImages(ObservationMap):
    """Depth and RGB images as float32; segmentation, views of the target and everything else pass unchanged.

    Works on the images of an environment, of FrameStack and of FlattenStatePixels.

    Args:
        env: vector environment with images.
        depth: "tanh" or "linear", see `normalize_depth`; "raw" leaves millimetres.
        rgb: "unit" for [0, 1]; "imagenet" for (x / 255 - mean) / std per channel; "raw" leaves bytes.
        depth_clip: farthest distance [m] of "linear".

    Raises:
        UsageError: unknown curve, depth_clip not above 0, no images.
    """

    def __init__(
        self,
        env: VectorEnv,
        depth: str = "tanh",
        rgb: str = "unit",
        depth_clip: float = DEPTH_CLIP,
    ) -> None:
        if depth not in DEPTH_WAYS:
            raise unknown_name("depth normalization", depth, DEPTH_WAYS)
        if rgb not in RGB_WAYS:
            raise unknown_name("rgb normalization", rgb, RGB_WAYS)
        check(
            depth_clip > 0.0,
            "depth_clip",
            depth_clip,
            "above 0 m",
            where="NormalizeImages",
        )
        self._depth = depth
        self._rgb = rgb
        self._clip = float(depth_clip)
        curves = {"depth": depth, **dict.fromkeys(COLOURS, rgb)}
        leaves = require_images(env, "NormalizeImages", flat=True)
        self._leaves = tuple(
            leaf for leaf in leaves if curves.get(leaf.output, "raw") != "raw"
        )
        super().__init__(env, self._space(dict_space(env, "NormalizeImages")))

    def observation(self, obs: dict[str, Any]) -> dict[str, Any]:
        """An observation of all worlds with its images normalised."""
        return self._changed(obs, self._forward)

    def inverse(self, obs: dict[str, Any]) -> dict[str, Any]:
        """The observation that `observation` turns into ``obs``: int16 millimetres and uint8 colours."""
        return self._changed(obs, self._backward)

    def _changed(
        self, obs: dict[str, Any], change: Callable[[np.ndarray, ImageLeaf], np.ndarray]
    ) -> dict[str, Any]:
        out = dict(obs)
        for leaf in self._leaves:
            *above, key = leaf.path
            inner = out
            for name in above:
                # Copied once per image: the observation that was given stays as it was.
                inner[name] = dict(inner[name])
                inner = inner[name]
            inner[key] = change(inner[key], leaf)
        return out

    def _forward(self, image: np.ndarray, leaf: ImageLeaf) -> np.ndarray:
        if leaf.output == "depth":
            return normalize_depth(image, self._depth, self._clip)
        mean, std = self._scales(leaf, image.ndim)
        return (np.asarray(image, np.float32) - mean) / std

    def _backward(self, image: np.ndarray, leaf: ImageLeaf) -> np.ndarray:
        if leaf.output == "depth":
            return denormalize_depth(image, self._depth, self._clip)
        mean, std = self._scales(leaf, image.ndim)
        return np.clip(np.rint(image * std + mean), 0, 255).astype(np.uint8)

    def _scales(self, leaf: ImageLeaf, ndim: int) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation in units of bytes, shaped to the axis of channels."""
        if self._rgb == "unit":
            return np.float32(0.0), np.float32(255.0)  # type: ignore[return-value]
        shape = [1] * ndim
        shape[leaf.channels] = 3
        mean, std = (
            np.array(v, np.float32).reshape(shape) * np.float32(255.0)
            for v in (IMAGENET_MEAN, IMAGENET_STD)
        )
        return mean, std

    def _space(self, space: spaces.Dict) -> spaces.Dict:
        boxes = {
            key: dict(value.spaces) if isinstance(value, spaces.Dict) else value
            for key, value in space.items()
        }

        def bounds(image: np.ndarray, leaf: ImageLeaf) -> Any:
            if leaf.output == "depth":
                return spaces.Box(0.0, 1.0, image.shape, np.float32)
            low, high = (self._forward(np.full_like(image, v), leaf) for v in (0, 255))
            return spaces.Box(low, high, dtype=np.float32)

        for leaf in self._leaves:
            *above, key = leaf.path
            inner: Any = boxes
            for name in above:
                inner = inner[name]
            inner[key] = bounds(inner[key].low, leaf)
        return with_entries(
            space,
            {k: ordered_dict(v) if isinstance(v, dict) else v for k, v in boxes.items()},
        )
