"""What the benches are asked to measure, with the defaults of `mjhab bench`, whose help tells what each entry means."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mjhab.config.profile_choice import ProfileChoice


@dataclass(frozen=True)
class EngineSpec:
    """`engine.measure_engine`: bare engine and environment, ``rounds`` pairs of blocks of ``steps`` control steps."""

    worlds: int = 16
    threads: int = 0
    task: str = "tidy_house"
    steps: int = 40
    rounds: int = 9
    seed: int = 0
    assets: str = "builtin"
    robot: str | None = None


@dataclass(frozen=True)
class ScalingSpec:
    """`scaling.measure_scaling`: engine and environment with each number of ``worlds`` and of ``threads``."""

    worlds: tuple[int, ...] = (1, 4, 16, 64, 256)
    threads: tuple[int, ...] = ()
    task: str = "tidy_house"
    rounds: int = 5
    seed: int = 0
    assets: str = "builtin"
    robot: str | None = None


@dataclass(frozen=True)
class EnvBenchSpec(ProfileChoice):
    """`env.measure`: one environment with each of several numbers of ``worlds``."""

    env: str = "mjhab/PickSubtaskTrain-v1"
    obs: str = "state"
    worlds: tuple[int, ...] = (16,)
    backend: str = "cpu"
    device: str = ""
    threads: int = 0
    camera_size: int = 128
    reward: str | None = None
    task: str | None = None
    steps: int = 40
    rounds: int = 7
    seed: int = 0
    assets: str = "builtin"


SOAK_CACHE_MB = 128.0
"""Limit of the memory cache in `mjhab bench soak` [MB]; a million steps of SetTable fill it."""


@dataclass(frozen=True)
class SoakSpec(ProfileChoice):
    """`soak.soak`: random actions in every training environment of a task, ``worlds`` of each.

    With ``generate`` that many episodes of the expert instead, of ``subtask`` or of the whole task.
    """

    steps: int = 1_000_000
    generate: int = 0
    worlds: int = 8
    task: str = "set_table"
    subtask: str | None = None
    threads: int = 0
    seed: int = 0


@dataclass(frozen=True)
class RewardSpec(ProfileChoice):
    """`reward.measure_rewards`: ``episodes`` of the expert in each of ``subtasks``, separated by commas."""

    episodes: int = 100
    worlds: int = 8
    seed: int = 0
    subtasks: str = "pick,place,open,close"
    threads: int = 0
    out: Path = Path("runs/reward")


@dataclass(frozen=True)
class ExpertsSpec(ProfileChoice):
    """`experts.run.measure_experts`: rows of tasks, subtasks and targets; "" and () for all."""

    out: Path = Path("runs/experts")
    assets: tuple[str, ...] = ("builtin",)
    split: str = "val"
    task: tuple[str, ...] = ()
    subtask: tuple[str, ...] = ()
    target: tuple[str, ...] = ()
    episodes: int = 100
    chains: int = 50
    navigate: tuple[str, ...] = ("teleport", "drive")
    workers: int = 2
    worlds: int = 4
    seed: int = 0
    resume: bool = False


@dataclass(frozen=True)
class InteractSpec:
    """`interact.run.measure_interact`: the Interact benchmark, ``seeds`` times with each number of ``worlds``."""

    backend: str = "auto"
    worlds: tuple[int, ...] = (16,)
    seeds: int = 10
    no_render: bool = False
    steps: int = 200
    device: str = ""
    threads: int = 0
    assets: str = "builtin"
    out: Path = Path("runs/interact")


@dataclass(frozen=True)
class ServingSpec:
    """`serving.measure_serving`: requests of ``worlds`` to a policy server, which is killed ``restarts`` times."""

    worlds: int = 8
    requests: int = 200
    steps: int = 1000
    restarts: int = 2


@dataclass(frozen=True)
class ViewBenchSpec:
    """`view.measure_view`: running worlds, each of several numbers of ``worlds`` shown for some seconds."""

    worlds: tuple[int, ...] = (1, 4, 16)
    policy: str = "random"
    task: str = "set_table"
    subtask: str = "pick"
    seconds: float = 5.0
    threads: int = 0
    assets: str = "builtin"


@dataclass(frozen=True)
class LearnerSpec:
    """`learner.measure_learner`: PPO in ``worlds`` worlds (None: those of its preset), SAC with each of ``batches``."""

    worlds: int | None = None
    batches: tuple[int, ...] = (256, 512)
    rounds: int = 3
    updates: int = 20
    threads: int = 0
    seed: int = 0


@dataclass(frozen=True)
class CurvesSpec:
    """`curves.measure_curves`: runs of ``samples`` control steps with ``seeds`` seeds each, in folders of ``out``."""

    out: Path = Path("runs/curves")
    samples: int = 3_000_000
    seeds: int = 3


@dataclass(frozen=True)
class ParitySpec:
    """`parity.run.measure_parity`: both simulators beside each other; "all" for all tasks or subtasks."""

    worlds: int = 4
    steps: int = 200
    episodes: int = 0
    task: str = "set_table"
    subtask: str = "pick"
    log: Path | None = None
    grasp_seconds: float = 5.0
    device: str = ""
    threads: int = 0
    seed: int = 0


@dataclass(frozen=True)
class WindowsSpec:
    """`windows.measure_windows`: batches of windows of the data set in ``places``, as `WindowDataset` gives them."""

    places: tuple[Path, ...] = ()
    history: int = 2
    chunk: int = 1
    images: tuple[str, ...] = ()
    batch: int = 64
    seconds: float = 5.0
    seed: int = 0
