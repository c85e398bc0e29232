"""How much memory worlds take, asked before they are made."""

from __future__ import annotations

from pathlib import Path

from mjhab.core.errors import UsageError

BASE_MB = 500
"""An environment of one layout before its worlds: libraries and compiled homes (`mjhab bench env` measures it)."""
WORLD_MB = 1.5
"""One world with 30 objects: MjData, its batch rows and scratch (`mjhab bench env` measures it)."""
_CGROUP = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)


def available_mb() -> float | None:
    """Memory [MB] this process may still take: free memory, less if a container allows less; None if unknown."""
    found = [
        int(line.split()[1]) / 1024 for line in _read("/proc/meminfo").splitlines() if line.startswith("MemAvailable:")
    ]
    for limit, used in _CGROUP:
        top, now = _read(limit).strip(), _read(used).strip()
        if top.isdigit() and now.isdigit():
            found.append((int(top) - int(now)) / 2**20)
    return min(found, default=None)


def estimate_mb(num_envs: int) -> float:
    """Estimated memory [MB] of an environment of ``num_envs`` worlds without cameras."""
    return BASE_MB + WORLD_MB * num_envs


def check_memory(num_envs: int) -> None:
    """Refuse a number of worlds that does not fit into memory.

    Raises:
        UsageError: says what is needed, what is free, and the largest number that fits.
    """
    free = available_mb()
    need = estimate_mb(num_envs)
    if free is not None and need > free:
        most = max(0, int((free - BASE_MB) / WORLD_MB))
        raise UsageError(
            f"{num_envs} worlds need about {need:,.0f} MB, but {free:,.0f} MB are free. "
            f"At most {most:,} fit: set num_envs={most}."
        )


def _read(path: str) -> str:
    try:
        return Path(path).read_text()
    except OSError:
        return ""
