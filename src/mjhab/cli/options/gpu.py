"""The options of ``mjhab bench interact`` and ``mjhab warmup``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.bench.specs import InteractSpec
from mjhab.cli.options.common import (
    Assets,
    Backend,
    Device,
    Joints,
    Name,
    Number,
    Numbers,
    ProfileOptions,
    StageMesh,
)

Folder = Annotated[Path, tyro.conf.arg(metavar="FOLDER")]


@dataclass(frozen=True)
class BenchInteractOptions(InteractSpec):
    """The paper's Interact benchmark: 200 control steps sweep the arm through five objects, two cameras each step.

    `mjhab bench interact --backend warp --worlds 64 256 1024 4096 --no-render`

    Writes interact.json, interact.csv and report.html with the plot of speed over memory.
    """

    backend: Backend = InteractSpec.backend
    """cpu: C MuJoCo and the CPU rasterizer; warp: MuJoCo Warp; auto: warp where there is a CUDA device."""
    worlds: Numbers = InteractSpec.worlds
    """Numbers of worlds, measured one after the other."""
    seeds: Number = InteractSpec.seeds
    """Number of repetitions, named seeds as in the paper; nothing in the benchmark is random."""
    no_render: bool = InteractSpec.no_render
    """Physics only, without 2 x 128 x 128 RGB and depth."""
    steps: Number = InteractSpec.steps
    """Control steps of a run: the first N of the 200 recorded ones."""
    device: Device = InteractSpec.device
    """Of the warp backend: cuda:0, ... or cpu (slow, for tests); the first CUDA device if absent."""
    threads: Number = InteractSpec.threads
    """Threads of the cpu backend; 0 takes all cores."""
    assets: Assets = InteractSpec.assets
    """Asset pack: builtin, or the folder of another pack."""
    stage_mesh: StageMesh = None
    """With a ReplicaCAD folder: walls and floor for every home, in place of the stages its scenes name."""
    articulate: Joints = None
    """With a ReplicaCAD folder: what opens besides counter and fridge: kitchen_cupboards, cabinet, chest_of_drawers."""
    out: Folder = InteractSpec.out
    """Folder of the results; results of an earlier run are replaced."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class WarmupOptions(ProfileOptions):
    """Compile and cache everything that is compiled at first use: homes, kernels of the rasterizer and of the experts'
    planning, and those of MuJoCo Warp.

    With `--profile ms_hab` it also computes the arm postures with a held object in which Place starts.

    It takes minutes the first time and seconds later. Kernels of Warp are cached in $WARP_CACHE_PATH, else
    ~/.cache/warp.
    """

    backend: Backend = "auto"
    """cpu: rasterizer and planning; warp: also MuJoCo Warp; auto: warp where there is a CUDA device."""
    task: Name = "tidy_house"
    """Task that sets the objects in the layout; the buffer sizes of the warp backend are also measured for it."""
    device: Device = ""
    """Of the warp backend: cuda:0, ... or cpu (slow, for tests); the first CUDA device if absent."""
    assets: Assets = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    stage_mesh: StageMesh = None
    """With a ReplicaCAD folder: walls and floor for every home, in place of the stages its scenes name."""
    articulate: Joints = None
    """With a ReplicaCAD folder: what opens besides counter and fridge: kitchen_cupboards, cabinet, chest_of_drawers."""
    json: bool = False
    """Print one line of JSON at the end."""
