"""The options of ``mjhab bench sim``, ``bench scaling`` and ``bench grasp``."""

from __future__ import annotations

from dataclasses import dataclass

from mjhab.bench.specs import EngineSpec, ScalingSpec
from mjhab.cli.options.common import (
    Assets,
    Joints,
    MaybeName,
    Name,
    Number,
    Numbers,
    StageMesh,
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
    """The robot (see: mjhab robots list); the default one if absent."""
    assets: Assets = EngineSpec.assets
    """Asset pack: builtin, or the folder of another pack."""
    stage_mesh: StageMesh = None
    """With a ReplicaCAD folder: walls and floor for every home, in place of the stages its scenes name."""
    articulate: Joints = None
    """With a ReplicaCAD folder: what opens besides counter and fridge: kitchen_cupboards, cabinet, chest_of_drawers."""
    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class BenchScalingOptions(ScalingSpec):
    """Measure the engine and the environment with several numbers of worlds and threads.

    From the table follows how much of a step is serial, and what more cores would give. It takes minutes, on an idle
    machine.
    """

    worlds: Numbers = ScalingSpec.worlds
    """Numbers of worlds that step in parallel."""
    threads: Numbers = ScalingSpec.threads
    """Numbers of threads; 1, 2, 4, ... up to the number of cores if absent."""
    task: Name = ScalingSpec.task
    """Task that sets homes and objects: set_table, tidy_house, prepare_groceries or one of a plugin."""
    rounds: Number = ScalingSpec.rounds
    """Pairs of blocks; the results are medians over them."""
    seed: Number = ScalingSpec.seed
    """Seed of the episodes."""
    robot: MaybeName = None
    """The robot (see: mjhab robots list); the default one if absent."""
    assets: Assets = ScalingSpec.assets
    """Asset pack: builtin, or the folder of another pack."""
    stage_mesh: StageMesh = None
    """With a ReplicaCAD folder: walls and floor for every home, in place of the stages its scenes name."""
    articulate: Joints = None
    """With a ReplicaCAD folder: what opens besides counter and fridge: kitchen_cupboards, cabinet, chest_of_drawers."""
    json: bool = False
    """Print one line of JSON instead of tables."""


@dataclass(frozen=True)
class BenchGraspOptions:
    """Shake objects in the gripper with base and arm motion and measure how far they slip.

    Objects that are too wide for the robot's gripper are left out.
    """

    seconds: float = 10.0
    """Time of motion for each object [s]."""
    robot: MaybeName = None
    """The robot (see: mjhab robots list); the default one if absent."""
    seed: Number = 0
    """Seed of the motion."""
    json: bool = False
    """Print one line of JSON instead of a table."""
