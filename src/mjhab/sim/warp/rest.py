"""What lies still in a state, so that a world can start with it asleep."""

from __future__ import annotations

from collections import OrderedDict

import mujoco
import numpy as np

from mjhab.layout.layout import Addresses

REST_ACCELERATION = 0.5
"""A tree of bodies that would accelerate less than this [m/s^2] lies still. Settled starts of tasks have at most 0.11
(the damping of their last creep), a falling object has 9.8."""
_REMEMBERED = 4096


class RestFinder:
    """Answers for states of the homes of a layout, on C MuJoCo; the same start asked again costs nothing.

    Args:
        model: of any home.
        a: addresses in it.
    """

    def __init__(self, model: mujoco.MjModel, a: Addresses) -> None:
        self._data = mujoco.MjData(model)
        self._robot_tree = int(model.body_treeid[a.robot_body[a.robot.tcp]])
        self._known: OrderedDict[tuple[str, bytes, bytes], np.ndarray] = OrderedDict()

    def rings(
        self, home: str, model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray
    ) -> np.ndarray:
        """(ntree,) int32: -1 for a tree that is awake, else the next of those that sleep and wake together with it.

        Asleep are trees that have no velocity and hardly any acceleration, if the same holds for all that they touch.
        The robot is always awake.

        Args:
            home: name of the home.
            model: of the home.
            qpos, qvel: the state, (nq,) and (nv,).
        """
        key = (home, qpos.tobytes(), qvel.tobytes())
        if key not in self._known:
            self._known[key] = self._ask(model, qpos, qvel)
            if len(self._known) > _REMEMBERED:
                self._known.popitem(last=False)
        return self._known[key]

    def _ask(self, model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        data = self._data
        mujoco.mj_resetData(model, data)
        data.qpos[:] = qpos
        data.qvel[:] = qvel
        mujoco.mj_forward(model, data)
        # ``dof_length`` turns rotations into what they move at the rim of the body.
        quiet = (np.abs(data.qacc) * model.dof_length < REST_ACCELERATION) & (
            np.asarray(qvel) == 0.0
        )
        still = np.logical_and.reduceat(quiet, model.tree_dofadr)
        still[self._robot_tree] = False
        rings = np.where(still, np.arange(model.ntree), -1).astype(np.int32)
        # An island is what constraints hold together: all of it sleeps, or nothing.
        for island in range(data.nisland):
            trees = np.flatnonzero(data.tree_island[: model.ntree] == island)
            rings[trees] = np.roll(trees, -1) if still[trees].all() else -1
        return rings
