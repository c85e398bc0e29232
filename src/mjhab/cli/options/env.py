"""The options of ``mjhab envs`` and ``mjhab bench env``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from mjhab.bench.specs import EnvBenchSpec
from mjhab.cli.options.common import (
    Assets,
    Backend,
    Device,
    Joints,
    MaybeName,
    Name,
    Number,
    Numbers,
    ProfileOptions,
    StageMesh,
    Sub,
)


@dataclass(frozen=True)
class RobotsListOptions:
    """List the robots: number of joints, widths of an action (default control mode) and of `state`, and availability.

    A robot is available if the files that it is made of are installed.
    """

    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class RobotsShowOptions:
    """Show the joints of a robot with their groups and limits, and its cameras.

    For instance: `mjhab robots show fetch`
    """

    robot: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="NAME")]
    """Name of the robot (see: mjhab robots list)."""
    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class RobotsCommand:
    """List and describe robots."""

    command: (
        Annotated[RobotsListOptions, Sub("list")]
        | Annotated[RobotsShowOptions, Sub("show")]
    )


EnvId = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ID")]


@dataclass(frozen=True)
class EnvsListOptions:
    """List the environment ids of `gymnasium.make` and `gymnasium.make_vec` after `import mjhab`."""

    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class EnvsDescribeOptions(ProfileOptions):
    """Show the observations, the action table and the reward terms of an environment.

    For instance: `mjhab envs describe mjhab/PickSubtaskTrain-v1 --obs rgbd`
    """

    env: EnvId
    """The environment, e.g. mjhab/PickSubtaskTrain-v1 (see: mjhab envs list)."""
    obs: Name = "state"
    """Observation mode: state, depth, rgb, rgbd, seg, pointcloud, or several joined by +."""
    control: Name = "pd_joint_delta_pos"
    """Control mode, e.g. pd_ee_delta_pose."""
    json: bool = False
    """Print one line of JSON instead of tables."""


@dataclass(frozen=True)
class EnvsCommand:
    """List environments and describe their observations, actions and rewards."""

    command: (
        Annotated[EnvsListOptions, Sub("list")]
        | Annotated[EnvsDescribeOptions, Sub("describe")]
    )


@dataclass(frozen=True)
class BenchEnvOptions(ProfileOptions, EnvBenchSpec):
    """Measure an environment: steps per second compared with the bare engine, time per stage, memory, cold start."""

    env: Name = EnvBenchSpec.env
    """The environment id (see: mjhab envs list)."""
    obs: Name = EnvBenchSpec.obs
    """Observation mode: state, depth, rgb, rgbd, seg, pointcloud, or several joined by +."""
    worlds: Numbers = EnvBenchSpec.worlds
    """Numbers of parallel worlds, measured one after the other."""
    backend: Backend = EnvBenchSpec.backend
    """cpu: C MuJoCo and the CPU rasterizer; warp: environments on a GPU; auto: warp where there is a CUDA device."""
    device: Device = EnvBenchSpec.device
    """Device of the warp backend: cuda:0, ... or cpu (slow, for tests); the first CUDA device if absent."""
    threads: Number = EnvBenchSpec.threads
    """Threads of physics and rendering in the cpu backend; 0 takes all cores."""
    camera_size: Number = EnvBenchSpec.camera_size
    """Side of the camera images [px]."""
    reward: MaybeName = EnvBenchSpec.reward
    """Reward mode, e.g. dense; that of the environment if absent."""
    task: MaybeName = EnvBenchSpec.task
    """Task; that of the environment if absent."""
    steps: Number = EnvBenchSpec.steps
    """Control steps per block; blocks of engine and environment alternate."""
    rounds: Number = EnvBenchSpec.rounds
    """Pairs of blocks; the results are medians over them."""
    seed: Number = EnvBenchSpec.seed
    """Seed of the episodes and of the motion."""
    assets: Assets = EnvBenchSpec.assets
    """Asset pack: builtin, or the folder of another pack."""
    stage_mesh: StageMesh = None
    """With a ReplicaCAD folder: walls and floor for every home, in place of the stages its scenes name."""
    articulate: Joints = None
    """With a ReplicaCAD folder: what opens besides counter and fridge: kitchen_cupboards, cabinet, chest_of_drawers."""
    json: bool = False
    """Print one line of JSON instead of tables."""
