"""`Sensing` of worlds on the host: the same bits with compiled loops in place of operations on small arrays.

Imported only where environments step, because it loads numba.
"""

from __future__ import annotations

import numpy as np

from mjhab.core.joints import BASE_YAW
from mjhab.core.kernels.control_step import poses_in_base, sense_hand
from mjhab.envs.parts.plan_tables import Focus
from mjhab.envs.parts.sensing import Felt, Sensing
from mjhab.sim.protocol import SimState


class HostSensing(Sensing):
    """`Sensing` for numpy arrays in float64."""

    def felt(self, state: SimState, focus: Focus) -> Felt:
        """See `Sensing.felt`, which defines it."""
        worlds = len(self._rows)
        # New arrays in every step, because the last ones may still be held by a caller.
        force = np.empty((worlds, 2, 2, 3))
        contact = np.empty((2, worlds), bool)
        tcp_pos = np.empty((worlds, 3))
        finger_dir = np.empty((worlds, 2, 3))
        sense_hand(
            state.finger_force,
            state.touch,
            state.ee_contact,
            focus.columns,
            state.body_pos,
            state.body_mat,
            self._fingers,
            self._opening,
            force,
            contact,
            tcp_pos,
            finger_dir,
        )
        return Felt(force, contact[0], contact[1], tcp_pos, finger_dir)

    def shown_in_base(
        self, base: np.ndarray, poses: np.ndarray, shown: np.ndarray
    ) -> np.ndarray:
        """See `Sensing.shown_in_base`, which defines it."""
        yaw = base[:, BASE_YAW][:, None]
        half = 0.5 * yaw
        # By numpy: compiled sine and cosine have other last bits.
        trig = np.array((np.cos(yaw), np.sin(yaw), np.cos(half), np.sin(half)))
        out = np.empty(poses.shape)
        poses_in_base(base, self._base_height, trig, poses, shown, out)
        return out
