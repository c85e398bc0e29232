"""Encoding of camera images: colour as PNG or JPEG, depth and segmentation as lossless 16-bit PNG."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from PIL import Image

from mjhab.core.errors import UsageError, unknown_name

RGB_FORMATS = ("png", "jpeg")
_PNG_LEVEL = 4
_MOST = int(np.iinfo(np.uint16).max)


@dataclass(frozen=True)
class ImageFormat:
    """Format of colour images; depth and segmentation are always lossless. quality: of JPEG, 1 to 95."""

    rgb: str = "png"
    quality: int = 92

    def __post_init__(self) -> None:
        if self.rgb not in RGB_FORMATS:
            raise unknown_name("image format", self.rgb, RGB_FORMATS)
        if not 1 <= self.quality <= 95:
            raise UsageError(f"the quality of JPEG images is 1 to 95, got {self.quality}")


def encode(image: np.ndarray, output: str, form: ImageFormat) -> bytes:
    """Encode one frame: rgb (H, W, 3) uint8, or depth or seg (H, W, 1) integers from 0 to 65,535.

    Raises:
        ValueError: a value is out of range.
    """
    file = io.BytesIO()
    if output == "rgb":
        picture = Image.fromarray(image)
        if form.rgb == "jpeg":
            picture.save(file, "JPEG", quality=form.quality, subsampling=0)
        else:
            picture.save(file, "PNG", compress_level=_PNG_LEVEL)
        return file.getvalue()
    if image.min() < 0 or image.max() > _MOST:
        raise ValueError(
            f"{output} image has values from {image.min()} to {image.max()}; 0 to {_MOST} can be stored"
        )
    Image.fromarray(image[..., 0].astype(np.uint16)).save(file, "PNG", compress_level=_PNG_LEVEL)
    return file.getvalue()


def decode(data: bytes, output: str) -> np.ndarray:
    """Decode a frame of ``encode``: rgb (H, W, 3) uint8, depth (H, W, 1) int16, seg (H, W, 1) int32."""
    image = np.asarray(Image.open(io.BytesIO(data)))
    if output == "rgb":
        return image
    return image.astype(np.int16 if output == "depth" else np.int32)[..., None]
