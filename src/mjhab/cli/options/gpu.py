"""The options of ``mjhab bench interact``, ``mjhab bench parity`` and ``mjhab warmup``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.bench.specs import InteractSpec, ParitySpec
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
    """How often each is measured. Nothing in the benchmark is random: seeds 1 to K are repetitions."""
    no_render: bool = InteractSpec.no_render
    """Physics only, without 2 x 128 x 128 RGB and depth."""
    steps: Number = InteractSpec.steps
    """Control steps of a run: the first of the 200 that are recorded."""
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
    """Folder of the results; what an earlier run left there is replaced."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class BenchParityOptions(ParitySpec):
    """How far both simulators drift apart from the same starts under the same actions, and whether they agree.

    Divergence: actions of the expert on the cpu backend, applied to both, whatever they lead to. Agreement: with
    --episodes, whole episodes of the expert, under the same actions on both and with the expert acting on each by
    itself, whose outcomes, labels and rewards are compared one by one.

    `mjhab bench parity --worlds 8 --task all --subtask all --episodes 200 --log parity.jsonl`
    """

    worlds: Number = ParitySpec.worlds
    """Starts whose divergence is measured: episodes 0 to N-1 of every subtask; also the worlds stepped together."""
    steps: Number = ParitySpec.steps
    """Control steps; divergence is printed after 1, 10, 100 and 200 of them."""
    episodes: Number = ParitySpec.episodes
    """Expert episodes for the agreement, spread over the subtasks; 0 judges the --worlds runs alone."""
    task: Name = ParitySpec.task
    """Task whose episodes are used, or all."""
    subtask: Name = ParitySpec.subtask
    """Subtask, or all that the task has."""
    log: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = ParitySpec.log
    """Finished episodes are kept in this file (JSON lines), and the same command goes on where it was stopped."""
    grasp_seconds: Annotated[float, tyro.conf.arg(metavar="S")] = ParitySpec.grasp_seconds
    """How long held objects are shaken on both; 0 leaves the test out."""
    device: Device = ParitySpec.device
    """Of the warp backend: cuda:0, ... or cpu (slow, for tests); the first CUDA device if absent, else cpu."""
    threads: Number = ParitySpec.threads
    """Threads of the cpu backend; 0 takes all cores."""
    seed: Number = ParitySpec.seed
    """Seed of the episodes."""
    json: bool = False
    """Print one line of JSON instead of tables."""


@dataclass(frozen=True)
class WarmupOptions(ProfileOptions):
    """Compile what is compiled at first use, and keep it: kernels of the rasterizer and of the experts' planning, and
    those of MuJoCo Warp.

    With `--profile ms_hab` the arms that hold objects are made, too, in which Place then begins.

    Minutes the first time, seconds later. Compiled kernels of Warp lie in $WARP_CACHE_PATH, else ~/.cache/warp.
    """

    backend: Backend = "auto"
    """cpu: rasterizer and planning; warp: also MuJoCo Warp; auto: warp where there is a CUDA device."""
    task: Name = "tidy_house"
    """Whose objects the layout has: buffers of the warp backend are measured for it, too."""
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
