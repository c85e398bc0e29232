"""Adapter that gives `WarpSimulator` the numpy interface of `CpuSimulator`, for reports that compare both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mjhab.core.arrays import map_record, to_numpy
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.protocol import SimState


class HostTwin:
    """A `WarpSimulator` with numpy arrays in and out. See `Simulator` for the methods.

    `state` copies everything to the host: for comparisons, not for speed.

    Args:
        warp: a `WarpSimulator`.
        cpu: CPU simulator of the same layout that it replaces in an environment; gives compiled models and sizes.
    """

    def __init__(self, warp: Any, cpu: CpuSimulator) -> None:
        self.warp = warp
        self.model = cpu.model
        self.batch = cpu.batch
        self.layout = cpu.layout
        self.addresses = cpu.addresses
        self.drives = cpu.drives
        self.num_worlds = cpu.num_worlds
        self.num_threads = cpu.num_threads

    @property
    def qpos(self) -> np.ndarray:
        """(W, nq) float64 copy of the generalized positions."""
        return _double(self.warp.qpos)

    def reset(self, ids: Sequence[int], homes: Sequence[str], qpos: np.ndarray) -> None:
        """Reset worlds to the states ``qpos`` (n, nq) of homes with zero velocity."""
        self.warp.reset(ids, homes, qpos)

    def mend(self, ids: Sequence[int], homes: Sequence[str], qpos: np.ndarray) -> None:
        """Reset worlds that became NaN or infinite; they keep their taint."""
        self.warp.mend(ids, homes, qpos)

    def write_qpos(self, world: int, qpos: np.ndarray) -> None:
        """Teleport one world to ``qpos`` (nq,)."""
        self.warp.write_qpos(world, qpos)

    def step(self, ctrl: np.ndarray) -> None:
        """Advance all worlds by one control step under ``ctrl`` (W, nu)."""
        self.warp.step(np.asarray(ctrl, np.float32))

    def state(self) -> SimState:
        """Return numpy copies of the state of all worlds, floats as float64."""
        return map_record(_double, self.warp.state())

    def get_world(self, world: int) -> dict[str, np.ndarray]:
        """Return the physics state of one world, see `CpuSimulator.get_world`."""
        return self.warp.get_world(world)

    def set_world(self, world: int, home: str, saved: Mapping[str, np.ndarray]) -> None:
        """Restore one world in a home from a state of `get_world`."""
        self.warp.set_world(world, home, saved)

    def broken(self) -> np.ndarray:
        """Return (W,) bool: worlds that became NaN or infinite in the last step."""
        return to_numpy(self.warp.broken()).astype(bool)

    def add_taint(self, world: int, mask: int) -> None:
        """Set the bits ``mask`` in the taint of a world."""
        self.warp.add_taint(world, mask)

    def taint(self) -> np.ndarray:
        """Return (W,) uint8: bit mask of the TAINTS of each world since its reset."""
        return to_numpy(self.warp.taint()).astype(np.uint8)


def _double(values: Any) -> np.ndarray:
    array = to_numpy(values)
    # A copy either way, as the device overwrites its arrays in the next step.
    return array.astype(np.float64) if array.dtype.kind == "f" else array.copy()
