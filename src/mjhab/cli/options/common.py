"""The options of every command, as frozen dataclasses with defaults; tyro turns them into the command line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.bench.specs import EngineSpec
from mjhab.cli.options.policies.served import ServedOptions
from mjhab.config.profile_choice import ProfileChoice
from mjhab.config.profiles import DEFAULT_PROFILE

Sub = tyro.conf.subcommand
Number = Annotated[int, tyro.conf.arg(metavar="N")]
Name = Annotated[str, tyro.conf.arg(metavar="NAME")]
MaybeName = Annotated[str | None, tyro.conf.arg(metavar="NAME")]
PolicyName = Annotated[str, tyro.conf.arg(metavar="NAME|FILE.py:CLASS|ws://HOST:PORT")]
Numbers = Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...")]
Backend = Annotated[str, tyro.conf.arg(metavar="auto|cpu|warp")]
Device = Annotated[str, tyro.conf.arg(metavar="DEVICE")]
Assets = Annotated[str, tyro.conf.arg(metavar="builtin|FOLDER")]
StageMesh = Annotated[Path | None, tyro.conf.arg(metavar="FILE.glb")]
Joints = Annotated[str | None, tyro.conf.arg(metavar="NAME,NAME")]


@dataclass(frozen=True, kw_only=True)
class MemoryOptions:
    """The option of long-running commands; `cli.main.run` applies it."""

    cache_mb: Annotated[float | None, tyro.conf.arg(metavar="MB")] = None
    """Limit of the cache of homes, maps and episodes in memory [MB]; $MJHAB_CACHE_MB, else 512, if absent. Changes the
    speed, never the results."""


@dataclass(frozen=True, kw_only=True)
class ProfileOptions(ProfileChoice):
    """Options of all commands that build environments for policies."""

    profile: Annotated[str, tyro.conf.arg(metavar="mjhab|ms_hab")] = DEFAULT_PROFILE
    """Values of many options at once: ms_hab is the environment of the MS-HAB paper (see docs/environments.md)."""
    robot: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """The robot (see: mjhab robots list); fetch if absent."""
    starts: Annotated[str | None, tyro.conf.arg(metavar="front_box|published")] = None
    """Start positions of Pick and Place at a drawer or fridge, and start posture of the arm in Place (spawn_rule of an
    environment); the profile's if absent."""
    stillness: Annotated[str | None, tyro.conf.arg(metavar="absolute|published")] = None
    """Whether a joint that moves backwards counts as moving (absolute) or as still; the profile's if absent."""


@dataclass(frozen=True, kw_only=True)
class PolicyProfileOptions(ProfileOptions):
    """`ProfileOptions` of commands whose policy or data may have a profile of their own."""

    profile: Annotated[str, tyro.conf.arg(metavar="mjhab|ms_hab")] = ""
    """Values of many options at once: ms_hab is the environment of the MS-HAB paper (see docs/environments.md). If
    absent, the one that the checkpoint or the data were made with, else mjhab."""


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
    seed: Number = 0
    """Seed of the run; seed and index determine an episode."""
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
        Annotated[EpisodesMakeOptions, Sub("make")] | Annotated[EpisodesCheckOptions, Sub("check")]
    )


DataSet = Annotated[
    tyro.conf.Positional[str], tyro.conf.arg(metavar="replica_cad|ycb|hab_episodes")
]


@dataclass(frozen=True)
class AssetsListOptions:
    """List the public data sets that mjhab reads, their licences, and which are installed."""

    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class AssetsFetchOptions:
    """Download a public data set and install it; none is needed for the built-in homes.

    For instance: `mjhab assets fetch replica_cad --accept-licence`

    An interrupted download continues with the same command. HF_ENDPOINT names a mirror of the hub; http_proxy,
    https_proxy and no_proxy are honoured. Without a network: zip the folder that `mjhab assets where` names on another
    machine, and give the file to --offline.
    """

    name: DataSet
    """The data set."""
    offline: Annotated[Path | None, tyro.conf.arg(metavar="BUNDLE")] = None
    """Install from this zip or tar archive; nothing is downloaded."""
    accept_licence: bool = False
    """Accept the licence of the data set, which differs from that of mjhab, without being asked."""
    overwrite: bool = False
    """Replace an installed data set."""
    repo: MaybeName = None
    """Another repository of the hub with the same files."""
    revision: MaybeName = None
    """Another branch, tag or commit of the repository."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class AssetsVerifyOptions:
    """Compare the files of an installed data set with the hashes recorded when it was installed.

    A folder that was not installed by mjhab has no record: its hashes are recorded now and used from then on.
    """

    name: DataSet
    """The data set."""
    json: bool = False
    """Print one line of JSON instead of tables."""


@dataclass(frozen=True)
class AssetsWhereOptions:
    """Print the folder of a data set, or the folder of all data sets, which MJHAB_ASSETS sets."""

    name: Annotated[
        tyro.conf.Positional[str], tyro.conf.arg(metavar="replica_cad|ycb|hab_episodes")
    ] = ""
    """The data set; the folder of all of them if absent, which --assets takes."""
    json: bool = False
    """Print one line of JSON."""


@dataclass(frozen=True)
class AssetsCommand:
    """List, install, verify and locate public data sets."""

    command: (
        Annotated[AssetsListOptions, Sub("list")]
        | Annotated[AssetsFetchOptions, Sub("fetch")]
        | Annotated[AssetsVerifyOptions, Sub("verify")]
        | Annotated[AssetsWhereOptions, Sub("where")]
    )


@dataclass(frozen=True)
class BenchSimOptions(EngineSpec):
    """Measure control steps per second: the bare engine, and the whole environment without cameras."""

    worlds: Number = EngineSpec.worlds
    """Number of worlds that step in parallel."""
    threads: Number = EngineSpec.threads
    """Threads of the physics; 0 takes all cores."""
    task: Name = EngineSpec.task
    """Task that sets homes and objects: set_table, tidy_house, prepare_groceries or one of a plugin."""
    steps: Number = EngineSpec.steps
    """Control steps per block; blocks of engine and environment alternate."""
    rounds: Number = EngineSpec.rounds
    """Pairs of blocks; the results are medians over them."""
    seed: Number = EngineSpec.seed
    """Seed of the episodes."""
    robot: MaybeName = None
    """The robot (see: mjhab robots list); fetch if absent."""
    assets: Assets = EngineSpec.assets
    """Asset pack: builtin, or the folder of another pack."""
    stage_mesh: StageMesh = None
    """With a ReplicaCAD folder: walls and floor for every home, in place of the stages its scenes name."""
    articulate: Joints = None
    """With a ReplicaCAD folder: what opens besides counter and fridge: kitchen_cupboards, cabinet, chest_of_drawers."""
    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class BenchGraspOptions:
    """Shake objects in the gripper with base and arm motion and measure how far they slip.

    Objects that are too wide for the robot's gripper are left out.
    """

    seconds: float = 10.0
    """Time of motion for each object [s]."""
    robot: MaybeName = None
    """The robot (see: mjhab robots list); fetch if absent."""
    seed: Number = 0
    """Seed of the motion."""
    json: bool = False
    """Print one line of JSON instead of a table."""


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
