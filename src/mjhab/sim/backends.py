"""Which simulator runs: C MuJoCo on the CPU or MuJoCo Warp, imported only when it is asked for."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING, Any

from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.machine import install_extra

if TYPE_CHECKING:
    from mjhab.layout.layout import Layout
    from mjhab.robots.parts import Drives
    from mjhab.sim.mujoco.cpu import CpuSimulator
    from mjhab.sim.warp.simulator import WarpSimulator

BACKENDS = ("auto", "cpu", "warp")
GPU_MODULES = ("warp", "mujoco_warp", "torch")
"""What the extra "gpu" installs."""


def resolve(name: str) -> str:
    """ "cpu" or "warp" for one of BACKENDS; "auto" is warp where the extra is installed and finds a CUDA device.

    Warp is imported for "auto" alone, and only if the extra is installed.

    Raises:
        UsageError: unknown name; "warp" without the extra (says what to install).
    """
    if name not in BACKENDS:
        raise unknown_name("backend", name, BACKENDS)
    missing = [module for module in GPU_MODULES if not _installed(module)]
    if name == "auto":
        return "warp" if not missing and cuda_devices() else "cpu"
    if name == "warp" and missing:
        raise UsageError(
            f"backend 'warp' needs {', '.join(missing)}, not installed here: {install_extra('gpu')}"
        )
    return name


def cuda_devices() -> list[str]:
    """Names of the CUDA devices that Warp can use, e.g. ["cuda:0"]; it must be installed."""
    from mjhab.sim.warp import probe as warp_probe

    return warp_probe.cuda_devices()


def open_simulator(
    name: str,
    layout: Layout,
    num_worlds: int,
    *,
    threads: int = 0,
    device: str = "",
    drives: Drives | None = None,
) -> CpuSimulator | WarpSimulator:
    """A simulator of worlds of a layout.

    Args:
        name: one of BACKENDS.
        layout: what all homes share. num_worlds: >= 1. drives: servos of the robot.
        threads: of the CPU backend; 0 takes every core.
        device: of the warp backend: "cuda:0", "cpu" (slow, for tests); "" takes the first CUDA device.

    Raises:
        UsageError: unknown backend or device, no CUDA device, the extra is missing, or no room for the worlds.
    """
    extra: dict[str, Any] = {"drives": drives}
    if resolve(name) == "warp":
        from mjhab.sim.warp.simulator import WarpSimulator

        return WarpSimulator(layout, num_worlds, device, **extra)
    from mjhab.sim.mujoco.cpu import CpuSimulator

    return CpuSimulator(layout, num_worlds, threads, **extra)


def _installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ValueError:  # it was imported in a way that left no spec
        return True
