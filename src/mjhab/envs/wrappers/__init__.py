"""Observation wrappers for vector environments, right in every autoreset mode and under partial resets.

The usual order is FrameStack, then NormalizeImages (a whole stack of small integers is cheaper to keep than one of
floats), then FlattenStatePixels. Episode returns: ``gymnasium.wrappers.vector.RecordEpisodeStatistics``.
"""

from mjhab.envs.wrappers.flatten import FlattenStatePixels
from mjhab.envs.wrappers.frame_stack import FrameStack
from mjhab.envs.wrappers.normalize import NormalizeImages, denormalize_depth, normalize_depth

__all__ = [
    "FlattenStatePixels",
    "FrameStack",
    "NormalizeImages",
    "denormalize_depth",
    "normalize_depth",
]
