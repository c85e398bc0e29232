"""The options of ``mjhab train``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.bench.specs import CurvesSpec, LearnerSpec
from mjhab.cli.options.common import (
    Assets,
    Joints,
    MaybeName,
    Name,
    Number,
    Numbers,
    PolicyProfileOptions,
    StageMesh,
    Sub,
)
from mjhab.cli.options.datasets.data import Where
from mjhab.learning.runs.defaults import FILMED_EPISODES

DataPlaces = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="PATH ...")]
Minutes = Annotated[float, tyro.conf.arg(metavar="MINUTES")]
MaybeNumber = Annotated[int | None, tyro.conf.arg(metavar="N")]


@dataclass(frozen=True)
class RunOptions(PolicyProfileOptions):
    """Options of all algorithms of ``mjhab train``."""

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """Folder of the run: checkpoints, collected data, curves, report."""
    preset: Name = ""
    """Named configuration of network and training; the algorithm's first one if absent."""
    task: Name = "set_table"
    """The task: set_table, tidy_house, prepare_groceries or one of a plugin."""
    subtask: Name = "close"
    """The subtask to learn: pick, place, navigate, open, close or one of a plugin."""
    target: MaybeName = None
    """The object or link to act on, e.g. 024_bowl or kitchen_counter/drawer3; one policy for all of them if absent."""
    budget_minutes: Minutes = 0.0
    """Time limit of the whole run, including the final evaluation [min]; 0 for no limit."""
    eval_episodes: Number = 100
    """Episodes of the final evaluation; 0 for none."""
    round_episodes: Number = 32
    """Episodes of the evaluations during training; 0 for none."""
    films: Number = FILMED_EPISODES
    """Number of episodes to film in the first and in the last evaluation, for the report of the run; 0 for none."""
    seed: Number = 0
    """Seed of everything: weights, batches, episodes."""
    split: Name = "train"
    """Which homes: train, val or test."""
    eval_split: MaybeName = None
    """Homes of the final evaluation: val if absent, with --home those of --split, in which those on the way are."""
    home: MaybeName = None
    """Only this home, or those that fit a pattern (see: mjhab homes list)."""
    assets: Assets = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    stage_mesh: StageMesh = None
    """With a ReplicaCAD folder: walls and floor for every home, in place of the stages its scenes name."""
    articulate: Joints = None
    """With a ReplicaCAD folder: what opens besides counter and fridge: kitchen_cupboards, cabinet, chest_of_drawers."""
    threads: Number = 0
    """Threads of physics and network; 0 takes all cores. The last bits of the weights depend on it."""
    resume: bool = False
    """Continue the run in --out from its last checkpoint."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class TrainOptions(RunOptions):
    """Options of all imitation learning algorithms."""

    data: DataPlaces = ()
    """Learn from these demonstrations: shards or folders of them, with images of the preset's size. If absent, the
    expert generates demonstrations first."""
    where: Where = None
    """With --data: which episodes, as in `mjhab data query`; the successful ones if absent."""
    per_target: Number = 0
    """With --data: only so many demonstrations of every target, those with the lowest indices; 0 for all."""
    demos: MaybeNumber = None
    """Without --data: number of episodes that the expert tries; that of the preset if absent."""
    style: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE ...")] = ()
    """Style of the demonstrating expert, as in `mjhab generate`; with noise=0..0.2 it executes noisy actions, and the
    student learns the intended ones."""
    updates: MaybeNumber = None
    """Updates of the network (in dagger: of the first round); those of the preset if absent."""
    also: Annotated[
        tuple[str, ...], tyro.conf.arg(metavar="TASK/SUBTASK[/TARGET] ...")
    ] = ()
    """Further subtasks that the same student learns, for instance tidy_house/pick set_table/open/fridge/top_door.
    Numbers of episodes are for each of them."""
    set: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE ...")] = ()
    """Change fields of the preset, e.g. chunk=4 inputs.image_size=64 optimizer.ema=0; a wrong name lists all."""
    device: Name = "cpu"
    """Device that the network is trained on: cpu, auto, cuda:0, ...; episodes are simulated on the CPU. With auto it
    is the first GPU, if there is one. Only on the CPU do equal runs end with equal bits."""
    worlds: Number = 16
    """Parallel episodes per process. Changes the speed, never the collected data."""
    workers: Number = 1
    """Processes that collect, or read --data; 1 uses this process. Changes the speed, never the data."""
    ray: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None
    """Collect with actors of this Ray cluster ("local" starts one here); all nodes must see the folder --out."""


@dataclass(frozen=True)
class ReinforcementOptions(RunOptions):
    """Options of all reinforcement learning algorithms."""

    samples: MaybeNumber = None
    """Total number of samples (control steps of single worlds); that of the preset if absent. With PPO's preset fast
    0 stops after imitation."""
    worlds: MaybeNumber = None
    """Number of parallel worlds; it changes the result. That of the preset if absent."""
    start: Annotated[Path | None, tyro.conf.arg(metavar="CHECKPOINT")] = None
    """Start the actor from this checkpoint of `mjhab train`, e.g. a student to fine-tune."""
    privileged_critic: bool | None = None
    """Whether the critic receives simulator state such as forces, velocities and remaining time; the policy never
    does."""
    set: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE ...")] = ()
    """Change fields of the preset, e.g. ppo.demonstrations=800 network.hidden=512; a wrong name lists all."""
    backend: Name = "cpu"
    """Simulation backend: cpu, warp (on a GPU), or auto."""
    device: Name = ""
    """With backend warp: cuda:0, cuda:1, ...; the first one if absent."""


@dataclass(frozen=True)
class TrainPpoOptions(ReinforcementOptions):
    """Proximal policy optimization. Presets: fast (states), scratch (states, from random weights),
    depth, polish (of a student), paper, paper_state (the same from states).

    `mjhab train ppo --task set_table --subtask close --target kitchen_counter/drawer3 --preset fast
    --budget-minutes 20 --out runs/ppo`

    `torchrun --nproc-per-node 2 -m mjhab.cli.main train ppo ...` trains with two processes.
    """


@dataclass(frozen=True)
class TrainSacOptions(ReinforcementOptions):
    """Soft actor-critic with distributional critics. Presets: fast (32 px depth), state, paper."""

    capacity: MaybeNumber = None
    """Control steps in the replay buffer; that of the preset if absent."""


@dataclass(frozen=True)
class TrainRlpdOptions(TrainSacOptions):
    """Soft actor-critic with demonstrations of the expert in half of every batch. Presets: demos, state."""

    demonstrations: MaybeNumber = None
    """Number of expert episodes; that of the preset if absent."""
    data: DataPlaces = ()
    """Use recorded demonstrations: shards or folders of them. If absent, the expert generates demonstrations."""
    where: Where = None
    """With --data: which episodes, as in `mjhab data query`; the successful ones if absent."""
    recompute_rewards: bool = False
    """With --data: accept episodes recorded with another profile or other rewards. Their actions are simulated again
    from the recorded first state, with the profile and the rewards of this run."""


@dataclass(frozen=True)
class TrainBcOptions(TrainOptions):
    """Behaviour cloning: predict the demonstrated actions. Presets: small, quick, state (no images), paper.

    `mjhab train bc --subtask close --target kitchen_counter/drawer3 --out runs/bc`

    Preset paper is MS-HAB's student with depth images of 128 px; small predicts chunks of actions from images of 32 px,
    normalized states and the last action.
    """


@dataclass(frozen=True)
class TrainFlowOptions(TrainOptions):
    """Flow matching: samples chunks of actions, for multimodal demonstrations. Presets: flow, quick."""


@dataclass(frozen=True)
class TrainActOptions(TrainOptions):
    """Action chunking with a small transformer and a latent variable (ACT). Presets: act, quick."""


@dataclass(frozen=True)
class TrainDiffusionOptions(TrainOptions):
    """MS-HAB's diffusion policy, with demonstrations truncated at success and averaged weights. Preset: paper_dp."""


@dataclass(frozen=True)
class TrainDaggerOptions(TrainOptions):
    """Take-over DAgger: in each round the student starts episodes, the expert finishes them, and the student learns.

    `mjhab train dagger --task set_table --subtask close --target kitchen_counter/drawer3 --preset quick
    --budget-minutes 20 --out runs/close`

    Presets: small, quick, state (no images), flow, act. Every round is kept in --out as an ordinary data set.
    """

    rounds: MaybeNumber = None
    """Rounds after the first; those of the preset if absent."""
    round_updates: MaybeNumber = None
    """Updates after every round except the first; those of the preset if absent."""
    takeovers: MaybeNumber = None
    """Episodes of every round except the first; those of the preset if absent."""
    final_updates: MaybeNumber = None
    """Updates after the last round, on all rounds, with a learning rate that decreases to zero."""
    first_prefix: MaybeNumber = None
    """Largest number of control steps for which the student acts in the first round with take-overs."""
    prefix_growth: MaybeNumber = None
    """Increase of this number per round. If the expert finishes nearly all episodes, a larger value trains faster."""


@dataclass(frozen=True)
class BenchLearnerOptions(LearnerSpec):
    """Measure reinforcement learning: control steps/s of PPO and of its environment alone, updates/s of SAC."""

    worlds: MaybeNumber = LearnerSpec.worlds
    """Worlds of PPO; those of preset fast if absent."""
    batches: Numbers = LearnerSpec.batches
    """Batch sizes of SAC, measured one after the other."""
    rounds: Number = LearnerSpec.rounds
    """Rollouts with their updates, each followed by as many control steps of the environment alone; the results are
    medians."""
    updates: Number = LearnerSpec.updates
    """Number of timed updates of SAC."""
    threads: Number = LearnerSpec.threads
    """Threads of physics and networks; 0 takes all cores."""
    seed: Number = LearnerSpec.seed
    """Seed of weights and actions."""
    json: bool = False
    """Print one line of JSON instead of tables."""


@dataclass(frozen=True)
class BenchCurvesOptions(CurvesSpec):
    """Train PPO with our settings and with those of the paper, and print the samples to 50 % and 80 % success.

    It takes hours. After a break the same command goes on; finished runs are not run again.
    """

    out: Path = CurvesSpec.out
    """Folder with a training run for every preset and seed, and curves.json."""
    samples: Number = CurvesSpec.samples
    """Control steps of every run."""
    seeds: Number = CurvesSpec.seeds
    """Runs of every preset, with seeds 0, 1, ..."""
    json: bool = False
    """Print one line of JSON instead of a table."""


@dataclass(frozen=True)
class TrainCommand:
    """Train a policy on the robot's observations; needs the extra `learn` (see `mjhab doctor`)."""

    command: (
        Annotated[TrainBcOptions, Sub("bc")]
        | Annotated[TrainFlowOptions, Sub("flow")]
        | Annotated[TrainActOptions, Sub("act")]
        | Annotated[TrainDiffusionOptions, Sub("diffusion")]
        | Annotated[TrainDaggerOptions, Sub("dagger")]
        | Annotated[TrainPpoOptions, Sub("ppo")]
        | Annotated[TrainSacOptions, Sub("sac")]
        | Annotated[TrainRlpdOptions, Sub("rlpd")]
    )
