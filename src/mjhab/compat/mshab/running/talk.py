"""Small things that scripts import of ManiSkill and SAPIEN: a logger, types, a pose, the version."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from mjhab.core.version import __version__

logger = logging.getLogger("mani_skill")
Array = torch.Tensor | np.ndarray | Sequence
Device = str | torch.device


def get_commit_info(**_: Any) -> dict[str, str]:
    """The version of mjhab, for the metadata of recorded data."""
    return {"mjhab": __version__}


def is_gpu_enabled() -> bool:
    """Whether SAPIEN's physics runs on a GPU: it does not run at all."""
    return False


class SapienPose:
    """A position [m] and a quaternion wxyz."""

    def __init__(
        self, p: Sequence[float] = (0, 0, 0), q: Sequence[float] = (1, 0, 0, 0)
    ) -> None:
        self.p = np.asarray(p, np.float32)
        self.q = np.asarray(q, np.float32)
