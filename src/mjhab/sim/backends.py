"""Choice of the simulator backend: C MuJoCo on the CPU, or MuJoCo Warp, which is imported only when chosen."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mjhab.core.errors import unknown_name, wrong_value
from mjhab.core.libraries import check_imports, missing_libraries, require_libraries

if TYPE_CHECKING:
    from mjhab.layout.layout import Layout
    from mjhab.robots.parts import Drives

    # Here, because warp takes seconds to load and mujoco is not needed for it.
    from mjhab.sim.mujoco.cpu import CpuSimulator
    from mjhab.sim.warp.simulator import WarpSimulator

BACKENDS = ("auto", "cpu", "warp")
GPU_MODULES = ("warp", "mujoco_warp", "torch")
"""Modules that the extra "gpu" installs."""
COMPILED_MODULES = ("warp", "torch")
"""Those that may be installed and broken."""


def resolve(name: str) -> str:
    """Return the backend to use, "cpu" or "warp", for one of BACKENDS.

    "auto" is "warp" if the extra "gpu" is installed and finds a CUDA device, else "cpu". Warp and torch are imported
    here, if "warp" or "auto" is asked for and the extra is installed.

    Raises:
        UsageError: unknown name; "warp" without the extra, or an extra that cannot be imported (says what to install).
    """
    if name not in BACKENDS:
        raise unknown_name("backend", name, BACKENDS)
    missing = missing_libraries(GPU_MODULES)
    # A missing library is no error here: the processor does as well.
    if name == "auto":
        name = "warp" if not missing and cuda_devices() else "cpu"
    if name == "warp":
        require_libraries("backend 'warp'", GPU_MODULES, "gpu")
        # Now and not deep inside of the first step: a torch of another CUDA fails with many different errors.
        check_imports(COMPILED_MODULES, "gpu")
    return name


def check_device(backend: str, device: str) -> None:
    """Check that a backend can use a device; which devices backend "warp" has shows when it is opened.

    Raises:
        UsageError: backend "cpu" was asked for another device than "" or "cpu".
    """
    if backend == "cpu" and device not in ("", "cpu"):
        raise wrong_value(
            "device",
            device,
            "left out with backend 'cpu'",
            "Backend 'warp' simulates on one.",
        )


def cuda_devices() -> list[str]:
    """Return the names of the CUDA devices that Warp can use, e.g. ["cuda:0"]. Warp must be installed.

    Raises:
        UsageError: Warp cannot be imported.
    """
    check_imports(("warp",), "gpu")
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
    """Open a simulator with a batch of worlds of a layout.

    Args:
        name: one of BACKENDS.
        layout: names, order and sizes shared by all homes.
        num_worlds: size W of the batch, at least 1.
        threads: CPU threads (backend "cpu" only); 0 uses every core.
        device: Warp device (backend "warp" only): "cuda:0", "cpu" (slow, for tests); "" is the first CUDA device.
        drives: changes to the robot's servos that the control mode needs; None for none.

    Raises:
        UsageError: unknown backend or device, no CUDA device, the extra is missing, or no room for the worlds.
    """
    extra: dict[str, Any] = {"drives": drives}
    name = resolve(name)
    check_device(name, device)
    if name == "warp":
        from mjhab.sim.warp.simulator import WarpSimulator

        return WarpSimulator(layout, num_worlds, device, **extra)
    from mjhab.sim.mujoco.cpu import CpuSimulator

    return CpuSimulator(layout, num_worlds, threads, **extra)
