"""Memory estimates of worlds for every backend, and how many worlds fit."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from typing import Any

from mjhab.envs.parts.memory import (
    Need,
    WorldPictures,
    available_mb,
    device_need,
    host_need,
)


@dataclass(frozen=True)
class WorldMemory:
    """Memory of worlds on one backend.

    Attributes:
        backend: "cpu" or "warp".
        place: the machine or device, for people.
        need: estimated memory.
        free_mb: free memory [MB]; None if unknown.
    """

    backend: str
    place: str
    need: Need
    free_mb: float | None

    @property
    def most(self) -> int | None:
        """Largest number of worlds that fits; None if the free memory is unknown."""
        return None if self.free_mb is None else self.need.most(self.free_mb)

    def row(self, num_envs: int) -> dict[str, Any]:
        """The estimate for ``num_envs`` worlds as plain data.

        Keys: "backend", "memory_mb", "world_mb", "base_mb", "free_mb", "fits", "most".
        """
        need = self.need
        free = self.free_mb
        most = self.most
        return {
            "backend": self.backend,
            "memory_mb": round(need.total_mb(num_envs)),
            "world_mb": round(need.world_mb, 2),
            "base_mb": round(need.base_mb),
            "free_mb": None if free is None else round(free),
            # Unknown is neither yes nor no.
            "fits": None if most is None else most >= num_envs,
            "most": most,
        }


def world_memory(obs_mode: str = "state", camera_size: int = 128) -> list[WorldMemory]:
    """Estimate the memory of worlds on the cpu backend and on the first GPU.

    Args:
        obs_mode: see `EnvConfig`.
        camera_size: side of the square images [px].

    Raises:
        UsageError: unknown observation mode.
    """
    pictures = WorldPictures(obs_mode, camera_size)
    return [
        WorldMemory("cpu", "this machine", host_need(pictures), available_mb()),
        WorldMemory("warp", "the first GPU", device_need(pictures), gpu_free_mb()),
    ]


def gpu_free_mb() -> float | None:
    """Free memory of the first NVIDIA GPU [MB], from nvidia-smi; None without a GPU or the tool."""
    tool = shutil.which("nvidia-smi")
    if tool is None:
        return None
    command = [tool, "--query-gpu=memory.free", "--format=csv,noheader,nounits", "--id=0"]
    try:
        answer = subprocess.run(
            # A driver that hangs must not hang the estimate.
            command,
            capture_output=True,
            text=True,
            timeout=20,
            check=True,
        )
        return float(answer.stdout.strip().splitlines()[0])
    except (subprocess.SubprocessError, OSError, ValueError, IndexError):
        return None


def estimate_rows(
    num_envs: int, obs_mode: str = "state", camera_size: int = 128
) -> list[dict[str, Any]]:
    """`WorldMemory.row` of every backend; see `world_memory`."""
    return [memory.row(num_envs) for memory in world_memory(obs_mode, camera_size)]
