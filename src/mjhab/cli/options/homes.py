"""The options of ``mjhab homes``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.cli.options.common import Assets, Joints, MaybeName, Name, StageMesh, Sub


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
    stage_mesh: StageMesh = None
    """With a ReplicaCAD folder: walls and floor for every home, in place of the stages its scenes name."""
    articulate: Joints = None
    """With a ReplicaCAD folder: what opens besides counter and fridge: kitchen_cupboards, cabinet, chest_of_drawers."""
    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class HomesCheckOptions:
    """Check that homes compile into one layout, that a robot reaches all places, and that doors and drawers open fully.

    For instance: `mjhab homes check --split val`

    Fails if a home cannot be used. Places out of reach are reported; tasks do not use them.
    """

    assets: Assets = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    stage_mesh: StageMesh = None
    """With a ReplicaCAD folder: walls and floor for every home, in place of the stages its scenes name."""
    articulate: Joints = None
    """With a ReplicaCAD folder: what opens besides counter and fridge: kitchen_cupboards, cabinet, chest_of_drawers."""
    split: MaybeName = None
    """Check only these homes: train, val or test. All if absent."""
    tasks: bool = False
    """Also tell for which tasks each home has room: makes an episode of each, which takes about a second."""
    json: bool = False
    """Print one line of JSON instead of tables."""


@dataclass(frozen=True)
class HomesRenderOptions:
    """Draw one home, or a sheet of all homes of a pack; needs no OpenGL.

    For instance: `mjhab homes render builtin_m0_00 --out home.png --view inside`

    All of them: `mjhab homes render --all --out homes.html`
    """

    name: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="HOME")] = ""
    """Name of the home (see: mjhab homes list)."""
    all: bool = False
    """Draw every home of the pack into one sheet; --width and --height are then those of one picture."""
    split: MaybeName = None
    """With --all: only these homes: train, val or test."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE.png")] = Path("home.png")
    """The PNG to write; with --all also an HTML page that needs no network."""
    view: Name = "top"
    """top (plan from above) or inside (from a corner of a room)."""
    width: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Width of the picture [pixels]; 1200, or 400 with --all."""
    height: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Height of the picture [pixels]; 900, or 300 with --all."""
    assets: Assets = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    stage_mesh: StageMesh = None
    """With a ReplicaCAD folder: walls and floor for every home, in place of the stages its scenes name."""
    articulate: Joints = None
    """With a ReplicaCAD folder: what opens besides counter and fridge: kitchen_cupboards, cabinet, chest_of_drawers."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class HomesCommand:
    """List, show, check or draw the homes of an asset pack."""

    command: (
        Annotated[HomesListOptions, Sub("list")]
        | Annotated[HomesShowOptions, Sub("show")]
        | Annotated[HomesCheckOptions, Sub("check")]
        | Annotated[HomesRenderOptions, Sub("render")]
    )
