"""What the machine offers; the one module that reads what Linux alone tells."""

from __future__ import annotations

import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_CGROUP = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    (
        "/sys/fs/cgroup/memory/memory.limit_in_bytes",
        "/sys/fs/cgroup/memory/memory.usage_in_bytes",
    ),
)


def cores() -> int:
    """Number of CPU cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        # In a container fewer cores may be allowed than there are.
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def installed(package: str) -> str | None:
    """Return the version of an installed distribution, None if it is missing."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def pip_install(*words: str) -> str:
    """The command that installs into the Python that runs, whatever folder or shell it is given in.

    Args:
        words: requirements and options of pip.
    """
    python = sys.executable or "python"
    tool = [python, "-m", "pip", "install"]
    if importlib.util.find_spec("pip") is None:
        # Environments that uv makes have no pip.
        tool = ["uv", "pip", "install", "--python", python]
    return shlex.join([*tool, *words])


def install_extra(extra: str) -> str:
    """The command that brings an extra of mjhab to the Python that runs.

    It names the checkout that mjhab runs from, which need not be installed. Without one it names the package, which is
    installed, so that pip asks an index for what the extra needs alone.
    """
    folder = checkout()
    if folder is None:
        return pip_install(f"mjhab[{extra}]")
    # Editable, as it runs now: a copy would hide later changes of the checkout.
    return pip_install("-e", f"{folder}[{extra}]")


def checkout() -> Path | None:
    """The folder of the checkout that mjhab runs from, None where it runs from an installed package."""
    source = Path(__file__).resolve().parents[2]
    if source.name == "src" and (source.parent / "pyproject.toml").is_file():
        return source.parent
    return None


def gpu_name() -> str | None:
    """Return the name of the first NVIDIA GPU as its driver tells it; no CUDA context is opened."""
    tool = shutil.which("nvidia-smi")
    if tool is None:
        return None
    command = [tool, "--query-gpu=name", "--format=csv,noheader"]
    try:
        answer = subprocess.run(
            # A driver that hangs must not hang the command.
            command,
            capture_output=True,
            text=True,
            timeout=20,
            check=True,
        )
    except (subprocess.SubprocessError, OSError):
        return None
    names = answer.stdout.strip().splitlines()
    return names[0].strip() if names else None


def resident_mb() -> float:
    """Memory of this process that is in RAM [MB]; 0 where the system does not tell."""
    return round(next(_fields("/proc/self/status", "VmRSS"), 0.0), 1)


def processor() -> str:
    """Name of the processor as reported by the system."""
    lines = _read("/proc/cpuinfo").splitlines()
    names = (
        line.partition(":")[2].strip() for line in lines if line.startswith("model name")
    )
    return next(names, platform.processor())


def available_mb() -> float | None:
    """Memory [MB] this process may still take: free memory, less if a container allows less; None if unknown."""
    found = list(_fields("/proc/meminfo", "MemAvailable"))
    for limit, used in _CGROUP:
        top = _read(limit).strip()
        now = _read(used).strip()
        # "max" stands for no limit.
        if top.isdigit() and now.isdigit():
            found.append((int(top) - int(now)) / 2**20)
    # A container may be given more than the machine has free.
    return min(found, default=None)


def _fields(path: str, name: str) -> Iterator[float]:
    """Values [MB] of the lines ``name: 123 kB`` of a file of the system."""
    for line in _read(path).splitlines():
        if line.startswith(f"{name}:"):
            yield int(line.split()[1]) / 1024


def _read(path: str) -> str:
    try:
        return Path(path).read_text()
    except OSError:
        return ""
