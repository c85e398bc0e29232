"""``mjhab doctor --estimate``: what memory a number of worlds takes, and how many would fit."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from typing import Any

from mjhab.cli.options import DoctorOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.core.errors import UsageError
from mjhab.envs.memory import BASE_MB, WORLD_MB, available_mb
from mjhab.envs.observations import mode_outputs

CAMERAS = 2
PIXEL_BYTES = {"rgb": 3, "depth": 2, "seg": 2, "pointcloud": 12 + 3 + 2}
"""Per pixel and camera of an observation: uint8 colour, int16 millimetres, int16 ids; xyz float32, colour, id."""
RASTER_BYTES = 3 + 4 + 2
"""What the rasterizer holds of a pixel beside: colour, depth float32, id."""
OBS_COPIES = 2
"""The last observation, and that of the step before, which the caller may still hold."""
WARP_BASE_MB = 700
"""CUDA context, kernels, the shared model, tables of homes, contacts kept for a crowd. Not measured on a GPU."""
WARP_WORLD_MB = 1.1
"""One world with 30 objects in MuJoCo Warp: 0.41 MB of arrays, 0.56 MB that a substep allocates on its way (sums of the
arrays of 3 and of 32 worlds of TidyHouse on Warp's CPU device, difference over 29), and a tenth on top."""
WARP_RENDER_BYTES = 17
"""What a batch renderer holds of a pixel, its tree of boxes included: 0.54 MB for 2 x 128 x 128."""


@dataclass(frozen=True)
class Need:
    """Memory [MB] of one backend: before the worlds, and of each world."""

    backend: str
    place: str
    base_mb: float
    world_mb: float
    free_mb: float | None

    def total_mb(self, num_envs: int) -> float:
        """All of it."""
        return self.base_mb + self.world_mb * num_envs

    @property
    def most(self) -> int | None:
        """The largest number of worlds that fits; None where nobody knows what is free."""
        return None if self.free_mb is None else max(0, int((self.free_mb - self.base_mb) / self.world_mb))


def needs(options: DoctorOptions) -> list[Need]:
    """What the worlds of ``options`` need on the cpu backend, and on a GPU.

    Raises:
        UsageError: unknown observation mode.
    """
    outputs = mode_outputs(options.obs)
    pixels = CAMERAS * options.camera_size**2 if outputs else 0
    images = OBS_COPIES * sum(PIXEL_BYTES[name] for name in outputs) * pixels / 2**20
    raster = RASTER_BYTES * pixels / 2**20
    return [
        Need("cpu", "this machine", BASE_MB, WORLD_MB + images + raster, available_mb()),
        Need(
            "warp",
            "the first GPU",
            WARP_BASE_MB,
            WARP_WORLD_MB + images + WARP_RENDER_BYTES * pixels / 2**20,
            gpu_free_mb(),
        ),
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
    found, rows = needs(options), estimate_rows(options)
    if options.json:
        print_json({"num_envs": options.num_envs, "obs": options.obs, "backends": rows})
    else:
        title = f"{options.num_envs:,} worlds, {options.obs}, {options.camera_size} px (estimates)"
        print_table(title, list(rows[0]), [["unknown" if x is None else x for x in row.values()] for row in rows])
    known = [need for need in found if need.most is not None]
    if known and not any(need.most >= options.num_envs for need in known):  # type: ignore[operator]
        told = "; ".join(
            f"backend {need.backend} needs {need.total_mb(options.num_envs):,.0f} MB, {need.free_mb:,.0f} MB are free "
            f"on {need.place}: at most --num-envs {need.most}"
            for need in known
        )
        raise UsageError(f"{options.num_envs} worlds do not fit: {told}.")
    return 0


def estimate_rows(options: DoctorOptions) -> list[dict[str, Any]]:
    """A row per backend: "backend", "memory_mb", "world_mb", "base_mb", "free_mb", "fits", "most"."""
    return [_row(need, options.num_envs) for need in needs(options)]


def _row(need: Need, num_envs: int) -> dict[str, Any]:
    free = None if need.free_mb is None else round(need.free_mb)
    fits = None if need.most is None else need.most >= num_envs
    return {
        "backend": need.backend, "memory_mb": round(need.total_mb(num_envs)), "world_mb": round(need.world_mb, 2),
        "base_mb": need.base_mb, "free_mb": free, "fits": fits, "most": need.most,
    }  # fmt: skip
