"""Names of the images that cameras give."""

from __future__ import annotations

RGB = "rgb"
TARGET_DEPTH = "target_depth"
"""Depth around the target of the active subtask relative to its distance, see `render.target_views`."""
TARGET_RGB = "target_rgb"
"""Colours around the target of the active subtask, see `render.target_views`."""
TARGET_OUTPUTS = (TARGET_DEPTH, TARGET_RGB)
COLOURS = (RGB, TARGET_RGB)
"""Images of three bytes per pixel; all others have one number."""


def channels_of(output: str) -> int:
    """Number of channels of an image."""
    return 3 if output in COLOURS else 1
