"""The reference simulator: C MuJoCo, one MjModel per home, worlds stepped on a thread pool."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch

from mjhab.core.arrays import may_hold, norm3
from mjhab.core.kernels.control_step import is_sound
from mjhab.core.machine import cores
from mjhab.core.timing import SUBSTEPS
from mjhab.core.typed.checks import check, check_least
from mjhab.layout.addresses import addresses
from mjhab.layout.contact_sensors import (
    FORCE_SENSOR_WIDTH,
    TOUCH_SENSOR_WIDTH,
    normal_force,
    pair_force,
)
from mjhab.layout.home_models import HomeModels
from mjhab.layout.layout import Layout
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
    """Send a MuJoCo warning to the log.

    MuJoCo's own handler prints it and writes MUJOCO_LOG.TXT into the working folder. The simulator reads the warning
    counters of the batch instead.
    """
    _LOG.debug("MuJoCo: %s", message)


class CpuSimulator:
    """Worlds on C MuJoCo through ``mujoco.batch.Batch``.

    Args:
        layout: names, order and sizes shared by all homes.
        num_worlds: size W of the batch, at least 1.
        num_threads: threads that step the worlds; 0 uses every core.
        drives: changes to the robot's servos that the control mode needs; None for none.

    Raises:
        UsageError: ``num_worlds`` is below 1.
    """

    def __init__(
        self,
        layout: Layout,
        num_worlds: int,
        num_threads: int = 0,
        drives: Drives | None = None,
    ) -> None:
        check_least("num_worlds", num_worlds, 1)
        # A global of the library: every simulator sets the same.
        mujoco.set_mju_user_warning(_log_warning)
        self.layout = layout
        self.num_worlds = num_worlds
        self.num_threads = num_threads or cores()
        self.drives = drives or Drives()
        self.model: Callable[[str], mujoco.MjModel] = HomeModels(layout, self.drives)
        """Returns the compiled model of a home of the pack, by name."""
        first = self.model(layout.pack.homes[0].name)
        self.addresses = addresses(layout, first)
        # Any home will do: worlds get their own at their first reset.
        self._world_models = [first] * num_worlds
        # Persistent, since what sleeps is kept in the data of each world.
        self.batch = Batch(first, num_worlds, self.num_threads, persistent=True)
        self.batch.set_models(self._world_models)
        # Views of the batch's memory, bound once because a field look-up costs more than reading the field.
        self._qpos = self.batch.bind("qpos")
        self._qvel = self.batch.bind("qvel")
        self._ctrl = self.batch.bind("ctrl")
        self._sensors = self.batch.bind("sensordata")
        self._xpos = self.batch.bind("xpos")
        self._xquat = self.batch.bind("xquat")
        self._warmstart = self.batch.bind("qacc_warmstart")
        self._time = self.batch.bind("time")
        self._xmat = self.batch.bind("xmat").reshape(num_worlds, -1, 3, 3)
        # With models set by the caller, the poses of static geoms are valid in a world only after its reset.
        self.batch.reset()
        a = self.addresses
        # The layout gives objects contiguous addresses, so that slices of qpos and qvel are views, not copies.
        self._object_q = _rows(a.object_q, 7)
        self._object_v = _rows(a.object_v, 6)
        self._link_starts = a.link_force
        self._hand_starts = a.hand_force
        self._touch_starts = a.touch
        # The first number of every contact sensor is its number of contacts. One read for all sensors is cheaper than
        # one for each kind, because the step has emptied the processor's caches.
        self._counts = np.concatenate([a.touch, a.hand_force, a.link_force])
        self._hand_counts = slice(len(a.touch), len(a.touch) + len(a.hand_force))
        self._link_counts = slice(self._hand_counts.stop, len(self._counts))
        self._force_block = np.arange(FORCE_SENSOR_WIDTH)
        self._touch_block = np.arange(TOUCH_SENSOR_WIDTH)
        self._depth_col = int(first.sensor("robot_depth").adr[0])
        self._taint = np.zeros(num_worlds, np.uint8)
        self._broken = np.zeros(num_worlds, bool)
        # The second column: MuJoCo's first one is what the last warning was about.
        self._warnings = self.batch.warning[:, :, 1]
        """(W, kinds) live number of warnings of each kind since the world's reset."""
        self._warned = np.zeros(self._warnings.shape, self._warnings.dtype)
        self._nan_warned = self._warned.copy()

    @property
    def qpos(self) -> np.ndarray:
        """(W, nq) live generalized positions; write through `write_qpos`."""
        return self._qpos

    def reset(self, ids: Sequence[int], homes: Sequence[str], qpos: np.ndarray) -> None:
        """Reset worlds to the states ``qpos`` (n, nq) of homes with zero velocity; others stay bitwise the same."""
        self._clear(ids, homes)
        self._qpos[ids] = qpos
        # Fingers must press from the first substep on, or a held object falls.
        self._ctrl[ids] = holding_ctrl(
            self._world_models[0], self.layout.robot, np.asarray(qpos)
        )
        self._forward(ids)

    def _clear(self, ids: Sequence[int], homes: Sequence[str]) -> None:
        for world, home in zip(ids, homes, strict=True):
            self._world_models[world] = self.model(home)
        self.batch.set_models(self._world_models)
        # Without a forward pass: the state that is written afterwards would need another one.
        self.batch.reset(ids=ids, stage=_STAGE_NONE)

    def _forward(self, ids: Sequence[int]) -> None:
        self.batch.forward(ids=ids)
        # The forward pass of a reset may warn as well, and that is no fault of the episode.
        self._warned[ids] = self._nan_warned[ids] = self._warnings[ids]
        self._taint[ids] = 0

    def mend(self, ids: Sequence[int], homes: Sequence[str], qpos: np.ndarray) -> None:
        """Reset worlds that became NaN or infinite to ``qpos`` (n, nq) with zero velocity; they keep their taint.

        A row of ``qpos`` that is not finite is replaced by the model's ``qpos0``.
        """
        # A reset would clear it, and the episode would pass for sound.
        taint = self._taint[ids]
        # What is to be restored may be broken itself.
        sound = np.asarray(np.isfinite(qpos).all(axis=1))
        default = np.stack([self.model(home).qpos0 for home in homes])
        self.reset(ids, homes, np.where(sound[:, None], qpos, default))
        self._taint[ids] = taint

    def broken(self) -> np.ndarray:
        """Return (W,) bool: worlds that became NaN or infinite in the last step, or that MuJoCo reset for it."""
        return self._broken

    def write_qpos(self, world: int, qpos: np.ndarray) -> None:
        """Teleport one world to ``qpos`` (nq,) in its present home.

        The robot, and every object whose pose changes, get zero velocity.
        """
        # Objects that stay keep their velocity and their sleep.
        changed = np.flatnonzero(self._qpos[world] != qpos)
        self._qpos[world] = qpos
        self._qvel[world, self.addresses.robot_v] = 0.0
        for start, dof in zip(
            self.addresses.object_q, self.addresses.object_v, strict=True
        ):
            # A free joint has 7 numbers in qpos.
            if np.any((changed >= start) & (changed < start + 7)):
                self._qvel[world, dof : dof + 6] = 0.0
        self.batch.forward(ids=[world])

    def get_world(self, world: int) -> dict[str, np.ndarray]:
        """Return copies of the physics state of one world: "time", "qpos", "qvel", "ctrl", "warmstart".

        Which trees sleep is not part of it. A restored world is awake, so that it may differ in the last digits from
        the saved one; worlds restored from the same state are bitwise equal.
        """
        return {name: rows[world].copy() for name, rows in self._world_rows().items()}

    def set_world(self, world: int, home: str, saved: Mapping[str, np.ndarray]) -> None:
        """Restore one world in a home from a state of `get_world`, with all trees awake, and clear its taint.

        Raises:
            UsageError: the arrays have the shapes of another layout.
        """
        rows = self._world_rows()
        for name, row in rows.items():
            got = np.shape(saved[name])
            check(
                got == row[world].shape,
                f"{name} of the state",
                got,
                f"of shape {row[world].shape}",
                "It is of another layout.",
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
        """Advance all worlds by one control step under ``ctrl`` (W, nu), and update their taint."""
        self.bare_step(ctrl)
        self._update_taint()

    def bare_step(self, ctrl: np.ndarray) -> None:
        """Advance all worlds as `step` does, without the taint checks; for benchmarks."""
        self._ctrl[:] = ctrl
        # Stage VEL leaves the positions current at no cost; contact sensors are those of the last substep.
        self.batch.step(nstep=SUBSTEPS, stage=POSITION_STAGE)

    def state(self) -> SimState:
        """Return the current state of all worlds; body and object arrays are views that the next step overwrites."""
        a = self.addresses
        qpos = self._qpos
        worlds = self.num_worlds
        found = self._sensors[:, self._counts] > 0
        touch = found[:, : self._hand_counts.start]
        pressed = found[:, self._hand_counts]
        hand_force, ee_contact = self._hand_forces(pressed, touch)
        return SimState(
            robot_q=qpos[:, a.robot_q],
            robot_qd=self._qvel[:, a.robot_v],
            object_pose=qpos[:, self._object_q].reshape(worlds, -1, 7),
            object_vel=self._qvel[:, self._object_v].reshape(worlds, -1, 6),
            tcp_vel=self._sensors[:, a.tcp_velocity : a.tcp_velocity + 3],
            link_q=qpos[:, a.link_q],
            link_qd=self._qvel[:, a.link_v],
            link_force=self._net_forces(found[:, self._link_counts], self._link_starts),
            finger_force=hand_force[:, :2],
            finger_net=self._net_forces(pressed[:, :2], self._hand_starts),
            touch=touch,
            ee_contact=ee_contact,
            body_pos=self._xpos,
            body_mat=self._xmat,
            body_quat=self._xquat,
        )

    def _net_forces(self, found: np.ndarray, starts: np.ndarray) -> np.ndarray:
        """Return (W, K): norm of the net normal contact force [N] of each of K links on other bodies.

        Args:
            found: (W, K) bool: the link has contacts.
            starts: (K or more,) first column of the force sensor of each link.
        """
        force = np.zeros(found.shape)
        # Few sensors have contacts; the others are not read.
        if may_hold(found):
            world, link = found.nonzero()
            readings = self._read(world, starts[link], self._force_block)
            force[world, link] = norm3(normal_force(readings))
        return force

    def _hand_forces(
        self, pressed: np.ndarray, touch: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the contact forces of the targets on the left finger, the right finger and the tcp link.

        Args:
            pressed: (W, 3) bool: the link has contacts.
            touch: (W, N + L) bool: some robot link has a contact with the target.

        Returns:
            (W, 3, N + L, 3) force [N] of each target on the link, world frame; (W, N + L) bool: some of the links has a
            contact with the target.
        """
        force = np.zeros((*pressed.shape, touch.shape[1], 3))
        if not may_hold(pressed):
            return force, np.zeros(touch.shape, bool)
        # Pairs that may touch; which of them do, the contacts' positions tell.
        contact = pressed[:, :, None] & touch[:, None]
        world, link, target = contact.nonzero()
        listed = self._read(world, self._hand_starts[link], self._force_block)
        touches = self._read(world, self._touch_starts[target], self._touch_block)
        pushed, contact[world, link, target] = pair_force(listed, touches)
        # The sensor gives the force of the link on the target; the sign is turned.
        force[world, link, target] = -pushed
        return force, np.asarray(contact.any(axis=1))

    def _read(
        self, world: np.ndarray, start: np.ndarray, block: np.ndarray
    ) -> np.ndarray:
        """Return (n, len(block)) sensor data: row i is that of world ``world[i]`` from column ``start[i]`` on."""
        return self._sensors[world[:, None], start[:, None] + block]

    def add_taint(self, world: int, mask: int) -> None:
        """Set the bits ``mask`` in the taint of a world."""
        self._taint[world] |= mask

    def taint(self) -> np.ndarray:
        """Return (W,) uint8: bit mask of the TAINTS of each world since its reset."""
        return self._taint.copy()

    def _update_taint(self) -> None:
        if may_hold(self._broken):
            self._broken[:] = False
        warnings = self._warnings
        least = -PENETRATION_LIMIT
        seen = (warnings, self._warned, self._qpos)
        # Compiled and first: almost all steps end here.
        if is_sound(self._sensors, self._depth_col, least, *seen):
            return
        # An empty sensor holds 0, which is above the limit.
        deep = self._sensors[:, self._depth_col] < least
        self._taint |= deep.astype(np.uint8) << TAINTS.index("penetration")
        finite = np.isfinite(self._qpos).all(axis=1)
        rose = warnings > self._warned
        if not may_hold(rose) and finite.all():
            return
        for name, kinds in _TAINT_WARNINGS.items():
            hit = rose[:, [int(k) for k in kinds]].any(axis=1)
            self._taint |= hit.astype(np.uint8) << TAINTS.index(name)
        nan_kinds = [int(k) for k in _TAINT_WARNINGS["nan"]]
        # Against the last step: taint keeps a warning, while broken is about this step alone.
        again = (warnings > self._nan_warned)[:, nan_kinds].any(axis=1)
        # The batch counts on in the same memory.
        self._nan_warned = warnings.copy()
        # MuJoCo resets a world with NaN by itself, so that its positions alone may look sound.
        self._broken = again | ~finite
        self._taint |= self._broken.astype(np.uint8) << TAINTS.index("nan")


def _rows(starts: np.ndarray, width: int) -> slice:
    """Return the slice of columns that adjoining blocks of ``width`` columns cover.

    Args:
        starts: (n,) first column of each block.
        width: columns of a block.

    Raises:
        ValueError: there are gaps between the blocks.
    """
    if not len(starts):
        return slice(0, 0)
    # A slice would silently read other columns.
    if (np.diff(starts) != width).any():
        raise ValueError(
            f"blocks of {width} columns do not adjoin: they start at {starts.tolist()}"
        )
    return slice(int(starts[0]), int(starts[0]) + width * len(starts))
