"""MuJoCo Warp's model and data for the homes of a layout, and the device code of a control step and of a reset."""

from __future__ import annotations

import copy
from collections.abc import Callable

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from mujoco_warp._src import sleep, smooth

from mjhab.core.timing import SUBSTEPS
from mjhab.layout.addresses import Addresses
from mjhab.sim.protocol import PENETRATION_LIMIT
from mjhab.sim.warp import kernels
from mjhab.sim.warp.buffers import (
    BUFFER_BITS,
    CONTACT_OVERFLOW,
    ENGINE_OVERFLOW,
    OVERFLOW,
    ROW_OVERFLOW,
    BufferSizes,
)
from mjhab.sim.warp.device import set_up
from mjhab.sim.warp.graphs import Graphs
from mjhab.sim.warp.homes import HOME_FIELDS, HomeTables
from mjhab.sim.warp.trees import tree_spans

CPU_DEVICE_ITERATIONS = 30
"""Solver iterations on Warp's CPU device, which always runs all of them (on CUDA the solver stops on convergence)."""
AWAKE = sleep.K_AWAKE_VAL
"""Value of ``tree_asleep`` of a tree that was just woken."""


class Engine:
    """W worlds on the device. Attributes named ``*_t`` are torch tensors that share memory with Warp arrays.

    Args:
        base: compiled model of any home, with its servos set.
        a: addresses of the layout.
        num_worlds: W.
        num_homes: largest number of homes.
        sizes: capacities of the buffers.
        device: a Warp device.
    """

    def __init__(
        self,
        base: mujoco.MjModel,
        a: Addresses,
        num_worlds: int,
        num_homes: int,
        sizes: BufferSizes,
        device: wp.Device,
    ) -> None:
        self.device = device
        self.num_worlds = num_worlds
        self.sizes = sizes
        model = copy.copy(base)
        # MuJoCo compares every contact sensor with every contact; `kernels.add_contacts` reads each contact once.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
        with set_up(device):
            self.model = mjw.put_model(
                # Room for one row per world: replacing arrays later would invalidate captured graphs.
                model,
                batch_sizes=dict.fromkeys(HOME_FIELDS, num_worlds),
            )
            self.data = mjw.make_data(
                model,
                num_worlds,
                naconmax=sizes.contacts,
                naccdmax=min(sizes.ccd, sizes.contacts),
                njmax=sizes.rows,
                nvmax=sizes.awake,
            )
            self.model.opt.warn_overflow = (
                0  # printing from kernels is slow, and the bits say the same
            )
            # The broad phase for large models sorts, which allocates; a conditional graph must not allocate.
            self.model.opt.broadphase = mjw.BroadphaseType.NXN
            if not device.is_cuda:
                self.model.opt.iterations = CPU_DEVICE_ITERATIONS
            self.homes = HomeTables(base, self.model, self.data, num_homes)
            self.graphs = Graphs(device)
            self._allocate(model, a)
        self.model.callback.contactfilter = self._record_peak
        self._tensors()

    def _allocate(self, model: mujoco.MjModel, a: Addresses) -> None:
        worlds = self.num_worlds
        targets = len(a.object_body) + len(a.link_body)
        self.link_net = wp.zeros((worlds, len(a.robot.force_links)), dtype=wp.vec3)
        self.link_force = wp.zeros((worlds, len(a.robot.force_links)), dtype=wp.float32)
        self.finger_force = wp.zeros((worlds, 2, targets), dtype=wp.vec3)
        self.hand_net = wp.zeros((worlds, 2), dtype=wp.vec3)
        self.finger_net = wp.zeros((worlds, 2), dtype=wp.float32)
        self.touch = wp.zeros((worlds, targets), dtype=wp.bool)
        self.ee_contact = wp.zeros((worlds, targets), dtype=wp.bool)
        self.depth = wp.zeros(worlds, dtype=wp.float32)
        self.tcp_vel = wp.zeros(worlds, dtype=wp.vec3)
        self.taint = wp.zeros(worlds, dtype=wp.uint8)
        self.broken = wp.zeros(worlds, dtype=wp.bool)
        self.pairs_peak = wp.zeros(1, dtype=wp.int32)
        self.overflow_seen = wp.zeros(1, dtype=wp.int32)
        self.update = wp.zeros(worlds, dtype=wp.bool)
        self.fresh = wp.zeros(worlds, dtype=wp.bool)
        self.moved = wp.zeros(worlds, dtype=wp.bool)
        self._due = wp.zeros(1, dtype=wp.int32)
        self.new_rows = wp.zeros(worlds, dtype=wp.int32)
        self.new_ctrl = wp.zeros((worlds, model.nu), dtype=wp.float32)
        self.new_rings = wp.zeros((worlds, model.ntree), dtype=wp.int32)
        self._everyone = wp.ones(worlds, dtype=wp.bool)
        self.new_qpos = wp.zeros((worlds, model.nq), dtype=wp.float32)
        self._qpos_before = wp.zeros_like(self.data.qpos)
        self._asleep_before = wp.zeros_like(self.data.tree_asleep)
        self._slept = wp.zeros_like(self.data.tree_asleep)
        overflow = [int(CONTACT_OVERFLOW), int(ROW_OVERFLOW), int(ENGINE_OVERFLOW)]
        self._overflow_bits = wp.array(overflow, dtype=wp.int32)
        self._tcp = a.robot_body[a.robot.tcp]
        self._tcp_root = int(model.body_rootid[self._tcp])
        self._map_bodies(model, a)
        self._map_trees(model, a)

    def _map_bodies(self, model: mujoco.MjModel, a: Addresses) -> None:
        def numbered(bodies: list[int]) -> wp.array:
            # A table over bodies makes the look-up of a contact one read.
            table = np.full(model.nbody, -1, np.int32)
            table[bodies] = np.arange(len(bodies))
            return wp.array(table, dtype=wp.int32)

        self._link_of = numbered([a.robot_body[name] for name in a.robot.force_links])
        self._finger_of = numbered([a.robot_body[name] for name in a.robot.finger_links])
        self._target_of = numbered([*a.object_body.tolist(), *a.link_body.tolist()])
        end_effector = [a.robot_body[name] for name in a.robot.hand_links]
        self._is_end_effector = wp.array(
            np.isin(np.arange(model.nbody), end_effector), dtype=wp.bool
        )
        # By the root: all links of the robot, also those without a column.
        self._is_robot = wp.array(model.body_rootid == self._tcp_root, dtype=wp.bool)

    def _map_trees(self, model: mujoco.MjModel, a: Addresses) -> None:
        spans_q, spans_v = tree_spans(model)
        # A teleport zeroes the velocity of the robot (2) always, that of an object (1) if its pose changes.
        stops = np.zeros(model.ntree, np.int32)
        stops[model.body_treeid[a.object_body]] = 1
        stops[model.body_treeid[self._tcp]] = 2
        self._tree_q = wp.array(spans_q, dtype=wp.vec2i)
        self._tree_v = wp.array(spans_v, dtype=wp.vec2i)
        self._stops = wp.array(stops, dtype=wp.int32)

    def _tensors(self) -> None:
        data = self.data
        # Bound once: the memory stays where it is, as captured graphs need it.
        self.qpos_t = wp.to_torch(data.qpos)
        self.qvel_t = wp.to_torch(data.qvel)
        self.ctrl_t = wp.to_torch(data.ctrl)
        self.warmstart_t = wp.to_torch(data.qacc_warmstart)
        self.time_t = wp.to_torch(data.time)
        self.asleep_t = wp.to_torch(data.tree_asleep)
        self.overflow_t = wp.to_torch(data.overflow)
        self.taint_t = wp.to_torch(self.taint)
        self.broken_t = wp.to_torch(self.broken)
        self.update_t = wp.to_torch(self.update)
        self.fresh_t = wp.to_torch(self.fresh)
        self.moved_t = wp.to_torch(self.moved)
        self.new_qpos_t = wp.to_torch(self.new_qpos)
        self.new_rows_t = wp.to_torch(self.new_rows)
        self.new_ctrl_t = wp.to_torch(self.new_ctrl)
        self.new_rings_t = wp.to_torch(self.new_rings)

    def _record_peak(self, model: mjw.Model, data: mjw.Data) -> None:
        # Called after each collision pass. With sleep enabled there are two per substep, and the second resets the
        # engine's counter, so that the engine forgets an overflow of the first pass.
        wp.launch(
            kernels.record_peak,
            dim=1,
            inputs=[data.ncollision],
            outputs=[self.pairs_peak],
        )

    def clear(
        self, worlds: torch.Tensor, rows: torch.Tensor, rings: torch.Tensor
    ) -> None:
        """Put worlds into homes with zero velocity, ctrl, warm start and time; the caller then writes ``qpos_t``.

        Args:
            worlds: (n,) int64 indices of worlds.
            rows: (n,) int64 rows of `HomeTables`.
            rings: (n, ntree) int32 sleep rings of `RestFinder.rings`.
        """
        self.homes.put(worlds, rows)
        for zeroed in (self.qvel_t, self.ctrl_t, self.warmstart_t, self.time_t):
            zeroed[worlds] = 0.0
        # Not -1, with which the engine would put the tree to sleep again at once.
        self.asleep_t[worlds] = torch.where(rings < 0, AWAKE, rings).to(
            self.asleep_t.dtype
        )

    def step(self) -> None:
        """Advance all worlds by one control step under ``ctrl_t``; updates forces, taint and broken worlds."""
        with wp.ScopedDevice(self.device):
            self.graphs.run("step", self._step)

    def _step(self) -> None:
        data = self.data
        self.pairs_peak.zero_()
        self.broken.zero_()
        # To come back to if the step makes NaN.
        wp.copy(self._qpos_before, data.qpos)
        wp.copy(self._slept, data.tree_asleep)
        for _ in range(SUBSTEPS):
            mjw.step(self.model, data)
            wp.launch(
                kernels.put_back_broken,
                dim=self.num_worlds,
                inputs=[self._qpos_before, self._slept],
                outputs=[
                    data.qpos,
                    data.qvel,
                    data.qacc_warmstart,
                    data.tree_asleep,
                    data.overflow,
                    self.broken,
                ],
            )
        # mjw.step leaves the poses of before its integration; recompute them for the new qpos.
        smooth.kinematics(self.model, self.data)
        smooth.com_pos(self.model, self.data)
        smooth.camlight(self.model, self.data)
        smooth.com_vel(self.model, self.data)
        self._derive(self._everyone)
        wp.launch(
            kernels.check_worlds,
            dim=self.num_worlds,
            inputs=[
                data.overflow,
                self.pairs_peak,
                data.naconmax,
                self.depth,
                PENETRATION_LIMIT,
                self._overflow_bits,
                self.broken,
            ],
            outputs=[self.taint],
        )
        wp.launch(
            kernels.note_overflow,
            dim=self.num_worlds,
            inputs=[
                data.overflow,
                self.pairs_peak,
                data.naconmax,
                int(OVERFLOW.BROADPHASE),
            ],
            outputs=[self.overflow_seen],
        )

    def renew(self) -> None:
        """Reset the worlds of mask ``fresh_t`` and teleport those of mask ``moved_t``, both to ``new_qpos_t``.

        The masks are disjoint. Home, ctrl and sleep rings of reset worlds are read from ``new_rows_t``, ``new_ctrl_t``
        and ``new_rings_t``. All shapes are fixed and no value is copied to the host: on CUDA this is one launch of a
        captured graph, which does nothing if both masks are empty. Other worlds stay bitwise the same.
        """
        with wp.ScopedDevice(self.device):
            self.graphs.run("renew", self._renew_due)

    def mend(self) -> None:
        """Recompute derived quantities in the worlds that the last step set back because of NaN or infinite values."""
        with wp.ScopedDevice(self.device):
            self.graphs.run("mend", self._mend_due)

    def _renew_due(self) -> None:
        wp.launch(
            kernels.unite,
            dim=self.num_worlds,
            inputs=[self.fresh, self.moved],
            outputs=[self.update],
        )
        self._if_due(self._renew)

    def _mend_due(self) -> None:
        # A copy, since the refresh must not change what the step has found.
        wp.copy(self.update, self.broken)
        self._if_due(self._refresh)

    def _if_due(self, work: Callable[[], None]) -> None:
        self._due.zero_()
        wp.launch(
            kernels.any_of, dim=self.num_worlds, inputs=[self.update], outputs=[self._due]
        )
        wp.capture_if(self._due, on_true=work)

    def _renew(self) -> None:
        data = self.data
        self.homes.put_masked(self.fresh, self.new_rows)
        wp.launch(
            kernels.begin_worlds,
            dim=self.num_worlds,
            inputs=[self.fresh, self.new_qpos, self.new_ctrl, self.new_rings, AWAKE],
            outputs=[
                data.qpos,
                data.qvel,
                data.ctrl,
                data.qacc_warmstart,
                data.time,
                data.tree_asleep,
            ],
        )
        self._move(self.moved)
        self._refresh()
        # Last: the refresh may set flags that are no fault of the new episode.
        flags = [data.overflow, self.taint, self.broken]
        wp.launch(
            kernels.clear_flags, dim=self.num_worlds, inputs=[self.fresh], outputs=flags
        )

    def refresh(self, worlds: torch.Tensor, *, teleport: bool = False) -> None:
        """Recompute derived quantities (poses, contacts, forces) of some worlds; others stay bitwise the same.

        Args:
            worlds: (n,) int64 worlds whose state was written.
            teleport: first teleport them to ``new_qpos_t``.
        """
        self.update_t.zero_()
        self.update_t[worlds] = True
        with wp.ScopedDevice(self.device):
            # Two graphs, because a captured one cannot choose.
            if teleport:
                self.graphs.run("teleport", self._teleport)
            else:
                self.graphs.run("refresh", self._refresh)

    def overflown(self) -> list[str]:
        """Return the fields of `BufferSizes` whose buffers have overflowed since the start. Waits for the device."""
        bits = int(wp.to_torch(self.overflow_seen)[0])
        return [name for name, mask in BUFFER_BITS.items() if bits & int(mask)]

    def clear_flags(self, worlds: torch.Tensor) -> None:
        """Clear the overflow, taint and broken flags of worlds (n,)."""
        for flag in (self.overflow_t, self.taint_t, self.broken_t):
            flag[worlds] = 0

    def _teleport(self) -> None:
        self._move(self.update)
        self._refresh()

    def _move(self, mask: wp.array) -> None:
        data = self.data
        wp.launch(
            kernels.teleport,
            dim=self.num_worlds,
            inputs=[mask, self.new_qpos, self._tree_q, self._tree_v, self._stops, AWAKE],
            outputs=[data.qpos, data.qvel, data.tree_asleep],
        )

    def _refresh(self) -> None:
        # mjw.forward has no mask: it runs in all worlds. In the others it reproduces the present values with two
        # exceptions: trees that a contact wakes in the next substep would wake now, and contacts would be those after
        # the last integration instead of before it. So sleep is restored, and forces are derived under the mask.
        data = self.data
        self.pairs_peak.zero_()
        wp.copy(self._asleep_before, data.tree_asleep)
        # Without this the engine treats trees that were just put to sleep as just woken.
        sleep.update_sleep(self.model, data)
        mjw.forward(self.model, data)
        self._derive(self.update)
        wp.launch(
            kernels.restore_sleep,
            dim=data.tree_asleep.shape,
            inputs=[self.update, self._asleep_before],
            outputs=[data.tree_asleep],
        )
        sleep.update_sleep(self.model, data)

    def _derive(self, update: wp.array) -> None:
        data = self.data
        contact = self.data.contact
        forces = [
            self.link_net,
            self.hand_net,
            self.finger_force,
            self.touch,
            self.ee_contact,
            self.depth,
        ]
        wp.launch(
            kernels.clear_forces, dim=self.num_worlds, inputs=[update], outputs=forces
        )
        wp.launch(
            kernels.add_contacts,
            dim=data.naconmax,
            inputs=[
                data.nacon,
                contact.dist,
                contact.frame,
                contact.geom,
                contact.efc_address,
                contact.worldid,
                contact.type,
                data.efc.force,
                data.njmax,
                self.model.geom_bodyid,
                self._link_of,
                self._finger_of,
                self._target_of,
                self._is_robot,
                self._is_end_effector,
                update,
            ],
            outputs=forces,
        )
        wp.launch(
            kernels.finish_state,
            dim=self.num_worlds,
            inputs=[
                update,
                self.link_net,
                self.hand_net,
                self._tcp,
                self._tcp_root,
                data.xpos,
                data.subtree_com,
                data.cvel,
            ],
            outputs=[self.link_force, self.finger_net, self.tcp_vel],
        )
