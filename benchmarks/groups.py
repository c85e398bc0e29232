"""Resets of groups of equal starts per second: ``python -m benchmarks.groups``."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.command import run_command
from mjhab.cli.output import listing_of, report
from mjhab.integrations.rlinf import RLinfEnv

STARTS = 24
"""Starts that groups are drawn from: few, so that every one has been compiled before it is counted."""


@dataclass(frozen=True)
class GroupSpec:
    """Measure resets of `mjhab.integrations.rlinf.RLinfEnv`: K worlds of each of N starts begin in every reset.

    `python -m benchmarks.groups --group 1 4 8 --worlds 8 --obs rgb`

    Times are CPU times of one thread.
    """

    group: tuple[int, ...] = (1, 4, 8)
    """K, the worlds of a group."""
    worlds: int = 8
    """K x N, the number of worlds."""
    subtask: str = "close"
    """The subtask."""
    obs: str = "rgb"
    """Observation mode."""
    size: int = 128
    """Side of the images [px]."""
    resets: int = 10
    """Resets of all worlds, each with new starts."""
    json: bool = False
    """Print one line of JSON instead of a table."""


def measure(spec: GroupSpec) -> list[dict[str, Any]]:
    """One row per size of group: starts of worlds, and of groups, per CPU second."""
    rows = []
    # The first turn compiles homes and settles their objects, and is not counted: all homes of the split come up in it.
    for group in (1, *spec.group):
        options = {
            "subtask": spec.subtask,
            "obs_mode": spec.obs,
            "camera_size": spec.size,
            "threads": 1,
        }
        cfg = {"group_size": group, "num_starts": STARTS, "init_params": options}
        env = RLinfEnv(cfg, spec.worlds)
        env.reset()
        begun = time.process_time()
        for _ in range(spec.resets):
            env.update_reset_state_ids()
            env.reset()
        cpu = time.process_time() - begun
        env.close()
        starts = spec.resets * spec.worlds / cpu
        rows.append(
            {
                "group": group,
                "groups": spec.worlds // group,
                "worlds_per_s": round(starts, 1),
                "groups_per_s": round(starts / group, 1),
            }
        )
    return rows[1:]


def _work(spec: GroupSpec) -> int:
    rows = measure(spec)
    report(spec.json, {"rows": rows}, listing_of("Resets of groups", rows))
    return 0


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    least = {"group": 1, "worlds": 1, "size": 1, "resets": 1}
    return run_command("groups", GroupSpec, _work, words, minima=least)


if __name__ == "__main__":
    sys.exit(main())
