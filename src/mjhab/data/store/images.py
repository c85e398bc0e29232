"""Encoding of camera images: colour as PNG or JPEG, all others as lossless 16-bit PNG."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from PIL import Image

from mjhab.core.conventions.images import COLOURS
from mjhab.core.errors import unknown_name
from mjhab.core.files.reading import reason
from mjhab.core.typed.checks import check_between

RGB_FORMATS = ("png", "jpeg")
# Above every camera of a profile, and 50 MB of colours at most.
MAX_SIDE = 4096
"""Largest side of a picture that is read [px]; an encoded picture of a few bytes may claim any size."""
MAX_FRAME_BYTES = 4 * MAX_SIDE**2
"""Largest encoded picture that is read [bytes]."""
_INTEGER_MODES = ("I;16", "I")
_COLOUR_MODES = ("RGB",)
"""Pillow's names of the pixels that ``encode`` writes: integers of 16 bits, and those of colours."""
_PNG_LEVEL = 4
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_COLOURS, _GREYS = 2, 0
"""Kinds of pixels in the header of a PNG."""
_FROM_ABOVE = 2
"""The filter of PNG's rows that subtracts the row above."""
_MOST = int(np.iinfo(np.uint16).max)


@dataclass(frozen=True)
class ImageFormat:
    """Format of colour images; all others are always lossless. quality: of JPEG, 1 to 95."""

    rgb: str = "png"
    quality: int = 92

    def __post_init__(self) -> None:
        if self.rgb not in RGB_FORMATS:
            raise unknown_name("image format", self.rgb, RGB_FORMATS)
        check_between("quality", self.quality, 1, 95)


def encode(image: np.ndarray, output: str, form: ImageFormat) -> bytes:
    """Encode one frame: colours (H, W, 3) uint8, or another output (H, W, 1), integers from 0 to 65,535.

    Raises:
        ValueError: a value is out of range.
    """
    if output in COLOURS:
        if form.rgb == "png":
            return _png(image)
        file = io.BytesIO()
        # Halved colours would blur the edges of small objects.
        Image.fromarray(image).save(file, "JPEG", quality=form.quality, subsampling=0)
        return file.getvalue()
    # A cast to uint16 would wrap around without an error.
    if image.min() < 0 or image.max() > _MOST:
        raise ValueError(
            f"{output} image has values from {image.min()} to {image.max()}; 0 to {_MOST} can be stored"
        )
    return _png(image.astype(">u2"))


def _png(pixels: np.ndarray) -> bytes:
    """A PNG of (H, W, 3) uint8 or (H, W, 1) big-endian uint16.

    Every row is stored as its difference from the one above. Pillow tries all five filters of PNG on each row: depth is
    1 to 4 % smaller then, colours 4 to 8 %, and both take twice as long.
    """
    high, wide, channels = pixels.shape
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(high, -1)
    filtered = np.empty((high, rows.shape[1] + 1), np.uint8)
    filtered[:, 0] = _FROM_ABOVE
    filtered[:, 1:] = rows
    # Bytes wrap around, as the format wants it.
    filtered[1:, 1:] -= rows[:-1]
    kind = _COLOURS if channels > 1 else _GREYS
    header = struct.pack(">IIBBBBB", wide, high, 8 * pixels.itemsize, kind, 0, 0, 0)
    data = zlib.compress(filtered.tobytes(), _PNG_LEVEL)
    chunks = ((b"IHDR", header), (b"IDAT", data), (b"IEND", b""))
    parts = [_PNG_SIGNATURE]
    for name, body in chunks:
        check = zlib.crc32(body, zlib.crc32(name))
        parts += [struct.pack(">I", len(body)), name, body, struct.pack(">I", check)]
    return b"".join(parts)


def stored_frames(files: Mapping[str, Sequence[bytes]]) -> dict[str, np.ndarray]:
    """Datasets of encoded frames by path; ``files``: the frames of every "<camera>/<output>"."""
    arrays = {}
    for key, frames in files.items():
        arrays[f"images/{key}/bytes"] = np.frombuffer(b"".join(frames), np.uint8)
        sizes = [len(frame) for frame in frames]
        arrays[f"images/{key}/ends"] = np.cumsum(sizes, dtype=np.int64)
    return arrays


def decode(data: bytes, output: str) -> np.ndarray:
    """Decode a frame of ``encode``: colours (H, W, 3) uint8, depth (H, W, 1) int16, others (H, W, 1) int32.

    Raises:
        ValueError: the bytes are no such picture.
    """
    with _telling(), _opened(data, output) as picture:
        image = np.asarray(picture)
    if output in COLOURS:
        return image
    return image.astype(np.int16 if output == "depth" else np.int32)[..., None]


def camera_output(key: str) -> tuple[str, str]:
    """Camera and output of the key of an image in observations; texts that are empty for other keys."""
    parts = key.split("/")
    return (
        (parts[1], parts[2])
        if len(parts) == 3 and parts[0] == "sensor_data"
        else ("", "")
    )


def check_frame(data: bytes, output: str) -> tuple[int, int]:
    """Check a frame of ``encode`` without decoding it: header, and the checksums of a PNG; returns width and height.

    Raises:
        ValueError: the bytes are no such picture.
    """
    with _telling(), _opened(data, output) as picture:
        size = picture.size
        picture.verify()
    return size


@contextmanager
def _telling() -> Iterator[None]:
    """Turn what Pillow raises for broken pictures into ValueError."""
    try:
        yield
    except (
        Image.DecompressionBombError,
        OSError,
        SyntaxError,
        EOFError,
        struct.error,
        zlib.error,
    ) as error:
        raise ValueError(f"the bytes are no picture ({reason(error)})") from error


def _opened(data: bytes, output: str) -> Image.Image:
    """Open a picture, whose header alone is read; refuse other formats, kinds of pixels, and sizes of no camera."""
    picture = Image.open(
        # Pillow would try all its formats, some of which run other programs.
        io.BytesIO(data),
        formats=("PNG", "JPEG") if output in COLOURS else ("PNG",),
    )
    wide, high = picture.size
    if max(wide, high) > MAX_SIDE:
        raise ValueError(
            f"a picture of {wide} x {high} pixels; at most {MAX_SIDE} x {MAX_SIDE} are read"
        )
    modes = _COLOUR_MODES if output in COLOURS else _INTEGER_MODES
    if picture.mode not in modes:
        raise ValueError(
            f"a picture of {output} has pixels {' or '.join(modes)}, not {picture.mode}"
        )
    return picture
