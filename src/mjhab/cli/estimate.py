"""``mjhab doctor --estimate``: what memory a number of worlds takes, and how many would fit."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from typing import Any

from mjhab.cli.options.common import DoctorOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.core.errors import UsageError
from mjhab.envs.parts.memory import Need, available_mb, device_need, host_need


@dataclass(frozen=True)
class Room:
    """What worlds need on one backend, and what is free there [MB], None where nobody knows."""

    backend: str
    place: str
    need: Need
    free_mb: float | None

    @property
    def most(self) -> int | None:
        """The largest number of worlds that fits; None where nobody knows what is free."""
        return None if self.free_mb is None else self.need.most(self.free_mb)


def rooms(options: DoctorOptions) -> list[Room]:
    """What the worlds of ``options`` need on the cpu backend, and on a GPU.

    Raises:
        UsageError: unknown observation mode.
    """
    pictures = (options.obs, options.camera_size)
    return [
        Room("cpu", "this machine", host_need(*pictures), available_mb()),
        Room("warp", "the first GPU", device_need(*pictures), gpu_free_mb()),
    ]


def gpu_free_mb() -> float | None:
    """Free memory of the first NVIDIA GPU [MB] as its driver tells it; None without one."""
    tool = shutil.which("nvidia-smi")
    if tool is None:
        return None
    command = [tool, "--query-gpu=memory.free", "--format=csv,noheader,nounits", "--id=0"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=20, check=True)
        return float(answer.stdout.strip().splitlines()[0])
    except (subprocess.SubprocessError, OSError, ValueError, IndexError):
        return None


def run_estimate(options: DoctorOptions) -> int:
    """Print the estimate.

    Raises:
        UsageError: the worlds fit on no backend whose memory is known; says how many would.
    """
    at_least("num-envs", options.num_envs, 1)
    at_least("camera-size", options.camera_size, 8)
    found = rooms(options)
    rows = [_row(room, options.num_envs) for room in found]
    if options.json:
        print_json({"num_envs": options.num_envs, "obs": options.obs, "backends": rows})
    else:
        title = f"{options.num_envs:,} worlds, {options.obs}, {options.camera_size} px (estimates)"
        print_table(
            title,
            list(rows[0]),
            [["unknown" if x is None else x for x in row.values()] for row in rows],
        )
    known = [room for room in found if room.most is not None]
    if known and not any(room.most >= options.num_envs for room in known):  # type: ignore[operator]
        told = "; ".join(
            f"backend {room.backend} needs {room.need.total_mb(options.num_envs):,.0f} MB, {room.free_mb:,.0f} MB are "
            f"free on {room.place}: at most --num-envs {room.most}"
            for room in known
        )
        raise UsageError(f"{options.num_envs} worlds do not fit: {told}.")
    return 0


def estimate_rows(options: DoctorOptions) -> list[dict[str, Any]]:
    """A row per backend: "backend", "memory_mb", "world_mb", "base_mb", "free_mb", "fits", "most"."""
    return [_row(room, options.num_envs) for room in rooms(options)]


def _row(room: Room, num_envs: int) -> dict[str, Any]:
    need = room.need
    free = room.free_mb
    most = room.most
    return {
        "backend": room.backend,
        "memory_mb": round(need.total_mb(num_envs)),
        "world_mb": round(need.world_mb, 2),
        "base_mb": round(need.base_mb),
        "free_mb": None if free is None else round(free),
        "fits": None if most is None else most >= num_envs,
        "most": most,
    }
