"""``mjhab estimate``: memory that a number of worlds takes, and the number that would fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from mjhab.cli.output import Listing, report
from mjhab.config.env_spec import EnvSpec, env_options
from mjhab.core.errors import UsageError


@dataclass(frozen=True)
class EstimateSpec(EnvSpec):
    """Estimate the memory of worlds on either backend, and how many fit.

    `mjhab estimate --worlds 4096 --obs rgbd`

    Fails if they fit neither here nor on the GPU.
    """

    env: Annotated[
        Mapping[str, Any],
        env_options("num_envs", "obs_mode", "camera_size", num_envs=4096),
    ] = field(default_factory=dict)
    """The worlds, fields of `EnvConfig`."""


def run_estimate(spec: EstimateSpec, json: bool) -> int:
    """Print the estimate.

    Raises:
        UsageError: the worlds fit on no backend whose memory is known; the message says how many would.
    """
    from mjhab.envs.estimate import world_memory
    from mjhab.envs.observations.modes import image_size

    worlds = spec.asked.num_envs
    obs = spec.asked.obs_mode
    height, width = image_size(spec.asked.camera_size)
    # The estimate knows square pictures; one of the same number of pixels takes as much.
    found = world_memory(obs, round((height * width) ** 0.5))
    rows = [memory.row(worlds) for memory in found]
    table = Listing(
        f"{worlds:,} worlds, {obs}, {height} x {width} px (estimates)",
        list(rows[0]),
        [["unknown" if x is None else x for x in row.values()] for row in rows],
    )
    report(json, {"num_envs": worlds, "obs": obs, "backends": rows}, table)
    known = [memory for memory in found if memory.most is not None]
    # An error after the table, so that scripts notice and people see the numbers.
    if known and not any(memory.most >= worlds for memory in known):  # type: ignore[operator]
        needs = "; ".join(
            f"backend {memory.backend} needs {memory.need.total_mb(worlds):,.0f} MB, "
            f"{memory.free_mb:,.0f} MB are "
            f"free on {memory.place}: at most --worlds {memory.most}"
            for memory in known
        )
        raise UsageError(f"{worlds} worlds do not fit: {needs}.")
    return 0
