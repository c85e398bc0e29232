"""The replay buffer: one ring buffer of control steps per world, which stores every observation once.

The observation after a step is the next entry of the same ring, so images are not stored twice. At the end of an
episode an extra entry holds the last observation; no transition starts from it.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mjhab.core.errors import UsageError, fault
from mjhab.envs.parts.memory import available_mb
from mjhab.learning.reinforcement.agent_encoder import AgentObs

# The rest is for batches, gradients and the simulator's own growth.
MEMORY_SHARE = 0.8
"""Largest fraction of the free memory that a buffer may occupy."""


@dataclass(frozen=True)
class ReplayShape:
    """Sizes of a replay buffer.

    worlds: number of rings. steps: entries per ring. vector, privileged, actions: widths of these arrays.
    images: (channels, height, width) of one observation; the frames of a history are stacked as channels.
    """

    worlds: int
    steps: int
    vector: int
    images: tuple[int, int, int]
    privileged: int
    actions: int

    @classmethod
    def from_plain(cls, values: Mapping[str, Any]) -> ReplayShape:
        """Build from the dict of ``dataclasses.asdict``, also after a round trip through JSON."""
        return cls(**{**values, "images": tuple(values["images"])})

    @property
    def row_bytes(self) -> int:
        """Bytes of one control step of one world."""
        floats = self.vector + self.privileged + self.actions + 1
        return 4 * floats + int(np.prod(self.images)) + 2

    @property
    def total_bytes(self) -> int:
        """Bytes of the whole buffer."""
        return self.worlds * self.steps * self.row_bytes

    @property
    def words(self) -> str:
        """Description of the size for messages."""
        count = self.worlds * self.steps
        size = self.total_bytes
        memory = f"{size / 2**30:.2f} GiB" if size >= 2**30 else f"{size / 2**20:.1f} MiB"
        return f"{count:,} control steps, {memory}"

    def check(self, device: torch.device, folder: Path | None = None) -> None:
        """Refuse a buffer that does not fit into memory, or whose new files do not fit on the disk of ``folder``.

        Raises:
            UsageError: how much it takes, what there is, and how many control steps fit.
        """
        if device.type == "cuda":
            free = torch.cuda.mem_get_info(device)[0]
        else:
            megabytes = available_mb()
            # Where the system does not tell, the buffer is tried.
            free = sys.maxsize if megabytes is None else int(megabytes * 1e6)
        self._check_room(free, "free")
        if folder is not None:
            # The files are sparse: on a full disk the first access beyond it would kill the process.
            self._check_room(
                shutil.disk_usage(folder).free, f"free on the disk of {folder}"
            )

    def _check_room(self, free: int, where: str) -> None:
        most = int(MEMORY_SHARE * free)
        if self.total_bytes > most:
            fitting = most // self.row_bytes
            raise UsageError(
                f"the replay buffer ({self.words}) does not fit: {free / 2**30:.2f} GiB are {where}. A capacity of "
                f"{fitting:,} control steps fits (--capacity {fitting}, or fewer demonstrations if these are too many)"
                ", or smaller images."
            )


@dataclass(frozen=True, eq=False)
class Transitions:
    """B transitions: observations, actions (B, A), reward (B,), next observations, terminated (B,) bool."""

    seen: AgentObs
    actions: Tensor
    reward: Tensor
    next_seen: AgentObs
    terminated: Tensor


class ReplayBuffer:
    """Ring buffers with the most recent control steps of every world.

    Args:
        shape: sizes of the arrays. device: where the arrays lie.
        folder: where the arrays are memory-mapped files that outlive the process (CPU only); None keeps them in
            memory.
        reserve: oldest entries of each ring that are never drawn. New entries overwrite them between two checkpoints,
            so a run resumed from the older checkpoint draws the same transitions.
    """

    _ARRAYS = (
        "vector",
        "images",
        "privileged",
        "actions",
        "reward",
        "terminated",
        "begins",
    )

    def __init__(
        self,
        shape: ReplayShape,
        device: torch.device,
        folder: Path | None = None,
        reserve: int = 0,
    ) -> None:
        if shape.steps - reserve < 2:
            raise UsageError(
                f"a replay buffer of {shape.steps} control steps per world is too small; it needs more than "
                f"{reserve + 2}. Raise --capacity."
            )
        # Files that are there already need no more room.
        shape.check(device, folder.parent if folder and not folder.exists() else None)
        self.shape = shape
        self.device = device
        self._reserve = reserve
        self._folder = folder
        self.is_new = folder is None
        """Whether it lacks an array of an earlier start of the run."""
        self.position = torch.zeros(shape.worlds, dtype=torch.int64, device=device)
        """(W,) number of entries written to each ring so far."""
        kinds = {
            "vector": (torch.float32, (shape.vector,)),
            "images": (torch.uint8, shape.images),
            "privileged": (torch.float32, (shape.privileged,)),
            "actions": (torch.float32, (shape.actions,)),
            "reward": (torch.float32, ()),
            "terminated": (torch.bool, ()),
            "begins": (torch.bool, ()),
        }
        self._rows = torch.arange(shape.worlds, device=device)
        self._data = {
            name: self._allocate(name, kind, (shape.worlds, shape.steps, *size))
            for name, (kind, size) in kinds.items()
        }

    def _allocate(self, name: str, kind: torch.dtype, size: tuple[int, ...]) -> Tensor:
        # An empty array cannot be mapped.
        if self._folder is None or not np.prod(size):
            return torch.zeros(size, dtype=kind, device=self.device)
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self._folder / f"{name}.npy"
        dtype = torch.zeros(0, dtype=kind).numpy().dtype
        if path.is_file():
            array = np.lib.format.open_memmap(path, mode="r+")
            if array.shape != size or array.dtype != dtype:
                raise fault(
                    path,
                    f"holds an array {array.shape} {array.dtype} instead of {size} {dtype}: it belongs to "
                    "another run.",
                )
        else:
            self.is_new = True
            array = np.lib.format.open_memmap(path, mode="w+", dtype=dtype, shape=size)
        return torch.from_numpy(array)

    @property
    def episodes(self) -> int:
        """Number of finished episodes in a buffer whose rings have not wrapped around yet."""
        steps = torch.arange(self.shape.steps, device=self.device)
        written = steps[None] < self.position[:, None]
        return int((written & ~self._data["begins"]).sum())

    def __len__(self) -> int:
        """Approximate number of transitions that can be drawn; the last observations of episodes are counted, too."""
        kept = self.position.clamp(max=self.shape.steps - self._reserve)
        return int((kept - 1).clamp(min=0).sum())

    def add(
        self,
        seen: AgentObs,
        actions: Tensor,
        reward: Tensor,
        terminated: Tensor,
        worlds: Tensor | None = None,
    ) -> None:
        """Append one control step: the observation before it, the action, and the resulting reward and termination.

        Without ``worlds`` the rows are those of all worlds; else row i is of world ``worlds[i]``, (n,) int.
        """
        at = self._rows if worlds is None else worlds
        self._write(at, seen, actions, reward, terminated, True)

    def close(self, worlds: Tensor, last: AgentObs) -> None:
        """Append the last observation of the worlds (n,) whose episodes ended; ``last`` has n rows."""
        nothing = torch.zeros(len(worlds), self.shape.actions, device=self.device)
        zero = torch.zeros(len(worlds), device=self.device)
        self._write(worlds, last, nothing, zero, zero.bool(), False)

    def cut(self, last: AgentObs) -> None:
        """End the running episodes of all worlds here; ``last`` (W rows) are their last observations."""
        newest = (self.position - 1) % self.shape.steps
        running = (self.position > 0) & self._data["begins"][self._rows, newest]
        worlds = torch.nonzero(running).flatten()
        self.close(worlds, last.rows(worlds))

    def _write(
        self,
        worlds: Tensor,
        seen: AgentObs,
        actions: Tensor,
        reward: Tensor,
        terminated: Tensor,
        begins: bool,
    ) -> None:
        at = (worlds, self.position[worlds] % self.shape.steps)
        data = self._data
        data["vector"][at] = seen.vector
        if seen.images.numel():
            data["images"][at] = seen.images
        data["privileged"][at] = seen.privileged
        data["actions"][at] = actions
        data["reward"][at] = reward
        data["terminated"][at] = terminated
        data["begins"][at] = begins
        self.position[worlds] += 1

    def draw(self, count: int, random: torch.Generator) -> Transitions:
        """Draw ``count`` transitions uniformly."""
        kept = self.position.clamp(max=self.shape.steps - self._reserve)
        ready = torch.nonzero(kept >= 2).flatten()
        if not len(ready):
            raise ValueError("the replay buffer holds no transition yet")
        found: list[Tensor] = []
        lacking = count
        while lacking:
            # Entries without a transition are drawn and rejected: they are few, and the rest stays uniform.
            more = 2 * lacking + 8
            places = torch.rand(more, 2, generator=random, dtype=torch.float64).to(
                self.device
            )
            lengths = (kept[ready] - 1).cumsum(0)
            number = (places[:, 0] * lengths[-1]).long()
            which = torch.searchsorted(lengths, number, right=True)
            world = ready[which]
            back = (places[:, 1] * (kept[world] - 1)).long()
            step = self.position[world] - 2 - back
            rows = torch.stack([world, step % self.shape.steps], dim=1)
            rows = rows[self._data["begins"][rows[:, 0], rows[:, 1]]][:lacking]
            found.append(rows)
            lacking -= len(rows)
        rows = torch.cat(found)
        here = (rows[:, 0], rows[:, 1])
        there = (rows[:, 0], (rows[:, 1] + 1) % self.shape.steps)
        data = self._data
        return Transitions(
            self._seen(here),
            data["actions"][here],
            data["reward"][here],
            self._seen(there),
            data["terminated"][here],
        )

    def _seen(self, at: tuple[Tensor, Tensor]) -> AgentObs:
        data = self._data
        return AgentObs(data["vector"][at], data["images"][at], data["privileged"][at])
