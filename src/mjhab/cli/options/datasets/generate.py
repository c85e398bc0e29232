"""The options of ``mjhab generate`` and ``mjhab replay``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.cli.options.common import (
    Assets,
    Joints,
    MaybeName,
    MemoryOptions,
    Name,
    Number,
    PolicyName,
    PolicyProfileOptions,
    StageMesh,
)
from mjhab.cli.options.datasets.data import Places, Preset, Until, Where


@dataclass(frozen=True)
class GenerateOptions(MemoryOptions, PolicyProfileOptions):
    """Record episodes with several workers until every target has its quota; failures are kept by default.

    `mjhab generate --subtask pick --per-target 1000 --keep "label == 'straightforward_success'" --workers 2 --out
    runs/pick`

    Ctrl-C and SIGTERM keep the finished episodes; the same command with `--resume` continues. Of the episodes that pass
    the filter, those with the lowest indices are kept, whatever the number of workers.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """Folder of the shards."""
    task: Name = "set_table"
    """What to do: set_table, tidy_house, prepare_groceries or one of a plugin."""
    subtask: MaybeName = None
    """One subtask from spawned starts, such as pick (`mjhab envs list` names all); the whole chain if absent."""
    target: MaybeName = None
    """With --subtask: the object or link to act on, e.g. 024_bowl or kitchen_counter/drawer3. All of them if absent."""
    policy: PolicyName = "expert"
    """The policy: expert (scripted, reads the simulator state), student (a trained one of the package, with --subtask
    and --target), random, zero (stands still), a CHECKPOINT.safetensors, or your own: FILE.py:CLASS (see
    docs/evaluation.md)."""
    style: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE ...")] = ()
    """Style of the expert, e.g. speed=0.5..1.0 grasp=side release=drop noise=0.05; every episode draws its own value
    from a range or a list (a,b). Names: speed, grasp, release, drop_height, close, pull, open_further, waits,
    plan, look, noise, base_noise, noise_kind, hold, dither (see docs/data.md)."""
    per_target: Number = 0
    """Episodes to keep per target (in total for chains and Navigate); 0 for no limit."""
    per_label: Number = 0
    """Episodes to keep per target and label; 0 for no limit."""
    episodes: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Try at most the episodes 0 to N-1; needed without --per-target, else 20 times the number to keep."""
    keep: Where = None
    """Which episodes to keep, as in `mjhab data query`; all if absent."""
    preset: Preset = None
    """A filter with a name, see `mjhab data fields`; with --keep, both must hold."""
    images: Annotated[str, tyro.conf.arg(metavar="none|depth|rgb|rgbd|seg")] = "none"
    """Camera images to store; several joined by +. `mjhab replay --render` can also render them later."""
    cameras: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="NAME ...")] = None
    """Cameras of the robot; all if absent."""
    camera_size: Number = 128
    """Side of the images [px]."""
    rgb: Annotated[str, tyro.conf.arg(metavar="png|jpeg")] = "png"
    """Format of colour images; png is lossless."""
    no_states: bool = False
    """Leave out positions and velocities: files are smaller, but images cannot be rendered later."""
    horizon: Number = 0
    """Control steps of 50 ms after which a subtask ends; 0 for those of the task."""
    reward: Annotated[str, tyro.conf.arg(metavar="MODE")] = ""
    """Reward to store, e.g. dense with all its terms; that of an evaluation if absent."""
    workers: Number = 1
    """Number of processes. Changes the speed, never the results."""
    worlds: Number = 4
    """Parallel episodes per worker. Changes the speed, never the results."""
    threads: Number = 0
    """Threads of the physics of each worker; 0 divides the cores among them."""
    ray: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None
    """Run the workers as actors of this Ray cluster ("local" starts one here); all nodes must see the folder --out."""
    seed: Number = 0
    """Seed of the run; seed and index determine an episode."""
    split: Name = "train"
    """Which homes: train, val or test."""
    home: MaybeName = None
    """Only this home, or those that fit a pattern (see: mjhab homes list)."""
    assets: Assets = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    stage_mesh: StageMesh = None
    """With a ReplicaCAD folder: walls and floor for every home, in place of the stages its scenes name."""
    articulate: Joints = None
    """With a ReplicaCAD folder: what opens besides counter and fridge: kitchen_cupboards, cabinet, chest_of_drawers."""
    navigate: Annotated[str | None, tyro.conf.arg(metavar="drive|teleport")] = None
    """In a whole task: drive leaves driving to the policy (the default); teleport puts the robot near every goal, as in
    the paper's evaluation, and the recorded instructions say so."""
    until: Until = ""
    """In one subtask: success+N ends an episode N control steps after its first success, or after too much force."""
    resume: bool = False
    """Continue in --out; --workers, --episodes and the quotas may differ."""
    json: bool = False
    """Print one line of JSON at the end."""


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
