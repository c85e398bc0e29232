"""The options of ``mjhab spawns``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.cli.options.common import (
    Assets,
    Joints,
    MaybeName,
    Name,
    Number,
    ProfileOptions,
    StageMesh,
    Sub,
)


@dataclass(frozen=True)
class SpawnsMakeOptions(ProfileOptions):
    """Compute start states of a subtask once, for use in many runs without settling or search.

    `mjhab spawns make --task set_table --subtask pick --count 1000 --out spawns/pick.npz`

    Use them with `EnvConfig(..., spawns="spawns/pick.npz")`. Ctrl-C keeps finished starts; the same command continues.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FILE.npz")]
    """The file to write."""
    task: Name = "set_table"
    """Which task: set_table, tidy_house, prepare_groceries or one of a plugin."""
    subtask: MaybeName = None
    """Which subtask: pick, place, navigate, open, close or one of a plugin. Starts of the whole chain if absent."""
    target: MaybeName = None
    """The object or link to act on, e.g. 024_bowl or kitchen_counter/drawer3. All of them if absent."""
    split: Name = "train"
    """Which homes: train, val or test."""
    home: MaybeName = None
    """Use only this home, or the homes that fit a pattern, in turn (see: mjhab homes list)."""
    count: Number = 1000
    """Number of starts: those of the episodes 0 to N-1."""
    pool: Number = 0
    """Number of object arrangements that the starts share; 0 gives each its own, which takes most of the time."""
    seed: Number = 0
    """Seed of the episodes."""
    harvested: bool = False
    """Place and navigate: also use grasps recorded on this machine, not only the computed ones."""
    assets: Assets = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    stage_mesh: StageMesh = None
    """With a ReplicaCAD folder: walls and floor for every home, in place of the stages its scenes name."""
    articulate: Joints = None
    """With a ReplicaCAD folder: what opens besides counter and fridge: kitchen_cupboards, cabinet, chest_of_drawers."""
    threads: Number = 0
    """Threads; 0 takes all cores. Changes the speed, never the starts."""
    overwrite: bool = False
    """Replace the file and the unfinished files of an interrupted run with other options."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class SpawnsListOptions:
    """List sets of starts with their task, number of starts, and layout.

    `mjhab spawns list spawns`
    """

    path: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FOLDER|FILE")] = (
        Path()
    )
    """A set of starts, or a folder of sets."""
    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class SpawnsCommand:
    """Make or list sets of starts."""

    command: (
        Annotated[SpawnsMakeOptions, Sub("make")]
        | Annotated[SpawnsListOptions, Sub("list")]
    )
