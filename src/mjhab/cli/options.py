"""The options of every command, as frozen dataclasses with defaults; tyro turns them into the command line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

Sub = tyro.conf.subcommand
Number = Annotated[int, tyro.conf.arg(metavar="N")]
Name = Annotated[str, tyro.conf.arg(metavar="NAME")]
MaybeName = Annotated[str | None, tyro.conf.arg(metavar="NAME")]
Assets = Annotated[str, tyro.conf.arg(metavar="builtin|FOLDER")]


@dataclass(frozen=True)
class EvalOptions:
    """Run a policy in furnished homes; write records, numbers, films and a report.

    A whole task: `mjhab eval --task set_table --policy expert --episodes 20 --out runs/table`

    One subtask: `mjhab eval --subtask pick --target 024_bowl --episodes 50 --out runs/pick_bowl`

    Ctrl-C keeps the finished episodes; the same command with `--resume` continues.
    """

    task: Name = "set_table"
    """What to do: set_table, tidy_house or prepare_groceries."""
    subtask: MaybeName = None
    """Evaluate one subtask from spawned starts instead of the whole chain: pick, place, open or close."""
    target: MaybeName = None
    """With --subtask: the object or link to act on, e.g. 024_bowl or kitchen_counter/drawer3. All of them if absent."""
    policy: Name = "expert"
    """What acts: expert (scripted, knows the state), random or zero (stands still)."""
    episodes: Number = 20
    """How many episodes: those with index 0 to N-1. The same index is the same episode for every policy."""
    worlds: Number = 8
    """How many episodes run at the same time. Changes the speed, never the results."""
    seed: Number = 0
    """Seed of the run; with the index it fixes the episode."""
    split: Name = "train"
    """Which homes: train, val or test."""
    assets: Assets = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    home: MaybeName = None
    """Use only this home (see: mjhab homes list)."""
    threads: Number = 0
    """Threads of the physics; 0 takes all cores. Changes the speed, never the results."""
    films: Number = 4
    """Film the first N episodes; 0 for none."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Folder of the results; runs/<task>_<subtask>_<policy>_seed<seed> if absent."""
    resume: bool = False
    """Continue the run in --out: only episodes that have no record yet are run."""
    overwrite: bool = False
    """Start the run in --out again; deletes what an earlier run left there and nothing else."""
    alone: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FOLDER ...")] = ()
    """Folders of --subtask runs, whose success rates give the upper bound of progressive completion."""
    json: bool = False
    """Print the summary as one line of JSON at the end."""


@dataclass(frozen=True)
class HomesListOptions:
    """List the homes of an asset pack."""

    assets: Assets = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class HomesShowOptions:
    """Show what is in one home."""

    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="HOME")]
    """Name of the home (see: mjhab homes list)."""
    assets: Assets = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class HomesRenderOptions:
    """Draw one home into a PNG; needs no OpenGL.

    For instance: `mjhab homes render builtin_m0_00 --out home.png --view inside`
    """

    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="HOME")]
    """Name of the home (see: mjhab homes list)."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE.png")] = Path("home.png")
    """The PNG to write."""
    view: Name = "top"
    """top (plan from above) or inside (from a corner of a room)."""
    width: Number = 1200
    """Width of the picture [pixels]."""
    height: Number = 900
    """Height of the picture [pixels]."""
    assets: Assets = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class HomesCommand:
    """List, show or draw the homes of an asset pack."""

    command: (
        Annotated[HomesListOptions, Sub("list")]
        | Annotated[HomesShowOptions, Sub("show")]
        | Annotated[HomesRenderOptions, Sub("render")]
    )


@dataclass(frozen=True)
class BenchSimOptions:
    """Measure control steps per second: the bare engine, and the whole environment without cameras."""

    worlds: Number = 16
    """How many worlds step at the same time."""
    threads: Number = 0
    """Threads of the physics; 0 takes all cores."""
    task: Name = "tidy_house"
    """Whose homes and objects: set_table, tidy_house or prepare_groceries."""
    steps: Number = 40
    """Control steps per block; blocks of engine and environment alternate."""
    rounds: Number = 9
    """Pairs of blocks; the medians count."""
    seed: Number = 0
    """Seed of the episodes."""
    assets: Assets = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class BenchGraspOptions:
    """Shake objects in the gripper with base and arm motion and measure how far they slip."""

    seconds: float = 10.0
    """Time of motion for each object [s]."""
    seed: Number = 0
    """Seed of the motion."""
    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class BenchCommand:
    """Measure this machine and the physics."""

    command: Annotated[BenchSimOptions, Sub("sim")] | Annotated[BenchGraspOptions, Sub("grasp")]


@dataclass(frozen=True)
class DoctorOptions:
    """Tell what is installed, which renderers work, how many cores there are and where caches live."""

    json: bool = False
    """Print one line of JSON instead of tables."""


Command = (
    Annotated[EvalOptions, Sub("eval")]
    | Annotated[HomesCommand, Sub("homes")]
    | Annotated[BenchCommand, Sub("bench")]
    | Annotated[DoctorOptions, Sub("doctor")]
)
