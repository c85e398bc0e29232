"""The options of ``mjhab episodes``."""

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
    StageMesh,
    Sub,
)


@dataclass(frozen=True)
class EpisodesMakeOptions:
    """Generate episodes and write them in the HAB format, with a manifest beside the file.

    `mjhab episodes make --task tidy_house --split val --count 100 --out episodes/tidy.json.gz`

    Every episode comes to rest in simulation before it is written, and depends on (task, split, seed, index) only.
    Ctrl-C keeps finished episodes; the same command continues.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FILE.json.gz")]
    """The file to write; gzip when it ends with .gz."""
    task: Name = "tidy_house"
    """Which task: set_table, tidy_house, prepare_groceries or one of a plugin."""
    split: Name = "train"
    """Which homes: train, val or test."""
    count: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Number of episodes; 10000 of train, 1000 of val and test if absent."""
    first: Number = 0
    """Index of the first episode; every episode can be made without the others."""
    seed: Number = 0
    """Seed of the episodes."""
    assets: Assets = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    stage_mesh: StageMesh = None
    """With a ReplicaCAD folder: walls and floor for every home, in place of the stages its scenes name."""
    articulate: Joints = None
    """With a ReplicaCAD folder: what opens besides counter and fridge: kitchen_cupboards, cabinet, chest_of_drawers."""
    workers: Number = 0
    """Number of processes; 0 takes all cores. Changes the speed, never the episodes."""
    overwrite: bool = False
    """Replace the file and the unfinished files of an interrupted run with other options."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class EpisodesCheckOptions:
    """Load a file of episodes, simulate each for 2 s and report objects that do not stay where the file puts them.

    `mjhab episodes check tidy_house.json.gz --assets data`
    """

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """The file: *.json or *.json.gz in the HAB format."""
    assets: Assets = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    stage_mesh: StageMesh = None
    """With a ReplicaCAD folder: walls and floor for every home, in place of the stages its scenes name."""
    articulate: Joints = None
    """With a ReplicaCAD folder: what opens besides counter and fridge: kitchen_cupboards, cabinet, chest_of_drawers."""
    task: MaybeName = None
    """Task of the episodes; found in the file, or in its name, if absent."""
    threads: Number = 0
    """Threads of the physics; 0 takes all cores."""
    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class EpisodesCommand:
    """Make or check files of episodes."""

    command: (
        Annotated[EpisodesMakeOptions, Sub("make")]
        | Annotated[EpisodesCheckOptions, Sub("check")]
    )
