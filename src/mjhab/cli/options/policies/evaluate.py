"""The options of ``mjhab eval`` and ``mjhab demo``."""

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
from mjhab.cli.options.policies.served import ServedOptions


@dataclass(frozen=True)
class EvalOptions(ServedOptions, MemoryOptions, PolicyProfileOptions):
    """Evaluate a policy in furnished homes; write records, a summary, films and a report.

    A whole task: `mjhab eval --task set_table --policy expert --episodes 20 --out runs/table`

    One subtask: `mjhab eval --subtask pick --target 024_bowl --episodes 50 --out runs/pick_bowl`

    A policy of your own: `mjhab eval --policy my_policy.py:MyPolicy --subtask pick --out runs/mine`

    A policy that runs elsewhere: `mjhab eval --policy ws://host:8000 --dialect openpi --subtask pick --out runs/vla`

    Ctrl-C and SIGTERM keep the finished episodes; the same command with `--resume` continues.
    """

    task: Name = "set_table"
    """What to do: set_table, tidy_house, prepare_groceries or one of a plugin."""
    subtask: MaybeName = None
    """One subtask from spawned starts, such as pick (`mjhab envs list` names all); the whole chain if absent."""
    target: MaybeName = None
    """With --subtask: the object or link to act on, e.g. 024_bowl or kitchen_counter/drawer3. All of them if absent."""
    policy: PolicyName = "expert"
    """The policy: expert (scripted, reads the simulator state), student (a trained one of the package, with --subtask
    and --target), random, zero (stands still), a CHECKPOINT.safetensors, POLICIES.json with one policy per
    subtask, ms_hab:CHECKPOINT.pt of MS-HAB (see docs/ms_hab.md), your own: FILE.py:CLASS (see docs/evaluation.md),
    or one that is served elsewhere: ws://host:port (see docs/serving.md)."""
    style: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE ...")] = ()
    """Style of the expert, e.g. speed=0.5..1.0 grasp=side release=drop noise=0.05; every episode draws its own value
    from a range or a list (a,b). Names: speed, grasp, release, drop_height, close, pull, open_further, waits,
    plan, look, noise, base_noise, noise_kind, hold, dither (see docs/data.md)."""
    instruction: Annotated[str | None, tyro.conf.arg(metavar="SENTENCE")] = None
    """With --subtask: tell the policy this sentence in place of the episodes' own, e.g. "shut the drawer". For a
    student that was trained with sentences (see docs/training.md) and for a served policy."""
    episodes: Number = 20
    """Number of episodes, with indices 0 to N-1. The same index is the same episode for every policy."""
    worlds: Number = 8
    """Number of parallel episodes. Changes the speed, never the results."""
    horizon: Number = 0
    """Control steps of 50 ms after which a subtask ends; 0 for those of the task."""
    seed: Number = 0
    """Seed of the run; seed and index determine an episode. The global generators of numpy, torch and Python begin from
    it, too, for policies that draw from them."""
    split: Name = "train"
    """Which homes: train, val or test."""
    assets: Assets = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    stage_mesh: StageMesh = None
    """With a ReplicaCAD folder: walls and floor for every home, in place of the stages its scenes name."""
    articulate: Joints = None
    """With a ReplicaCAD folder: what opens besides counter and fridge: kitchen_cupboards, cabinet, chest_of_drawers."""
    episodes_file: Annotated[str | None, tyro.conf.arg(metavar="FILE")] = None
    """Run the episodes of this file (HAB format, .json or .json.gz) instead of generated ones, in the file's homes."""
    navigate: Name = "teleport"
    """In a whole task: teleport puts the robot near every goal, as in the paper; drive leaves driving to the policy."""
    spawns: Annotated[str | None, tyro.conf.arg(metavar="FILE.npz")] = None
    """With --subtask: use the start states of this file (see: mjhab spawns make)."""
    home: MaybeName = None
    """Use only this home, or the homes that fit a pattern such as 'v3_sc0_*', in turn (see: mjhab homes list)."""
    obs: MaybeName = None
    """Observation mode: state, depth, rgb, rgbd, seg, pointcloud, or several joined by +. That of the policy, else
    state, if absent."""
    control: MaybeName = None
    """Control mode of the actions, e.g. pd_ee_delta_pose. That of the policy, else pd_joint_delta_pos, if absent."""
    camera_size: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Side of the camera images [px]. That of the policy, else 128, if absent."""
    threads: Number = 0
    """Threads of the physics; 0 takes all cores. Changes the speed, never the results."""
    films: Number = 4
    """Film the first N episodes; 0 for none."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Folder of the results; runs/<task>_<subtask>_<policy>_seed<seed> if absent."""
    resume: bool = False
    """Continue the run in --out: only episodes without a record are run."""
    overwrite: bool = False
    """Start the run in --out again; deletes the files of the earlier run and nothing else."""
    alone: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FOLDER ...")] = ()
    """Folders of --subtask runs, whose success rates give the upper bound of progressive completion."""
    json: bool = False
    """Print the summary as one line of JSON at the end."""


@dataclass(frozen=True)
class DemoOptions:
    """Run a demonstration: the expert sets the table in four furnished homes; films and report go to runs/demo.

    The same as `mjhab eval --task set_table --policy expert --episodes 4 --worlds 4 --seed 0 --films 4`. The first run
    compiles for about a minute; then it takes two minutes on two cores.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/demo")
    """Folder of the results; results of an earlier run are replaced."""
    json: bool = False
    """Print the summary as one line of JSON at the end, as eval does."""
