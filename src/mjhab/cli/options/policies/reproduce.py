"""The options of ``mjhab reproduce``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.cli.options.common import Assets, Name, Number, ProfileOptions

Minutes = Annotated[float, tyro.conf.arg(metavar="MINUTES")]


@dataclass(frozen=True, kw_only=True)
class ReproduceOptions(ProfileOptions):
    """Train policies for results of the MS-HAB paper, evaluate them, and compare them with the paper's policies.

    `mjhab reproduce table1 --rows set_table/close/drawer --preset quick --budget-minutes 20 --out runs/table1`

    `mjhab reproduce force_limits --policies runs/table1 --out runs/force_limits`

    Every policy is trained in the homes of split train and has its own folder in --out. Ctrl-C keeps finished parts;
    the same command with `--resume` continues.
    """

    what: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(
            metavar="table1|table5|demo_count|filters|choices|force_limits|goal_zones|long_horizon"
        ),
    ]
    """table1: success in single subtasks, ten rows. force_limits: the same policies without force limits, and with a
    limit of 1,400 N x steps. goal_zones: Place with goals of other shapes. long_horizon: whole tasks, with one policy
    per subtask, unchanged and simplified. table5: behaviour cloning and the diffusion policy. demo_count: 1 to 1,000
    demonstrations per object (of --rows, else tidy_house/pick). filters: Place from objects put down, dropped, or both
    (of --rows, else prepare_groceries/place). choices: a preset of `mjhab train bc` with one choice changed at a time:
    chunk, image size, noise of the expert, ... (of --rows, else set_table/open/drawer and tidy_house/place)."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """Folder of the runs, of results.json and of report.html."""
    rows: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ROW ...")] = ()
    """Which rows: TASK/pick, TASK/place, set_table/open/drawer, set_table/close/fridge, ...; all ten if absent."""
    variants: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Make only these variants: of choices preset, chunk_1, px_64, ...; of demo_count demos_10, ...; of force_limits
    evaluation, no_force_limit, ...; all if absent. The same command with `--resume` and other names adds those."""
    column: Annotated[str, tyro.conf.arg(metavar="students|rl_per|rl_all")] = "students"
    """students: imitation by take-over DAgger, one policy per row. rl_per: reinforcement learning, one policy per
    object. rl_all: reinforcement learning, one policy per row. PPO trains Open and Close, SAC the others, as in the
    paper."""
    preset: Name = ""
    """Preset of `mjhab train dagger` (small if absent), or of ppo and sac (fast if absent)."""
    policies: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Evaluate the policies of this earlier --out instead of training; it must have those of all requested rows."""
    budget_minutes: Minutes = 0.0
    """Time limit for training each policy [min]; 0 for no limit."""
    backend: Name = "cpu"
    """Simulation backend of reinforcement learning: cpu, warp (on a GPU), or auto. Evaluation is on the CPU."""
    device: Name = ""
    """With backend warp: cuda:0, cuda:1, ...; the first one if absent. For students: where networks are trained, as in
    `mjhab train bc`."""
    demos: Number = 0
    """In table5, demo_count, filters and choices: episodes that the expert tries per data set; those of the preset if
    absent."""
    updates: Number = 0
    """In table5, demo_count, filters and choices: updates of each network; those of the preset if absent."""
    workers: Number = 1
    """In table5, demo_count, filters and choices: processes of the expert. Changes the speed, never the results."""
    profile: Annotated[str, tyro.conf.arg(metavar="mjhab|ms_hab")] = "ms_hab"
    """Environment of training and evaluation; ms_hab is that of the paper."""
    split: Name = "val"
    """Homes of the evaluation: train, val or test."""
    episodes: Number = 500
    """Evaluation episodes per row; its policies share them."""
    films: Number = 0
    """Film the first N of them."""
    seed: Number = 0
    """Seed of everything."""
    assets: Assets = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    worlds: Number = 16
    """Episodes that run at the same time. Changes the speed, never the results."""
    threads: Number = 0
    """Threads of physics and network; 0 takes all cores. The last bits of the weights depend on it."""
    resume: bool = False
    """Continue in --out; finished rows are not run again."""
    json: bool = False
    """Print one line of JSON at the end."""
