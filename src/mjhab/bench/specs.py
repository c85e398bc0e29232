"""What the benches are asked to measure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

from mjhab.config.env_spec import PROFILE, EnvSpec, env_options
from mjhab.core.errors import UsageError
from mjhab.core.typed.bounds import Bound, Output, Positive
from mjhab.core.typed.flags import Flag
from mjhab.scenes.shading import Shading


@dataclass(frozen=True)
class SweepSpec(EnvSpec):
    """A measurement that is repeated with several numbers of worlds."""

    worlds: Annotated[tuple[int, ...], Bound(1, 65_536, empty=False)] = (16,)
    """Numbers of parallel worlds, measured one after the other."""


@dataclass(frozen=True)
class EnvBenchSpec(SweepSpec):
    """Measure an environment: steps per second compared with the bare engine, time per stage, memory, cold start."""

    WHAT: ClassVar[str] = "a bench"

    id: Annotated[str, Flag("env", "ID")] = "mjhab/PickSubtaskTrain-v1"
    """The environment id (see: mjhab envs list)."""
    steps: Positive = 40
    """Control steps per block; blocks of engine and environment alternate."""
    rounds: Positive = 7
    """Pairs of blocks; the results are medians over them."""
    env: Annotated[
        Mapping[str, Any],
        env_options(
            *PROFILE,
            "obs_mode",
            "camera_size",
            "reward_mode",
            "task",
            "seed",
            "threads",
            "assets",
            "backend",
            "device",
            shown={
                "reward_mode": "default: that of the environment",
                "task": "default: that of the environment",
            },
        ),
    ] = field(default_factory=dict)
    """Options of the environment, fields of `EnvConfig`."""


@dataclass(frozen=True)
class ExpertsSpec(EnvSpec):
    """Measure the success rates of the scripted experts per task, subtask and target, next to the paper's policies.

    All rows: `mjhab bench experts --assets builtin FOLDER --workers 2 --out runs/experts`

    One row: `mjhab bench experts --task tidy_house --subtask pick --target 003_cracker_box --episodes 20`

    Writes results.json, table.csv, report.html, episodes.jsonl (one line per episode) and rows/, a folder of recorded
    episodes for every row, which `mjhab replay` and `mjhab data` read. Ctrl-C and SIGTERM keep the finished episodes;
    the same command with `--resume` continues. The table depends on the seed, not on the number of workers.
    """

    WHAT: ClassVar[str] = "a bench"

    out: Annotated[Path, Flag(metavar="FOLDER"), Output()] = Path("runs/experts")
    """Folder of the results."""
    assets: Annotated[tuple[str, ...], Flag(metavar="builtin|FOLDER ...")] = ("builtin",)
    """Asset packs, one after the other. FOLDER?stage=FILE.glb puts that stage into all homes of a ReplicaCAD folder."""
    task: Annotated[tuple[str, ...], Flag(shown="default: all")] = ()
    """Only these tasks: set_table, tidy_house, prepare_groceries."""
    subtask: Annotated[tuple[str, ...], Flag(shown="default: all")] = ()
    """Only these: pick, place, navigate, open, close, and chain for whole tasks."""
    target: Annotated[tuple[str, ...], Flag(shown="default: all")] = ()
    """Only rows with these targets, e.g. 003_cracker_box or fridge/top_door."""
    episodes: int = 100
    """Number of episodes per row, with indices 0 to N-1; 0 leaves out single subtasks."""
    chains: int = 50
    """Episodes of every chain; 0 leaves the chains out."""
    navigate: tuple[str, ...] = ("teleport", "drive")
    """Navigation in chains: teleport, as in the paper, or drive, by the expert; every chain is measured with each."""
    workers: Annotated[int, Bound(1, 256)] = 2
    """Number of processes. Changes the speed, never the results."""
    resume: bool = False
    """Continue in --out; rows may be added, and --episodes, --chains, --workers and --worlds may differ."""
    env: Annotated[
        Mapping[str, Any],
        env_options(*PROFILE, "split", "seed", "num_envs", split="val", num_envs=4),
    ] = field(default_factory=dict)
    """Options of the environment, fields of `EnvConfig`; worlds are those of a worker."""

    @property
    def of_profile(self) -> dict[str, Any]:
        """The profile, and the given options beside it."""
        given = {name: value for name, value in self.env.items() if name in PROFILE}
        return {"profile": self.asked.profile, **given}


@dataclass(frozen=True)
class InteractSpec(SweepSpec):
    """The paper's Interact benchmark: 200 control steps sweep the arm through five objects, two cameras each step.

    `mjhab bench interact --backend warp --worlds 64 256 1024 4096 --no-render`

    Writes interact.json, interact.csv and report.html with the plot of speed over memory.
    """

    WHAT: ClassVar[str] = "a bench"

    seeds: Positive = 10
    """Number of repetitions, named seeds as in the paper; nothing in the benchmark is random."""
    no_render: bool = False
    """Physics only, without 2 x 128 x 128 RGB and depth."""
    steps: Positive = 200
    """Control steps of a run: the first N of the 200 recorded ones."""
    out: Annotated[Path, Flag(metavar="FOLDER"), Output()] = Path("runs/interact")
    """Folder of the results; results of an earlier run are replaced."""
    env: Annotated[
        Mapping[str, Any],
        env_options("backend", "device", "threads", "assets", backend="auto"),
    ] = field(default_factory=dict)
    """Options of the environment, fields of `EnvConfig`."""


@dataclass(frozen=True)
class PhotoSpec(EnvSpec):
    """The paper's ray-traced benchmark (App. A.5): one camera of 128 x 128 RGB-D, random actions clipped to 0.3.

    `mjhab bench photo --samples 1 4 16 --runs 10`

    Writes photo.json, report.html with the plot of speed over samples, and what the camera saw. A control step has the
    100 Hz and 20 Hz of mjhab, one substep more than the 120 Hz and 30 Hz of the paper.
    """

    WHAT: ClassVar[str] = "a bench"

    samples: Annotated[tuple[int, ...], Bound(1, 4096, empty=False)] = (1, 4, 16)
    """Paths per pixel, measured one after the other."""
    runs: Positive = 10
    """Number of repetitions, each with actions of its own."""
    steps: Positive = 300
    """Control steps of a run."""
    out: Annotated[Path, Flag(metavar="FOLDER"), Output()] = Path("runs/photo")
    """Folder of the results; results of an earlier run are replaced."""
    env: Annotated[
        Mapping[str, Any],
        env_options("assets", "seed", "shading", shader="path"),
    ] = field(default_factory=dict)
    """Options of the environment, fields of `EnvConfig`; ``shading`` without samples."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if "samples" in self.asked.shading:
            raise UsageError(
                "bench photo measures several numbers of samples: give --samples 1 4 16, not --shading.samples."
            )

    def shading(self, samples: int) -> Shading:
        """The options of the path tracer with a number of paths per pixel."""
        options: dict[str, Any] = {**self.asked.shading, "samples": samples}
        return Shading(**options)
