"""The warp simulator dressed as the cpu simulator: numpy in and out, for reports that run environments on both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mjhab.core.arrays import map_record, to_numpy
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.sim.protocol import SimState


class HostTwin:
    """See `Simulator` for the methods. Every step copies the state to the host: this is for comparison, not for speed.

    Args:
        warp: a WarpSimulator.
        cpu: the simulator of the same layout that the environment had; lends its compiled models.
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
        """(W, nq) copy of the generalized positions."""
        return _double(self.warp.qpos)

    def reset(self, ids: Sequence[int], homes: Sequence[str], qpos: np.ndarray) -> None:
        """Put worlds into homes at rest in the states ``qpos`` (n, nq)."""
        self.warp.reset(ids, homes, qpos)

    def mend(self, ids: Sequence[int], homes: Sequence[str], qpos: np.ndarray) -> None:
        """Like `reset`, for worlds that broke."""
        self.warp.mend(ids, homes, qpos)

    def write_qpos(self, world: int, qpos: np.ndarray) -> None:
        """Move one world to ``qpos`` (nq,)."""
        self.warp.write_qpos(world, qpos)

    def step(self, ctrl: np.ndarray) -> None:
        """Advance all worlds by one control step under ``ctrl`` (W, nu)."""
        self.warp.step(np.asarray(ctrl, np.float32))

    def state(self) -> SimState:
        """Copies of the state of all worlds."""
        return map_record(_double, self.warp.state())

    def get_world(self, world: int) -> dict[str, np.ndarray]:
        """Everything the physics of one world depends on."""
        return self.warp.get_world(world)

    def set_world(self, world: int, home: str, saved: Mapping[str, np.ndarray]) -> None:
        """Put one world into a state from `get_world`."""
        self.warp.set_world(world, home, saved)

    def broken(self) -> np.ndarray:
        """(W,) bool: worlds that the last step made NaN."""
        return to_numpy(self.warp.broken()).astype(bool)

    def add_taint(self, world: int, mask: int) -> None:
        """Mark a world with the bits of ``mask``."""
        self.warp.add_taint(world, mask)

    def taint(self) -> np.ndarray:
        """(W,) uint8 bit mask of TAINTS."""
        return to_numpy(self.warp.taint()).astype(np.uint8)


def _double(values: Any) -> np.ndarray:
    array = to_numpy(values)
    return array.astype(np.float64) if array.dtype.kind == "f" else array.copy()
