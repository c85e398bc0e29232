"""The reference simulator: C MuJoCo, one MjModel per home, worlds stepped on a thread pool."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Mapping, Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch

from mjhab.core.errors import UsageError
from mjhab.core.timing import SUBSTEPS
from mjhab.layout.contact_sensors import (
    FORCE_SENSOR_WIDTH,
    TOUCH_SENSOR_WIDTH,
    normal_force,
    pair_force,
)
from mjhab.layout.home_models import HomeModels
from mjhab.layout.layout import Layout, addresses
from mjhab.robots.parts import Drives
from mjhab.sim.mujoco.settle import holding_ctrl
from mjhab.sim.protocol import PENETRATION_LIMIT, TAINTS, SimState

_STAGE_NONE = int(mujoco.mjtStage.mjSTAGE_NONE)
POSITION_STAGE = int(mujoco.mjtStage.mjSTAGE_VEL)
_WARNING = mujoco.mjtWarning
_TAINT_WARNINGS = {
    "contact_overflow": (_WARNING.mjWARN_CONTACTFULL,),
    "constraint_overflow": (_WARNING.mjWARN_CNSTRFULL,),
    "nan": (_WARNING.mjWARN_BADQPOS, _WARNING.mjWARN_BADQVEL, _WARNING.mjWARN_BADQACC),
    "engine_warning": (_WARNING.mjWARN_INERTIA, _WARNING.mjWARN_BADCTRL),
}

_LOG = logging.getLogger("mjhab.engine")


def _log_warning(message: str) -> None:
    """MuJoCo would print warnings and write MUJOCO_LOG.TXT into the working folder; the counters hold them anyway."""
    _LOG.debug("MuJoCo: %s", message)


class CpuSimulator:
    """Worlds on C MuJoCo through ``mujoco.batch.Batch``. See `Simulator` for the methods.

    Args:
        layout: what all homes share.
        num_worlds: worlds stepped together, >= 1.
        num_threads: threads over worlds; 0 takes every core.
        drives: servos of the robot, as the control mode needs them.
    """

    def __init__(
        self, layout: Layout, num_worlds: int, num_threads: int = 0, drives: Drives | None = None
    ) -> None:
        if num_worlds < 1:
            raise UsageError(f"num_worlds must be at least 1, got {num_worlds}")
        mujoco.set_mju_user_warning(_log_warning)
        self.layout = layout
        self.num_worlds = num_worlds
        self.num_threads = num_threads or os.cpu_count() or 1
        self.drives = drives or Drives()
        self.model: Callable[[str], mujoco.MjModel] = HomeModels(layout, self.drives)
        """The compiled model of a home of the pack, by the name of the home."""
        first = self.model(layout.pack.homes[0].name)
        self.addresses = addresses(layout, first)
        self._world_models = [first] * num_worlds
        self.batch = Batch(first, num_worlds, self.num_threads, persistent=True)
        self.batch.set_models(self._world_models)
        # Views of the batch's memory, bound once: looking a field up takes longer than reading it.
        self._qpos = self.batch.bind("qpos")
        self._qvel = self.batch.bind("qvel")
        self._ctrl = self.batch.bind("ctrl")
        self._sensors = self.batch.bind("sensordata")
        self._xpos = self.batch.bind("xpos")
        self._xquat = self.batch.bind("xquat")
        self._warmstart = self.batch.bind("qacc_warmstart")
        self._time = self.batch.bind("time")
        self._xmat = self.batch.bind("xmat").reshape(num_worlds, -1, 3, 3)
        # A batch with caller models shows a world its static poses only after that world's reset.
        self.batch.reset()
        a = self.addresses
        # The layout puts objects, link forces and target sensors in unbroken rows: the state is made of views.
        self._object_q = _rows(a.object_q, 7)
        self._object_v = _rows(a.object_v, 6)
        # The first number of every contact sensor is how many contacts it has.
        self._link_starts = a.link_force
        self._hand_starts = a.hand_force
        self._touch_starts = a.touch
        self._force_block = np.arange(FORCE_SENSOR_WIDTH)
        self._touch_block = np.arange(TOUCH_SENSOR_WIDTH)
        self._depth_col = int(first.sensor("robot_depth").adr[0])
        self._taint = np.zeros(num_worlds, np.uint8)
        self._broken = np.zeros(num_worlds, bool)
        self._warned = np.zeros((num_worlds, self.batch.warning.shape[1]), np.int64)
        self._nan_warned = self._warned.copy()

    @property
    def qpos(self) -> np.ndarray:
        """(W, nq) live generalized positions; write through `write_qpos`."""
        return self._qpos

    def reset(self, ids: Sequence[int], homes: Sequence[str], qpos: np.ndarray) -> None:
        """Put worlds into homes, at rest in ``qpos`` (n, nq). Other worlds keep every bit."""
        self._clear(ids, homes)
        self._qpos[ids] = qpos
        self._ctrl[ids] = holding_ctrl(self._world_models[0], self.layout.robot, np.asarray(qpos))
        self._forward(ids)

    def _clear(self, ids: Sequence[int], homes: Sequence[str]) -> None:
        for world, home in zip(ids, homes, strict=True):
            self._world_models[world] = self.model(home)
        self.batch.set_models(self._world_models)
        self.batch.reset(ids=ids, stage=_STAGE_NONE)

    def _forward(self, ids: Sequence[int]) -> None:
        self.batch.forward(ids=ids)
        self._warned[ids] = self._nan_warned[ids] = self.batch.warning[ids, :, 1]
        self._taint[ids] = 0

    def mend(self, ids: Sequence[int], homes: Sequence[str], qpos: np.ndarray) -> None:
        """Put worlds that broke at rest in the states ``qpos`` (n, nq); they stay tainted.

        A state that is not finite itself is replaced by the model's default.
        """
        taint = self._taint[ids]
        sound = np.asarray(np.isfinite(qpos).all(axis=1))
        default = np.stack([self.model(home).qpos0 for home in homes])
        self.reset(ids, homes, np.where(sound[:, None], qpos, default))
        self._taint[ids] = taint

    def broken(self) -> np.ndarray:
        """(W,) bool: worlds that the last step made NaN or infinite, or that the engine put back for it."""
        return self._broken

    def write_qpos(self, world: int, qpos: np.ndarray) -> None:
        """Move one world to ``qpos`` (nq,), its robot and what it holds at rest; its home stays."""
        changed = np.flatnonzero(self._qpos[world] != qpos)
        self._qpos[world] = qpos
        self._qvel[world, self.addresses.robot_v] = 0.0
        for start, dof in zip(self.addresses.object_q, self.addresses.object_v, strict=True):
            if np.any((changed >= start) & (changed < start + 7)):
                self._qvel[world, dof : dof + 6] = 0.0
        self.batch.forward(ids=[world])

    def get_world(self, world: int) -> dict[str, np.ndarray]:
        """Copies of everything the physics of one world depends on: "time", "qpos", "qvel", "ctrl", "warmstart".

        What sleeps is not in it: a restored world is awake, so it may differ in the last digits from the world it was
        taken from. Worlds restored from the same state are equal in every bit.
        """
        return {name: rows[world].copy() for name, rows in self._world_rows().items()}

    def set_world(self, world: int, home: str, saved: Mapping[str, np.ndarray]) -> None:
        """Put one world into a home in a state from `get_world`, with everything awake. Its taint is cleared.

        Raises:
            UsageError: the state is that of another layout.
        """
        rows = self._world_rows()
        for name, row in rows.items():
            got = np.shape(saved[name])
            if got != row[world].shape:
                raise UsageError(
                    f"state of another layout: {name} has shape {got}, this one needs {row[world].shape}"
                )
        self._clear([world], [home])
        for name, row in rows.items():
            row[world] = saved[name]
        self._forward([world])

    def _world_rows(self) -> dict[str, np.ndarray]:
        return {
            "time": self._time,
            "qpos": self._qpos,
            "qvel": self._qvel,
            "ctrl": self._ctrl,
            "warmstart": self._warmstart,
        }

    def step(self, ctrl: np.ndarray) -> None:
        """Advance all worlds by one control step under ``ctrl`` (W, nu)."""
        self.bare_step(ctrl)
        self._update_taint()

    def bare_step(self, ctrl: np.ndarray) -> None:
        """The engine's part of `step`, for benchmarks."""
        self._ctrl[:] = ctrl
        # Stage VEL makes positions current without cost; the contact sensors are those of the last substep.
        self.batch.step(nstep=SUBSTEPS, stage=POSITION_STAGE)

    def state(self) -> SimState:
        """The current state of all worlds; body arrays are views that the next step overwrites."""
        a = self.addresses
        qpos = self._qpos
        worlds = self.num_worlds
        touch = self._sensors[:, self._touch_starts] > 0
        hand_force, hand_touch = self._hand_forces(touch)
        force = self._link_forces()
        squared = force * force
        return SimState(
            robot_q=qpos[:, a.robot_q],
            robot_qd=self._qvel[:, a.robot_v],
            object_pose=qpos[:, self._object_q].reshape(worlds, -1, 7),
            object_vel=self._qvel[:, self._object_v].reshape(worlds, -1, 6),
            tcp_vel=self._sensors[:, a.tcp_velocity : a.tcp_velocity + 3],
            link_q=qpos[:, a.link_q],
            link_qd=self._qvel[:, a.link_v],
            link_force=np.sqrt(squared[..., 0] + squared[..., 1] + squared[..., 2]),
            finger_force=hand_force[:, :2],
            touch=touch,
            ee_contact=hand_touch.any(axis=1),
            body_pos=self._xpos,
            body_mat=self._xmat,
            body_quat=self._xquat,
        )

    def _link_forces(self) -> np.ndarray:
        """(W, K, 3) force [N] of each robot link on anything, world frame."""
        force = np.zeros((self.num_worlds, len(self._link_starts), 3))
        # Few sensors have a contact: only these are read.
        world, link = (self._sensors[:, self._link_starts] > 0).nonzero()
        force[world, link] = normal_force(
            self._read(world, self._link_starts[link], self._force_block)
        )
        return force

    def _hand_forces(self, touch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(W, 3, N + L, 3) force [N] of every target on the left finger, the right finger and the link of the tool
        centre, world frame; and (W, 3, N + L) bool: they have a contact.

        Args:
            touch: (W, N + L) bool: the robot touches the target.
        """
        pressed = self._sensors[:, self._hand_starts] > 0
        contact = pressed[:, :, None] & touch[:, None]
        force = np.zeros((*contact.shape, 3))
        world, link, target = contact.nonzero()
        listed = self._read(world, self._hand_starts[link], self._force_block)
        touches = self._read(world, self._touch_starts[target], self._touch_block)
        pushed, contact[world, link, target] = pair_force(listed, touches)
        # The sensor gives the force of its body on others; what is wanted is the opposite.
        force[world, link, target] = -pushed
        return force, contact

    def _read(self, world: np.ndarray, start: np.ndarray, block: np.ndarray) -> np.ndarray:
        """(n, len(block)) data of a sensor that begins at ``start`` (n,), each in its ``world`` (n,)."""
        return self._sensors[world[:, None], start[:, None] + block]

    def add_taint(self, world: int, mask: int) -> None:
        """Mark a world with the bits of ``mask``."""
        self._taint[world] |= mask

    def taint(self) -> np.ndarray:
        """(W,) uint8 bit mask of TAINTS that arose since each world's reset."""
        return self._taint.copy()

    def _update_taint(self) -> None:
        deep = self._sensors[:, self._depth_col] < -PENETRATION_LIMIT
        if deep.any():
            self._taint |= deep.astype(np.uint8) << TAINTS.index("penetration")
        self._broken[:] = False
        warnings = self.batch.warning[:, :, 1]
        rose = warnings > self._warned
        # One sum over all worlds is enough to see that nothing is NaN or infinite.
        if rose.any() or not math.isfinite(self._qpos.sum()):
            for name, kinds in _TAINT_WARNINGS.items():
                hit = rose[:, [int(k) for k in kinds]].any(axis=1)
                self._taint |= hit.astype(np.uint8) << TAINTS.index(name)
            nan_kinds = [int(k) for k in _TAINT_WARNINGS["nan"]]
            again = (warnings > self._nan_warned)[:, nan_kinds].any(axis=1)
            self._nan_warned = warnings.copy()
            self._broken = again | ~np.isfinite(self._qpos).all(axis=1)
            self._taint |= self._broken.astype(np.uint8) << TAINTS.index("nan")


def _rows(starts: np.ndarray, width: int) -> slice:
    """The columns of equally wide, adjoining blocks as one slice.

    Raises:
        ValueError: there are gaps between the blocks.
    """
    if not len(starts):
        return slice(0, 0)
    if (np.diff(starts) != width).any():
        raise ValueError(
            f"blocks of {width} columns do not adjoin: they start at {starts.tolist()}"
        )
    return slice(int(starts[0]), int(starts[0]) + width * len(starts))
