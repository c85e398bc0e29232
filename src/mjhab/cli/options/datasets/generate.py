"""The options of ``mjhab generate`` and ``mjhab replay``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.cli.options.common import (
    Number,
)
from mjhab.cli.options.datasets.data import Places, Preset, Where


@dataclass(frozen=True)
class ReplayOptions:
    """Simulate recorded actions again and compare every bit (--verify), or render recorded states (--render).

    `mjhab replay runs/pick --verify`

    `mjhab replay runs/pick --render rgbd --camera-size 256 --out pick_rgbd.h5`
    """

    places: Places
    """Shards (*.h5) or folders of shards."""
    verify: bool = False
    """Simulate the actions on the CPU and compare positions and velocities of every step; fails unless all agree."""
    render: Annotated[
        str | None, tyro.conf.arg(metavar="depth|rgb|rgbd|seg|pointcloud")
    ] = None
    """Render these images of every state into a new shard, without simulation; several joined by +."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE.h5")] = None
    """With --render: the shard to make or to continue."""
    cameras: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="NAME ...")] = None
    """With --render: cameras of the robot (all if absent), and follow, a camera behind the robot (colour only)."""
    camera_size: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N|HEIGHT WIDTH")] = (
        128,
    )
    """With --render: side of the images, or height and width [px]."""
    rgb: Annotated[str, tyro.conf.arg(metavar="png|jpeg")] = "png"
    """With --render: format of colour images; png is lossless."""
    where: Where = None
    """Only these episodes, as in `mjhab data query`."""
    preset: Preset = None
    """A filter with a name, see `mjhab data fields`."""
    worlds: Number = 8
    """Number of episodes simulated, or frames rendered, in parallel. Changes the speed, never the results."""
    threads: Number = 0
    """Threads; 0 takes all cores."""
    json: bool = False
    """Print one line of JSON at the end."""
