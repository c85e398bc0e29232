"""Conversion of numbers to integers in one pass over memory, compiled."""

from __future__ import annotations

import numpy as np

from mjhab.core.kernels.jit import compiler


@compiler("core.kernels.integers", fastmath={"nnan"})
def scaled_int16(
    images: np.ndarray, camera: int, scale: np.float32, most: np.float32, out: np.ndarray
) -> None:
    """Write ``images[:, camera] * scale``, at most ``most``, rounded to the nearest integer (halves to the even one).

    ``images`` (W, C, h, w) float32, contiguous, so that the compiler vectorises the loop; ``out`` (W, h, w) int16.
    """
    worlds, height, width = out.shape
    for world in range(worlds):
        for row in range(height):
            # Unsigned: without a test for negative indices the loop is vectorised.
            for column in range(np.uint64(width)):
                # Before the conversion: what does not fit into 16 bits would wrap around.
                scaled = min(images[world, camera, row, column] * scale, most)
                out[world, row, column] = np.int16(np.int32(np.rint(scaled)))
