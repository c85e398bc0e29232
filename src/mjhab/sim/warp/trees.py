"""Where the kinematic trees of a model lie in its generalized positions and velocities."""

from __future__ import annotations

import mujoco
import numpy as np


def tree_spans(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """First entry and number of entries (ntree, 2) int32 of every tree in ``qpos``, and the same in ``qvel``."""
    spans_q = np.zeros((model.ntree, 2), np.int32)
    spans_v = np.zeros((model.ntree, 2), np.int32)
    for tree in range(model.ntree):
        first = int(model.tree_dofadr[tree])
        count = int(model.tree_dofnum[tree])
        spans_v[tree] = first, count
        low = model.dof_jntid[first]
        high = model.dof_jntid[first + count - 1]
        start = int(model.jnt_qposadr[low])
        # Up to the next joint: a free joint has one number more in qpos than dofs.
        end = int(model.jnt_qposadr[high + 1]) if high + 1 < model.njnt else model.nq
        spans_q[tree] = start, end - start
    return spans_q, spans_v
