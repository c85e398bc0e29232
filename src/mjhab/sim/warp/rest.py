"""Find the kinematic trees that are at rest in a state, so that a world can start with them asleep."""

from __future__ import annotations

from collections import OrderedDict

import mujoco
import numpy as np

from mjhab.layout.addresses import Addresses

REST_ACCELERATION = 0.5
"""A kinematic tree counts as at rest if no dof accelerates by this [m/s^2] or more. Settled task starts have at most
0.11, a falling object has 9.8."""
_REMEMBERED = 4096
"""Most states whose result is cached."""


class RestFinder:
    """Finds the trees at rest in states of a layout's homes with C MuJoCo, and caches the results.

    Args:
        model: compiled model of any home.
        a: addresses of the layout.
    """

    def __init__(self, model: mujoco.MjModel, a: Addresses) -> None:
        self._data = mujoco.MjData(model)
        self._robot_tree = int(model.body_treeid[a.robot_body[a.robot.tcp]])
        self._known: OrderedDict[tuple[str, bytes, bytes], np.ndarray] = OrderedDict()

    def rings(
        self, home: str, model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray
    ) -> np.ndarray:
        """Return which trees may sleep in a state, in the format of MuJoCo's ``tree_asleep``.

        A tree sleeps if it has no velocity and accelerates by less than REST_ACCELERATION, and if the same holds for
        all trees of its constraint island. The robot is always awake.

        Args:
            home: name of the home.
            model: compiled model of the home.
            qpos: (nq,) positions.
            qvel: (nv,) velocities.

        Returns:
            (ntree,) int32: -1 for an awake tree; for a sleeping one the next tree of its ring, the cycle of trees that
            sleep and wake together (its own index if it is alone).
        """
        # By bits: a state that differs at all may differ in what rests.
        key = (home, qpos.tobytes(), qvel.tobytes())
        if key not in self._known:
            self._known[key] = self._ask(model, qpos, qvel)
            if len(self._known) > _REMEMBERED:
                self._known.popitem(last=False)
        return self._known[key]

    def _ask(
        self, model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray
    ) -> np.ndarray:
        data = self._data
        # The warm start of another state would change the solver's last digits.
        mujoco.mj_resetData(model, data)
        data.qpos[:] = qpos
        data.qvel[:] = qvel
        mujoco.mj_forward(model, data)
        # ``dof_length`` [m] of a rotational dof turns rad/s^2 into m/s^2 at the rim of the body.
        quiet = (np.abs(data.qacc) * model.dof_length < REST_ACCELERATION) & (
            np.asarray(qvel) == 0.0
        )
        still = np.logical_and.reduceat(quiet, model.tree_dofadr)
        # It is commanded in every step, and MuJoCo lets no tree with actuators sleep.
        still[self._robot_tree] = False
        rings = np.where(still, np.arange(model.ntree), -1).astype(np.int32)
        # Trees of one constraint island sleep together or not at all.
        for island in range(data.nisland):
            trees = np.flatnonzero(data.tree_island[: model.ntree] == island)
            # Each tree points to the next and the last to the first, as MuJoCo has it.
            rings[trees] = np.roll(trees, -1) if still[trees].all() else -1
        return rings
