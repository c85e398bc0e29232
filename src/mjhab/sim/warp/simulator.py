"""The GPU simulator on MuJoCo Warp: one model on the device for all homes; each world is a row of device arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from mjhab.core.arrays import to_numpy
from mjhab.core.errors import UsageError
from mjhab.core.libraries import missing_library
from mjhab.core.machine import install_extra
from mjhab.core.typed.checks import check, check_least
from mjhab.layout.addresses import addresses
from mjhab.layout.home_models import HomeModels
from mjhab.layout.layout import Layout
from mjhab.robots.parts import Drives
from mjhab.sim.mujoco.settle import holding_ctrl
from mjhab.sim.protocol import SimState

try:
    import torch
    import warp as wp

    # Before its first use, which prints a banner.
    wp.config.log_level = wp.LOG_WARNING
    from mjhab.sim.warp.buffers import BufferSizes
    from mjhab.sim.warp.device import open_device, room_for
    from mjhab.sim.warp.engine import Engine
    from mjhab.sim.warp.rest import RestFinder
    from mjhab.sim.warp.sizes import buffer_sizes, changed_sizes
except ModuleNotFoundError as error:
    raise missing_library(
        "backend 'warp'", (str(error.name),), install_extra("gpu")
    ) from error


class WarpSimulator:
    """Worlds on MuJoCo Warp. It has the methods of `CpuSimulator`; arrays are float32 torch tensors on the device.

    Forces, flags and poses have the meaning they have in `CpuSimulator`. There, every tree of a reset world is awake
    for ten substeps; here, trees at rest sleep at once, because buffers and solver are sized for the awake ones.

    Args:
        layout: names, order and sizes shared by all homes.
        num_worlds: size W of the batch, at least 1.
        device: a Warp device: "cpu", "cuda:0"; "" is the first CUDA device.
        drives: changes to the robot's servos that the control mode needs; None for none.
        sizes: capacities of the engine's buffers; None measures them, once per layout.
        buffers: overrides for single fields of `BufferSizes`, e.g. {"contacts": 100_000}.

    Raises:
        UsageError: ``num_worlds`` is below 1, there is no such device or buffer, or the worlds need more memory than
            the device has.
    """

    num_threads = 1

    def __init__(
        self,
        layout: Layout,
        num_worlds: int,
        device: str = "",
        drives: Drives | None = None,
        sizes: BufferSizes | None = None,
        buffers: Mapping[str, int] | None = None,
    ) -> None:
        check_least("num_worlds", num_worlds, 1)
        self.layout = layout
        self.num_worlds = num_worlds
        self.drives = drives or Drives()
        self.device = open_device(device)
        self.model = HomeModels(layout, self.drives)
        """Returns the compiled model of a home of the pack, on the host, by name."""
        base = self.model(layout.pack.homes[0].name)
        self.addresses = addresses(layout, base)
        sizes = sizes or buffer_sizes(
            layout, self.model, self.addresses, num_worlds, self.device
        )
        # After the measured ones, so that a user need not know all of them.
        sizes = changed_sizes(sizes, buffers or {})
        self._rest = RestFinder(base, self.addresses)
        with room_for(num_worlds, self.device):
            self.engine = Engine(
                base,
                self.addresses,
                num_worlds,
                len(layout.pack.homes),
                sizes,
                self.device,
            )
            self._begin(base)

    def _begin(self, base: mujoco.MjModel) -> None:
        a = self.addresses
        home = self.layout.pack.homes[0].name
        self._robot_q, self._robot_v, self._link_q, self._link_v = map(
            self._indices, (a.robot_q, a.robot_v, a.link_q, a.link_v)
        )
        self._views = self._make_views()
        # The first reset allocates device memory: it belongs under `room_for`.
        self.reset(
            range(self.num_worlds),
            [home] * self.num_worlds,
            np.tile(base.qpos0, (self.num_worlds, 1)),
        )

    @property
    def qpos(self) -> torch.Tensor:
        """(W, nq) live generalized positions; write through `write_qpos`."""
        return self.engine.qpos_t

    def reset(self, ids: Sequence[int], homes: Sequence[str], qpos: Any) -> None:
        """Reset worlds to the states ``qpos`` (n, nq) of homes with zero velocity; others stay bitwise the same."""
        qpos = to_numpy(qpos)
        worlds = self._clear(
            ids, homes, qpos, np.zeros((len(qpos), self.engine.qvel_t.shape[1]))
        )
        self.engine.qpos_t[worlds] = self._upload(qpos)
        self.engine.ctrl_t[worlds] = self._upload(
            holding_ctrl(self.model(homes[0]), self.layout.robot, qpos)
        )
        self._make_current(worlds)

    def _clear(
        self, ids: Sequence[int], homes: Sequence[str], qpos: np.ndarray, qvel: np.ndarray
    ) -> torch.Tensor:
        rows = [
            self.engine.homes.row(home, self.model(home))
            for _, home in zip(ids, homes, strict=True)
        ]
        states = zip(homes, qpos, qvel, strict=True)
        rings = [self._rest.rings(home, self.model(home), q, v) for home, q, v in states]
        worlds = self._indices(ids)
        self.engine.clear(
            worlds,
            self._indices(rows),
            torch.as_tensor(np.stack(rings), device=self._torch_device),
        )
        return worlds

    def _make_current(self, worlds: torch.Tensor) -> None:
        self.engine.refresh(worlds)
        self.engine.clear_flags(worlds)

    def mend(self, ids: Sequence[int], homes: Sequence[str], qpos: Any) -> None:
        """Reset worlds that became NaN or infinite to ``qpos`` (n, nq) with zero velocity; they keep their taint.

        A row of ``qpos`` that is not finite is replaced by the model's ``qpos0``.
        """
        given = to_numpy(qpos)
        worlds = self._indices(ids)
        taint = self.engine.taint_t[worlds].clone()
        default = np.stack([self.model(home).qpos0 for home in homes])
        self.reset(
            ids,
            homes,
            np.where(np.isfinite(given).all(axis=1, keepdims=True), given, default),
        )
        # After the reset, which has cleared it.
        self.engine.taint_t[worlds] = taint

    def broken(self) -> torch.Tensor:
        """Return (W,) bool: worlds that became NaN or infinite in the last step and were set back to its start."""
        return self.engine.broken_t

    def write_qpos(self, world: int, qpos: Any) -> None:
        """Teleport one world to ``qpos`` (nq,) in its present home.

        The robot, and every object whose pose changes, get zero velocity.
        """
        self.teleport([world], qpos[None])

    def teleport(self, ids: Sequence[int], qpos: Any) -> None:
        """Teleport worlds ``ids`` to ``qpos`` (n, nq) as `write_qpos` does, in one launch."""
        worlds = self._indices(ids)
        self.engine.new_qpos_t[worlds] = self._upload(qpos)
        self.engine.refresh(worlds, teleport=True)

    def start_rows(
        self, homes: Sequence[str], qpos: np.ndarray
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Prepare device tensors for `reset_masked` from start states with zero velocity; uploads the homes.

        Args:
            homes: (n,) names of the homes.
            qpos: (n, nq) start states.

        Returns:
            Home rows (n,) int32; actuator commands (n, nu) float32; sleep rings (n, ntree) int32, see
            `RestFinder.rings`.
        """
        rows = np.array(
            [self.engine.homes.row(home, self.model(home)) for home in homes], np.int32
        )
        still = np.zeros(self.engine.qvel_t.shape[1])
        rings = [
            self._rest.rings(h, self.model(h), q, still)
            for h, q in zip(homes, qpos, strict=True)
        ]
        ctrl = holding_ctrl(self.model(homes[0]), self.layout.robot, qpos)
        device = self._torch_device
        return (
            torch.as_tensor(rows, device=device),
            self._upload(ctrl),
            torch.as_tensor(np.stack(rings), device=device),
        )

    def reset_masked(
        self,
        mask: torch.Tensor,
        rows: torch.Tensor,
        qpos: torch.Tensor,
        ctrl: torch.Tensor,
        rings: torch.Tensor,
        moved: torch.Tensor | None = None,
    ) -> None:
        """Reset the worlds of ``mask`` to their rows of ``qpos`` with zero velocity; others stay bitwise the same.

        Nothing is copied to or from the host. All arguments are tensors on the device with one row per world; rows
        outside of the masks are not read.

        Args:
            mask: (W,) bool, worlds to reset.
            rows: (W,) int32 home rows, from `start_rows`.
            qpos: (W, nq) float32 states.
            ctrl: (W, nu) float32 actuator commands, from `start_rows`.
            rings: (W, ntree) int32 sleep rings, from `start_rows`.
            moved: (W,) bool, worlds that are teleported to their row of ``qpos`` instead; disjoint from ``mask``.

        Raises:
            UsageError: the device is out of memory.
        """
        engine = self.engine
        engine.fresh_t.copy_(mask)
        engine.moved_t.copy_(torch.zeros_like(mask) if moved is None else moved)
        given = (rows, qpos, ctrl, rings)
        buffers = (
            engine.new_rows_t,
            engine.new_qpos_t,
            engine.new_ctrl_t,
            engine.new_rings_t,
        )
        for buffer, values in zip(buffers, given, strict=True):
            # Into the engine's own memory, whose addresses the graph holds.
            buffer.copy_(values)
        with room_for(self.num_worlds, self.device):
            engine.renew()

    def mend_broken(self) -> None:
        """Make the worlds that became NaN or infinite in the last step usable again, without a copy to the host.

        The step has set them back to their positions before it with zero velocity; this recomputes their derived
        quantities. They keep their taint and the commands of the step, where `mend` sets the commands of a start.
        """
        with room_for(self.num_worlds, self.device):
            self.engine.mend()

    def check_overflow(self) -> None:
        """Check that no buffer has overflowed since the simulator was made. Waits for the device.

        Raises:
            UsageError: a buffer has; names it, its size and twice that size.
        """
        names = self.engine.overflown()
        sizes = dataclasses.asdict(self.engine.sizes)
        if names:
            now = ", ".join(f"{name}={sizes[name]}" for name in names)
            more = ", ".join(f"{name!r}: {2 * (sizes[name] or 0)}" for name in names)
            raise UsageError(
                f"buffers of the engine overflowed ({now}), episodes are tainted; set buffers={{{more}}}"
            )

    def get_world(self, world: int) -> dict[str, np.ndarray]:
        """Return numpy copies of the physics state of one world: "time", "qpos", "qvel", "ctrl", "warmstart".

        Which trees sleep is not part of it, as in `CpuSimulator.get_world`.
        """
        return {
            name: to_numpy(rows[world]).copy()
            for name, rows in self._world_rows().items()
        }

    def set_world(self, world: int, home: str, saved: Mapping[str, np.ndarray]) -> None:
        """Restore one world in a home from a state of `get_world`, and clear its taint.

        Raises:
            UsageError: the arrays have the shapes of another layout.
        """
        rows = self._world_rows()
        for name, row in rows.items():
            got = np.shape(saved[name])
            need = tuple(row[world].shape)
            check(
                got == need,
                f"{name} of the state",
                got,
                f"of shape {need}",
                "It is of another layout.",
            )
        worlds = self._clear([world], [home], saved["qpos"][None], saved["qvel"][None])
        for name, row in rows.items():
            row[world] = self._upload(saved[name])
        self._make_current(worlds)

    def _world_rows(self) -> dict[str, torch.Tensor]:
        engine = self.engine
        return {
            "time": engine.time_t,
            "qpos": engine.qpos_t,
            "qvel": engine.qvel_t,
            "ctrl": engine.ctrl_t,
            "warmstart": engine.warmstart_t,
        }

    def step(self, ctrl: Any) -> None:
        """Advance all worlds by one control step under ``ctrl`` (W, nu).

        A float32 tensor on the device is used without a copy from the host.
        """
        # Into the engine's own memory, whose address the captured graph holds.
        self.engine.ctrl_t.copy_(torch.as_tensor(ctrl))
        with room_for(self.num_worlds, self.device):
            self.engine.step()

    def state(self) -> SimState:
        """Return the current state of all worlds; most arrays are views that the next step or reset overwrites."""
        q = self.engine.qpos_t
        v = self.engine.qvel_t
        return dataclasses.replace(
            self._views,
            robot_q=q[:, self._robot_q],
            robot_qd=v[:, self._robot_v],
            link_q=q[:, self._link_q],
            link_qd=v[:, self._link_v],
        )

    def _make_views(self) -> SimState:
        # Arrays that are contiguous in the engine become views. Joints are not contiguous: `state` gathers them.
        a = self.addresses
        engine = self.engine
        pose, velocity = (
            rows[:, start : start + width * len(a.object_q)].unflatten(
                1, (len(a.object_q), width)
            )
            for rows, start, width in (
                (engine.qpos_t, int(a.object_q[0]), 7),
                (engine.qvel_t, int(a.object_v[0]), 6),
            )
        )
        return SimState(
            robot_q=None,
            robot_qd=None,
            link_q=None,
            link_qd=None,
            object_pose=pose,
            object_vel=velocity,
            tcp_vel=wp.to_torch(engine.tcp_vel),
            link_force=wp.to_torch(engine.link_force),
            finger_force=wp.to_torch(engine.finger_force),
            finger_net=wp.to_torch(engine.finger_net),
            touch=wp.to_torch(engine.touch),
            ee_contact=wp.to_torch(engine.ee_contact),
            body_pos=wp.to_torch(engine.data.xpos),
            body_mat=wp.to_torch(engine.data.xmat),
            body_quat=wp.to_torch(engine.data.xquat),
        )

    def add_taint(self, world: int, mask: int) -> None:
        """Set the bits ``mask`` in the taint of a world."""
        self.engine.taint_t[world] |= mask

    def taint(self) -> torch.Tensor:
        """Return (W,) uint8: bit mask of the TAINTS of each world since its reset."""
        return self.engine.taint_t.clone()

    @property
    def _torch_device(self) -> torch.device:
        return self.engine.qpos_t.device

    def _indices(self, values: Sequence[int] | np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.asarray(values, np.int64), device=self._torch_device)

    def _upload(self, values: Any) -> torch.Tensor:
        return torch.as_tensor(values).to(device=self._torch_device, dtype=torch.float32)
