"""The options of ``mjhab train``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.bench.specs import LearnerSpec
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
from mjhab.cli.options.data import Where

DataPlaces = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="PATH ...")]
Minutes = Annotated[float, tyro.conf.arg(metavar="MINUTES")]
MaybeNumber = Annotated[int | None, tyro.conf.arg(metavar="N")]


@dataclass(frozen=True)
class RunOptions(PolicyProfileOptions):
    """What all of ``mjhab train`` have in common."""

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """Folder of the run: checkpoints, collected data, curves, report."""
    preset: Name = ""
    """Sizes and settings with a name; the first one if absent."""
    task: Name = "set_table"
    """Where to learn: set_table, tidy_house, prepare_groceries or one of a plugin."""
    subtask: Name = "close"
    """What to learn: pick, place, navigate, open, close or one of a plugin."""
    target: MaybeName = None
    """The object or link to act on, e.g. 024_bowl or kitchen_counter/drawer3; one policy for all of them if absent."""
    budget_minutes: Minutes = 0.0
    """Stop in time for the last evaluation to be over after so many minutes; 0 for no limit."""
    eval_episodes: Number = 100
    """Episodes of the last evaluation; 0 for none."""
    round_episodes: Number = 32
    """Episodes of the evaluations on the way; 0 for none."""
    films: Number = 0
    """Film so many episodes of the first and of the last evaluation."""
    seed: Number = 0
    """Seed of everything: weights, batches, episodes."""
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
    threads: Number = 0
    """Threads of physics and network; 0 takes all cores. The last bits of what is learned depend on it."""
    resume: bool = False
    """Go on with the run in --out, exactly where its last checkpoint is."""
    json: bool = False
    """Print one line of JSON at the end."""


@dataclass(frozen=True)
class TrainOptions(RunOptions):
    """What all algorithms of imitation have in common."""

    data: DataPlaces = ()
    """Learn from these demonstrations: shards or folders of them, with images of the preset's size. If absent, the
    expert makes demonstrations first."""
    where: Where = None
    """With --data: which episodes, as in `mjhab data query`; those that succeed if absent."""
    demos: MaybeNumber = None
    """Without --data: episodes that the expert tries; as the preset says if absent."""
    style: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE ...")] = ()
    """How the expert acts that is learned from, as in `mjhab generate`; with noise=0..0.2 it acts with noise, and what
    it intended is learned."""
    updates: MaybeNumber = None
    """Updates of the network (of dagger: in the first round); as the preset says if absent."""
    worlds: Number = 16
    """Episodes that run at the same time in a process. Changes the speed, never what is collected."""
    workers: Number = 1
    """Processes that collect; 1 collects in this one. Changes the speed, never what is collected."""
    ray: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None
    """Let actors on this Ray cluster collect ("local" starts one here); --out must be a folder all can see."""


@dataclass(frozen=True)
class ReinforcementOptions(RunOptions):
    """What all algorithms of reinforcement have in common."""

    samples: MaybeNumber = None
    """Control steps of single worlds to learn from, in all; as the preset says if absent."""
    worlds: MaybeNumber = None
    """Episodes that run at the same time; part of what is learned. As the preset says if absent."""
    start: Annotated[Path | None, tyro.conf.arg(metavar="CHECKPOINT")] = None
    """Let the actor begin from this checkpoint of `mjhab train`, e.g. a student to polish."""
    privileged_critic: bool | None = None
    """Whether the critic sees forces, velocities and time left, which no robot knows; the policy never does."""
    backend: Name = "cpu"
    """Engine of the environment: cpu, warp (on a GPU), or auto."""
    device: Name = ""
    """With backend warp: cuda:0, cuda:1, ...; the first one if absent."""


@dataclass(frozen=True)
class TrainPpoOptions(ReinforcementOptions):
    """Proximal policy optimization. Presets: fast (states), depth, polish (of a student), paper,
    paper_state (the same from states).

    `mjhab train ppo --task set_table --subtask close --target kitchen_counter/drawer3 --preset fast
    --budget-minutes 20 --out runs/ppo`

    `torchrun --nproc-per-node 2 -m mjhab.cli.main train ppo ...` lets two processes learn together.
    """


@dataclass(frozen=True)
class TrainSacOptions(ReinforcementOptions):
    """Soft actor-critic with distributional critics. Presets: fast (32 px depth), state, paper."""

    capacity: MaybeNumber = None
    """Control steps in the replay buffer; as the preset says if absent."""


@dataclass(frozen=True)
class TrainRlpdOptions(TrainSacOptions):
    """Soft actor-critic of which half of every batch are demonstrations by the expert. Presets: demos, state."""

    demonstrations: MaybeNumber = None
    """Episodes by the expert; as the preset says if absent."""
    data: DataPlaces = ()
    """Take recorded demonstrations: shards or folders of them. If absent, the expert makes demonstrations."""
    where: Where = None
    """With --data: which episodes, as in `mjhab data query`; those that succeed if absent."""
    recompute_rewards: bool = False
    """With --data: also take what was recorded in another profile or with other rewards. Actions are simulated again
    from the recorded first state, with the profile and the rewards of this run."""


@dataclass(frozen=True)
class TrainBcOptions(TrainOptions):
    """Behaviour cloning: predict what was demonstrated. Presets: small, quick, paper.

    `mjhab train bc --subtask close --target kitchen_counter/drawer3 --out runs/bc`

    Preset paper is the published student, with depth images of 128 pixels; small has chunks of actions, images of 32
    pixels, normalized states and the last action.
    """


@dataclass(frozen=True)
class TrainFlowOptions(TrainOptions):
    """Flow matching: samples chunks of actions, where demonstrations do one thing or another. Presets: flow, quick."""


@dataclass(frozen=True)
class TrainActOptions(TrainOptions):
    """Chunks of actions by a small transformer with a latent style (ACT). Presets: act, quick."""


@dataclass(frozen=True)
class TrainDiffusionOptions(TrainOptions):
    """The published diffusion policy, with truncation at success and averaged weights. Preset: paper_dp."""


@dataclass(frozen=True)
class TrainDaggerOptions(TrainOptions):
    """Take-over DAgger: the student begins, the expert finishes, the student learns from that; round after round.

    `mjhab train dagger --task set_table --subtask close --target kitchen_counter/drawer3 --preset quick
    --budget-minutes 20 --out runs/close`

    Presets: small, quick, flow, act. Every round is kept in --out as an ordinary data set.
    """

    rounds: MaybeNumber = None
    """Rounds after the first; as the preset says if absent."""
    round_updates: MaybeNumber = None
    """Updates after every round but the first; as the preset says if absent."""
    takeovers: MaybeNumber = None
    """Episodes of every round but the first; as the preset says if absent."""
    final_updates: MaybeNumber = None
    """Updates after the last round, from all rounds in equal parts, with a learning rate that falls to zero."""
    first_prefix: MaybeNumber = None
    """In the first round with take-overs the student acts for up to so many control steps."""
    prefix_growth: MaybeNumber = None
    """So many more in every later round. Where the expert saves nearly all episodes, more of them teach faster."""


@dataclass(frozen=True)
class BenchLearnerOptions(LearnerSpec):
    """Measure reinforcement: control steps/s of PPO beside its environment alone, updates/s of SAC."""

    worlds: MaybeNumber = LearnerSpec.worlds
    """Worlds of PPO; those of preset fast if absent."""
    batches: Numbers = LearnerSpec.batches
    """Sizes of the batches of SAC, measured one after the other."""
    rounds: Number = LearnerSpec.rounds
    """Rollouts with their updates, each followed by as many control steps of the environment alone; medians count."""
    updates: Number = LearnerSpec.updates
    """Updates of SAC that are timed."""
    threads: Number = LearnerSpec.threads
    """Threads of physics and networks; 0 takes all cores."""
    seed: Number = LearnerSpec.seed
    """Seed of weights and actions."""
    json: bool = False
    """Print one line of JSON instead of tables."""


@dataclass(frozen=True)
class TrainCommand:
    """Train a policy that acts from what the robot sees; needs pip install 'mjhab[learn]'."""

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
