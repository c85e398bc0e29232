"""Poses of many worlds as scripts read them: positions, quaternions wxyz, products, inverses."""

from __future__ import annotations

from typing import Any

import torch

from mjhab.core.rotations import mat_from_quat, pose_inv, pose_mul


class PoseBatch:
    """(n, 7) poses: position [m] and quaternion wxyz, float32 tensors.

    Args:
        raw_pose: (n, 7).
    """

    def __init__(self, raw_pose: torch.Tensor) -> None:
        self.raw_pose = raw_pose

    @classmethod
    def create(cls, pose: Any, device: Any = None) -> PoseBatch:
        """From (n, 7) or (7,) numbers, or from a pose."""
        if isinstance(pose, PoseBatch):
            return pose
        raw = torch.as_tensor(pose, dtype=torch.float32, device=device)
        return cls(raw[None] if raw.ndim == 1 else raw)

    @classmethod
    def create_from_pq(
        cls, p: Any = None, q: Any = None, device: Any = None
    ) -> PoseBatch:
        """From positions (n, 3) or (3,) and quaternions (n, 4) or (4,); by default 0, and no rotation."""
        given = [
            torch.atleast_2d(torch.as_tensor(part, dtype=torch.float32, device=device))
            for part in (
                (0.0, 0.0, 0.0) if p is None else p,
                (1.0, 0.0, 0.0, 0.0) if q is None else q,
            )
        ]
        rows = max(len(part) for part in given)
        return cls(torch.cat([part.expand(rows, -1) for part in given], dim=1))

    @property
    def p(self) -> torch.Tensor:
        """(n, 3) positions [m]."""
        return self.raw_pose[:, :3]

    @property
    def q(self) -> torch.Tensor:
        """(n, 4) quaternions wxyz."""
        return self.raw_pose[:, 3:]

    def inv(self) -> PoseBatch:
        """The inverse of every pose."""
        return PoseBatch(pose_inv(self.raw_pose))

    def __mul__(self, other: PoseBatch) -> PoseBatch:
        """Poses given in the frames of these, in the frame in which these are."""
        one, two = torch.broadcast_tensors(self.raw_pose, other.raw_pose)
        return PoseBatch(pose_mul(one, two))

    def to_transformation_matrix(self) -> torch.Tensor:
        """(n, 4, 4) matrices."""
        out = torch.zeros(len(self.raw_pose), 4, 4, device=self.raw_pose.device)
        out[:, :3, :3] = mat_from_quat(self.q)
        out[:, :3, 3] = self.p
        out[:, 3, 3] = 1.0
        return out

    def __getitem__(self, rows: Any) -> PoseBatch:
        return PoseBatch.create(self.raw_pose[rows])

    def __len__(self) -> int:
        return len(self.raw_pose)

    @property
    def shape(self) -> torch.Size:
        """That of ``raw_pose``."""
        return self.raw_pose.shape

    @property
    def device(self) -> torch.device:
        """Device of the numbers."""
        return self.raw_pose.device


def vectorize_pose(pose: Any, device: Any = None) -> torch.Tensor:
    """(n, 7) numbers of poses."""
    return PoseBatch.create(pose, device).raw_pose
