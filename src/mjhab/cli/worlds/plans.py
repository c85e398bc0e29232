"""``mjhab episodes plans``: task plans, episodes and spawn data in MS-HAB's layout."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from mjhab.cli.output import report
from mjhab.config.env_spec import EnvSpec, env_options
from mjhab.core.errors import fault
from mjhab.core.machine import cores
from mjhab.core.progress import progress_bar
from mjhab.core.typed.bounds import Output, Positive
from mjhab.core.typed.flags import Flag


@dataclass(frozen=True, kw_only=True)
class EpisodesPlansSpec(EnvSpec):
    """Write task plans, the episodes that they name, and spawn data in MS-HAB's layout, for its scripts.

    `mjhab episodes plans --task set_table --split val --out rearrange`

    The folder takes the place of the original's `scene_datasets/replica_cad_dataset/rearrange`. Plans and starts depend
    on (task, split, seed, index, assets) only, and are those of the environments of the profile.

    Raises:
        UsageError: an option is invalid.
    """

    out: Annotated[Path, Flag(metavar="DIR"), Output()]
    """The folder to write to; plans of other tasks, subtasks and splits in it stay."""
    count: Positive = 100
    """Number of episodes; the original has 10,000 of train and 1,000 of val."""
    subtasks: tuple[str, ...] = ()
    """Kinds of subtasks to write plans of, or sequential for whole tasks; by default all of the task."""
    overwrite: bool = False
    """Replace plans of the same task, subtask and split."""
    env: Annotated[
        Mapping[str, Any],
        env_options(
            "profile",
            "task",
            "split",
            "home",
            "seed",
            "assets",
            "episodes_file",
            "threads",
            profile="ms_hab",
            split="val",
        ),
    ] = field(default_factory=dict)
    """Which episodes: fields of `EnvConfig`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.asked


def make(spec: EpisodesPlansSpec, json: bool) -> int:
    """Write plans, episodes and spawn data."""
    from mjhab.compat.mshab.files.making import make_plans, written_before

    asked = spec.asked
    before = written_before(asked, spec.out, spec.subtasks)
    if before and not spec.overwrite:
        raise fault(before[0], "exists; add --overwrite, or choose another --out.")
    begun = time.perf_counter()
    with progress_bar(f"{asked.task} {asked.split}", spec.count) as advance:
        made = make_plans(
            asked,
            spec.out,
            spec.count,
            spec.subtasks,
            asked.threads or cores(),
            advance,
        )
    seconds = round(time.perf_counter() - begun, 2)
    left = (
        f", {made.left_out} plans left out, for which there is no spawn"
        if made.left_out
        else ""
    )
    report(
        json,
        {
            "plans": made.plans,
            "files": [str(path) for path in made.files],
            "episodes": made.episodes,
            "left_out": made.left_out,
            "seconds": seconds,
        },
        f"{made.plans} plans of {made.episodes} episodes in {len(made.files)} files below {spec.out}{left}, "
        f"{seconds:.0f} s",
    )
    return 0
