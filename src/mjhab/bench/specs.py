"""What the benches are asked to measure, with the defaults of `mjhab bench`, whose help tells what each entry means."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mjhab.config.profile_choice import ProfileChoice


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
