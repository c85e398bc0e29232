"""``mjhab spawns``: compute and list sets of starts."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mjhab.cli.output import Listing, report
from mjhab.config.env_spec import PROFILE, EnvSpec, env_options
from mjhab.core.errors import UsageError, fault
from mjhab.core.machine import cores
from mjhab.core.progress import progress_bar
from mjhab.core.typed.bounds import Output, Positive
from mjhab.core.typed.flags import Flag
from mjhab.core.typed.options import take_options

if TYPE_CHECKING:
    from mjhab.evaluation.datasets.specs import ChainStartsSpec


@dataclass(frozen=True, kw_only=True)
class SpawnsMakeSpec(EnvSpec):
    """Compute start states of a subtask once, for use in many runs without settling or search.

    `mjhab spawns make --task set_table --subtask pick --count 1000 --out spawns/pick.npz`

    Use them with `EnvConfig(..., spawns="spawns/pick.npz")`. Ctrl-C keeps finished starts; the same command continues.

    Raises:
        UsageError: an option is invalid.
    """

    out: Annotated[Path, Flag(metavar="FILE.npz"), Output()]
    """The file to write."""
    count: Positive = 1000
    """Number of starts: those of the episodes 0 to N-1."""
    pool: int = 0
    """Number of object arrangements that the starts share; 0 gives each its own, which takes most of the time."""
    harvested: bool = False
    """Place and navigate: also use grasps recorded on this machine, not only the computed ones."""
    overwrite: bool = False
    """Replace the file and the unfinished files of an interrupted run with other options."""
    env: Annotated[
        Mapping[str, Any],
        env_options(
            *PROFILE,
            "task",
            "subtask",
            "target",
            "split",
            "home",
            "seed",
            "assets",
            "threads",
        ),
    ] = field(default_factory=dict)
    """Which episodes: fields of `EnvConfig`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.asked


@dataclass(frozen=True)
class SpawnsListSpec:
    """List sets of starts with their task, number of starts, and layout.

    `mjhab spawns list spawns`
    """

    path: Annotated[Path, Flag(metavar="[FOLDER|FILE]", positional=True)] = Path()
    """A set of starts, or a folder of sets."""

    def __post_init__(self) -> None:
        take_options(self)


def make(spec: SpawnsMakeSpec, json: bool) -> int:
    """Write a set of starts."""
    from mjhab.episodes.spawn_factory import make_set
    from mjhab.episodes.spawn_sets import SpawnRecipe
    from mjhab.scenes.pack_source import pack_request

    asked = spec.asked
    recipe = SpawnRecipe(
        asked.task,
        asked.subtask,
        asked.target,
        asked.split,
        asked.seed,
        spec.count,
        pack_request(asked.assets).as_json(),
        asked.home,
        spec.pool,
        spec.harvested,
        asked.spawn_rule,
        asked.robot,
        asked.joint_dynamics,
    )
    begun = time.perf_counter()
    shown = 0
    with progress_bar(f"{asked.task} {asked.subtask or 'chain'}", spec.count) as advance:

        def tell(done: int, fallbacks: int) -> None:
            nonlocal shown
            # The maker tells totals, and the bar takes steps.
            for _ in range(done - shown):
                advance()
            shown = done

        made = make_set(
            recipe, spec.out, asked.threads or cores(), tell, spec.overwrite
        ).describe()
    seconds = round(time.perf_counter() - begun, 2)
    report(
        json,
        {**made, "seconds": seconds},
        f"{made['count']} starts in {made['homes']} homes in {spec.out}, {made['fallbacks']} of them fallbacks, "
        f"{seconds:.0f} s; layout {made['layout']}, digest {made['digest']}",
    )
    return 0


def make_from_chains(spec: ChainStartsSpec, json: bool) -> int:
    """Write a set of starts from recorded episodes."""
    from mjhab.evaluation.datasets.chain_starts import make_chain_starts

    made = make_chain_starts(spec).describe()
    report(
        json,
        made,
        f"{made['count']} starts in {made['homes']} homes in {spec.out}; layout {made['layout']}, digest "
        f"{made['digest']}",
    )
    return 0


def list_sets(spec: SpawnsListSpec, json: bool) -> int:
    """Print a table of the sets at a path."""
    from mjhab.episodes.spawn_sets import SPAWNS_SUFFIX, SpawnSet

    path = spec.path
    if not path.exists():
        raise fault(
            path,
            f"does not exist; `mjhab spawns make --out FILE{SPAWNS_SUFFIX}` makes a set.",
        )
    # Names with a dot are of writers that have not finished.
    files = sorted(path.glob(f"[!.]*{SPAWNS_SUFFIX}")) if path.is_dir() else [path]
    found = []
    damaged = []
    for file in files:
        try:
            found.append(SpawnSet.read(file).describe())
        except UsageError as error:
            # In a folder one damaged file must not hide the others.
            if not path.is_dir():
                raise
            damaged.append(str(error))
    columns = (
        "file",
        "robot",
        "task",
        "subtask",
        "target",
        "split",
        "spawn_rule",
        "joint_dynamics",
        "seed",
        "count",
        "homes",
        "fallbacks",
        "pack",
        "layout",
    )
    rows = [
        [
            Path(one["file"]).name
            if name == "file"
            else one[name] or ("all" if name == "target" else one[name])
            for name in columns
        ]
        for one in found
    ]
    table = Listing(f"{len(found)} sets of starts in {path}", columns, rows)
    report(json, {"sets": found, "unreadable": damaged}, table, *damaged)
    return 0
