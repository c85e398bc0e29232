"""Estimates of the memory of worlds on the host and on a device, checked before worlds are made."""

from __future__ import annotations

from dataclasses import dataclass

from mjhab.core.errors import UsageError
from mjhab.core.machine import available_mb
from mjhab.envs.observations.modes import mode_outputs

CAMERAS = 2
"""Default number of cameras of a robot: one on its head, one on its hand."""
BASE_MB = 500
"""Memory of an environment without worlds: libraries and compiled homes (measured by `mjhab bench env`)."""
WORLD_MB = 1.5
"""Memory of one world with 30 objects: MjData, its batch rows and scratch (measured by `mjhab bench env`)."""
PIXEL_BYTES = {
    "rgb": 3,
    "depth": 2,
    "seg": 2,
    "target_depth": 1,
    "target_rgb": 3,
    "pointcloud": 12 + 3 + 2,
}
"""Per pixel and camera of observations: uint8 colour, int16 millimetres, int16 ids, bytes; xyz float32, colour, id."""
RASTER_BYTES = 3 + 4 + 2
"""Additional bytes per pixel in the rasterizer: colour, depth float32, id."""
OBS_COPIES = 2
"""Number of observations in memory: the last one, and the one before, which the caller may still hold."""
WARP_BASE_MB = 700
"""CUDA context, kernels, the shared model, tables of homes, contact buffers. Estimated, not measured on a GPU."""
WARP_WORLD_MB = 1.1
"""One world with 30 objects in MuJoCo Warp: 0.41 MB of arrays, 0.56 MB of temporary arrays of a substep, and 10 %
margin. From the arrays of 3 and of 32 worlds of TidyHouse on Warp's CPU device: their difference over 29."""
WARP_OBS_COPIES = 4
"""Observations and final observations of a step, and those of the step before."""
WARP_PIXEL_BYTES = {"rgb": 3, "depth": 4, "seg": 4}
"""Bytes per pixel and camera of the device renderer's images: uint8, float32, int32."""
WARP_SCENE_MB = 25 + 184
"""The render scene and the meshes of the 105 built-in homes, all in use; ReplicaCAD with 21 homes has 66 + 50."""
WARP_MOVERS = 256
"""Number of moving drawn parts in a world with 30 objects; most belong to the robot."""
WARP_DRAWN_AT_ONCE = 256
"""Worlds for which the renderer has scratch memory (`render.warp.cameras.WORLDS_AT_ONCE`)."""


@dataclass(frozen=True)
class Need:
    """Memory of worlds [MB]: ``base_mb`` without any, ``world_mb`` for each."""

    base_mb: float
    world_mb: float

    def total_mb(self, num_envs: int) -> float:
        """Memory of ``num_envs`` worlds [MB]."""
        return self.base_mb + self.world_mb * num_envs

    def most(self, free_mb: float) -> int:
        """Largest number of worlds that fits into ``free_mb`` [MB]."""
        # Not even the base may fit.
        return max(0, int((free_mb - self.base_mb) / self.world_mb))


@dataclass(frozen=True)
class WorldPictures:
    """Images of one world: ``obs_mode`` and ``camera_size`` [px] as in `EnvConfig`, and the number of ``cameras``."""

    obs_mode: str = "state"
    camera_size: int | tuple[int, int] = 128
    cameras: int = CAMERAS

    def size(self) -> tuple[int, float]:
        """Number of pixels of a world, and memory of the images in one observation [MB].

        Raises:
            UsageError: unknown observation mode.
        """
        outputs = mode_outputs(self.obs_mode)
        size = self.camera_size
        height, width = (size, size) if isinstance(size, int) else size
        # Without images no camera is drawn.
        pixels = self.cameras * height * width if outputs else 0
        return pixels, sum(PIXEL_BYTES[name] for name in outputs) * pixels / 2**20


def host_need(pictures: WorldPictures | None = None) -> Need:
    """Estimate the memory of worlds of backend cpu.

    Raises:
        UsageError: unknown observation mode.
    """
    pixels, images = (pictures or WorldPictures()).size()
    return Need(BASE_MB, WORLD_MB + OBS_COPIES * images + RASTER_BYTES * pixels / 2**20)


def device_need(
    pictures: WorldPictures,
    copies: int = WARP_OBS_COPIES,
    world_mb: float = WARP_WORLD_MB,
) -> Need:
    """Estimate the device memory of worlds of backend warp.

    Args:
        pictures: images of one world.
        copies: number of observations that are in memory at the same time.
        world_mb: memory of a world without images [MB].

    Raises:
        UsageError: unknown observation mode.
    """
    pixels, images = pictures.size()
    if not pixels:
        return Need(WARP_BASE_MB, world_mb)
    wanted = mode_outputs(pictures.obs_mode)
    drawn = [
        size
        for name, size in WARP_PIXEL_BYTES.items()
        if name in wanted or "pointcloud" in wanted
    ]
    # Scratch of a world: lists of moving parts per tile of 16 x 16 pixels; with colours light per pixel and 4 x 4 cell.
    scratch = pixels / 256 * (4 + 2 * WARP_MOVERS) + pixels * (8 + 12 / 16)
    poses = 48 * (WARP_MOVERS + pictures.cameras)
    return Need(
        WARP_BASE_MB + WARP_SCENE_MB + WARP_DRAWN_AT_ONCE * scratch / 2**20,
        world_mb + copies * images + (sum(drawn) * pixels + poses) / 2**20,
    )


def check_memory(num_envs: int) -> None:
    """Refuse a number of worlds of backend cpu, without cameras, that does not fit into memory.

    Raises:
        UsageError: says what is needed, what is free, and the largest number that fits.
    """
    _check(host_need(), num_envs, available_mb(), "here")


def check_device_memory(
    num_envs: int,
    pictures: WorldPictures | None = None,
    device: str = "",
    copies: int = WARP_OBS_COPIES,
    world_mb: float = WARP_WORLD_MB,
) -> None:
    """Refuse a number of worlds of backend warp that does not fit into the device's memory; imports Warp.

    Args:
        num_envs: worlds.
        pictures: of one world; none if not given.
        device: a Warp device, "" for the first GPU. For "cpu" the memory of this machine counts.
        copies, world_mb: see `device_need`.

    Raises:
        UsageError: says what is needed, what is free, and the largest number that fits; or there is no such device.
    """
    from mjhab.sim.warp.device import free_mb, open_device

    opened = open_device(device)
    # Warp's CPU device takes the memory of the machine.
    free = free_mb(opened) if opened.is_cuda else available_mb()
    _check(
        device_need(pictures or WorldPictures(), copies, world_mb),
        num_envs,
        free,
        f"on {opened}",
    )


def _check(need: Need, num_envs: int, free: float | None, where: str) -> None:
    # Where the system does not tell, nothing is refused.
    if free is not None and need.total_mb(num_envs) > free:
        most = need.most(free)
        advice = (
            f"At most {most:,} fit (--worlds): set num_envs={most}."
            if most
            else "Not even one fits."
        )
        raise UsageError(
            f"{num_envs} worlds need about {need.total_mb(num_envs):,.0f} MB, but {free:,.0f} MB are free {where}. "
            f"{advice}"
        )
