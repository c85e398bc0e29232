"""``mjhab doctor``: installed libraries, renderers, GPU, cores and caches of this machine."""

from __future__ import annotations

import importlib.util
import platform
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mjhab.cli.output import Listing, report
from mjhab.core.files.cache import cache_dir
from mjhab.core.machine import cores, gpu_name, install_extra, installed, pip_install
from mjhab.core.memory_cache import LIMIT_VARIABLE, memory_limit_mb
from mjhab.core.registration.plugins import loaded_plugins
from mjhab.core.version import __version__

PINNED_MUJOCO = "3.17.0"
EXTRAS = {
    "data": ("pyarrow",),
    "learn": ("safetensors", "tensorboard", "torch"),
    "gpu": ("mujoco_warp", "torch", "warp"),
    "view": ("viser",),
    "photo": ("mitsuba", "mitsuba_oidn"),
    "serve": ("msgpack", "websockets"),
    "scale": ("ray",),
    "vision": ("onnxruntime",),
}
"""Modules that each extra of the package installs, as in pyproject.toml (without "all" and "dev")."""


@dataclass(frozen=True)
class DoctorSpec:
    """Show installed libraries, working renderers, the number of cores, and the folders of caches."""


def run_doctor(spec: DoctorSpec, json: bool) -> int:
    """Print the findings; returns 1 if MuJoCo is missing or does not have the version that the benchmark requires."""
    found = diagnose()
    report(json, found, *_tables(found))
    # Another version of MuJoCo steps to other states, so that results would not compare.
    return 0 if found["mujoco"] == PINNED_MUJOCO else 1


def diagnose() -> dict[str, Any]:
    """Properties of this machine and installation, as JSON data.

    Returns:
        ``python`` and ``mujoco``: versions; ``renderers``: whether each works, by name; ``gpu``: its name or None;
        ``cores``; ``cache``: its folder; ``memory_cache_mb``: limit of a process's cache in memory [MB]; ``plugins``:
        name, origin, registered names, and error ("" for none) of each; ``robots``: by name the message that says which
        files are missing, "" for none.
    """
    from mjhab.render.gl_probe import renderer_probe
    from mjhab.robots.availability import missing_files
    from mjhab.robots.registry import ROBOTS

    return {
        "python": platform.python_version(),
        "mujoco": installed("mujoco"),
        "renderers": {"rasterizer": True, **renderer_probe()},
        "gpu": gpu_name(),
        "cores": cores(),
        "cache": str(cache_dir()),
        "memory_cache_mb": memory_limit_mb(),
        "plugins": [asdict(plugin) for plugin in loaded_plugins()],
        "robots": {robot.name: missing_files(robot) for robot in ROBOTS.values()},
    }


def _tables(found: dict[str, Any]) -> list[Listing]:
    mujoco = found["mujoco"] or "missing"
    if found["mujoco"] != PINNED_MUJOCO:
        mujoco += (
            f"; mjhab needs {PINNED_MUJOCO}: {pip_install(f'mujoco=={PINNED_MUJOCO}')}"
        )
    rows = [("mjhab", __version__), ("python", found["python"]), ("mujoco", mujoco)]
    rows += [
        (name, installed(name) or "missing")
        for name in ("numpy", "numba", "gymnasium", "gymnasium-robotics")
    ]
    extras = []
    for name, modules in EXTRAS.items():
        # Found and not imported: some of these take seconds, or start a runtime.
        here = all(importlib.util.find_spec(module) for module in modules)
        extras.append(
            (name, ", ".join(modules), "yes" if here else f"no: {install_extra(name)}")
        )
    robots = [
        (name, f"no: {missing}" if missing else "yes")
        for name, missing in found["robots"].items()
    ]
    renderers = [
        (name, "works" if works else _advice(name))
        for name, works in found["renderers"].items()
    ]
    gpu = found["gpu"] or "none found (the CPU is all that is needed)"
    machine = [
        ("cores", found["cores"]),
        ("gpu", gpu),
        ("cache", found["cache"]),
        ("cache size", _size(found["cache"])),
        (
            "cache in memory",
            f"{found['memory_cache_mb']:g} MB at most (${LIMIT_VARIABLE})",
        ),
    ]
    tables = [
        Listing("installed", ("what", "version"), rows),
        Listing("extras", ("extra", "modules", "installed"), extras),
        Listing("robots", ("robot", "available"), robots),
        Listing("renderers", ("renderer", "state"), renderers),
        Listing("machine", ("what", "value"), machine),
    ]
    if found["plugins"]:
        plugins = map(_plugin_row, found["plugins"])
        tables.append(Listing("plugins", ("plugin", "where", "registered"), plugins))
    return tables


def _plugin_row(plugin: dict[str, Any]) -> tuple[str, str, str]:
    registered = "\n".join(plugin["registered"]) or "nothing"
    failed = f"could not be loaded: {plugin['error']}"
    return plugin["name"], plugin["origin"], failed if plugin["error"] else registered


def _advice(renderer: str) -> str:
    packages = {"egl": "libegl1 libgl1-mesa-dri", "osmesa": "libosmesa6"}
    if renderer not in packages:
        return "does not work here"
    return f"does not work here and is not needed (apt install {packages[renderer]} brings it)"


def _size(cache: str) -> str:
    folder = Path(cache)
    total = (
        sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        if folder.is_dir()
        else 0
    )
    return f"{total / 1e6:.1f} MB"
