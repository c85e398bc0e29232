"""The options of ``mjhab doctor`` and ``mjhab examples``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.cli.options.common import Name, Number


@dataclass(frozen=True)
class ExamplesOptions:
    """Copy the examples of plugins and homes into a folder, and show how to try them.

    `mjhab examples`

    Files that are there already are kept; files with other content are refused.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("examples")
    """Folder to copy them into."""
    json: bool = False
    """Print one line of JSON."""


@dataclass(frozen=True)
class DoctorOptions:
    """Show installed libraries, working renderers, the number of cores, and the folders of caches.

    `mjhab doctor --estimate --num-envs 4096 --obs rgbd` estimates the memory of that many worlds on either backend.
    """

    estimate: bool = False
    """Estimate memory instead; fails if --num-envs worlds fit neither here nor on the GPU."""
    num_envs: Number = 4096
    """With --estimate: number of worlds."""
    obs: Name = "state"
    """With --estimate: observation mode, e.g. rgbd."""
    camera_size: Number = 128
    """With --estimate: side of the camera images [px]."""
    json: bool = False
    """Print one line of JSON instead of tables."""
