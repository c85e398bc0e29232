"""Observation wrappers for vector environments, for every autoreset mode and partial resets.

The usual order is FrameStack, NormalizeImages, FlattenStatePixels: a stack of integer images takes less memory than one
of floats. For episode returns use ``gymnasium.wrappers.vector.RecordEpisodeStatistics``.
"""

from mjhab.envs.wrappers.flatten import FlattenStatePixels
from mjhab.envs.wrappers.frame_stack import FrameStack
from mjhab.envs.wrappers.normalize import (
    NormalizeImages,
    denormalize_depth,
    normalize_depth,
)

__all__ = [
    "FlattenStatePixels",
    "FrameStack",
    "NormalizeImages",
    "denormalize_depth",
    "normalize_depth",
]
