"""``mjhab doctor --estimate``: memory that a number of worlds takes, and the number that would fit."""

from __future__ import annotations

from mjhab.cli.options.machine import DoctorOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.core.errors import UsageError
from mjhab.envs.estimate import world_memory


def run_estimate(options: DoctorOptions) -> int:
    """Print the estimate.

    Raises:
        UsageError: the worlds fit on no backend whose memory is known; the message says how many would.
    """
    at_least("num-envs", options.num_envs, 1)
    at_least("camera-size", options.camera_size, 8)
    found = world_memory(options.obs, options.camera_size)
    rows = [memory.row(options.num_envs) for memory in found]
    if options.json:
        print_json({"num_envs": options.num_envs, "obs": options.obs, "backends": rows})
    else:
        title = f"{options.num_envs:,} worlds, {options.obs}, {options.camera_size} px (estimates)"
        print_table(
            title,
            list(rows[0]),
            [["unknown" if x is None else x for x in row.values()] for row in rows],
        )
    known = [memory for memory in found if memory.most is not None]
    if known and not any(memory.most >= options.num_envs for memory in known):  # type: ignore[operator]
        told = "; ".join(
            f"backend {memory.backend} needs {memory.need.total_mb(options.num_envs):,.0f} MB, "
            f"{memory.free_mb:,.0f} MB are "
            f"free on {memory.place}: at most --num-envs {memory.most}"
            for memory in known
        )
        raise UsageError(f"{options.num_envs} worlds do not fit: {told}.")
    return 0
