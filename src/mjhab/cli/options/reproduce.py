"""The options of ``mjhab reproduce``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.cli.options.common import Assets, Name, Number, ProfileOptions
from mjhab.cli.options.train import Minutes


@dataclass(frozen=True, kw_only=True)
class ReproduceOptions(ProfileOptions):
    """Train policies for results of the MS-HAB paper, judge them, and set them beside the paper's policies.

    `mjhab reproduce table1 --rows set_table/close/drawer --preset quick --budget-minutes 20 --out runs/table1`

    `mjhab reproduce force_limits --policies runs/table1 --out runs/force_limits`

    Every policy is trained in the homes of split train and has a folder of its own in --out. Ctrl-C keeps what is done;
    the same command with `--resume` goes on.
    """

    what: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(metavar="table1|force_limits|goal_zones|long_horizon"),
    ]
    """table1: success in single subtasks, of ten rows. force_limits: the same policies without force limits, and with
    one of 1,400 N x steps. goal_zones: Place with goals of other shapes. long_horizon: whole tasks, with one policy per
    subtask, as they are and simplified."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """Folder of the runs, of results.json and of report.html."""
    rows: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ROW ...")] = ()
    """Which rows: TASK/pick, TASK/place, set_table/open/drawer, set_table/close/fridge, ...; all ten if absent."""
    column: Annotated[str, tyro.conf.arg(metavar="students|rl_per|rl_all")] = "students"
    """students: imitation by take-over DAgger, one policy per row. rl_per: reinforcement, one policy per object.
    rl_all: reinforcement, one policy per row. PPO learns Open and Close, SAC the others, as in the paper."""
    preset: Name = ""
    """Preset of `mjhab train dagger` (small if absent), or of ppo and sac (fast if absent)."""
    policies: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Train nothing; judge the policies of this earlier --out, which must have those of all rows asked for."""
    budget_minutes: Minutes = 0.0
    """Stop the training of each policy after so many minutes; 0 for no limit."""
    backend: Name = "cpu"
    """Engine that reinforcement trains in: cpu, warp (on a GPU), or auto. Judging is on the CPU."""
    device: Name = ""
    """With backend warp: cuda:0, cuda:1, ...; the first one if absent."""
    profile: Annotated[str, tyro.conf.arg(metavar="mjhab|ms_hab")] = "ms_hab"
    """Environment that students are trained and judged in; ms_hab is that of the paper."""
    split: Name = "val"
    """Homes that policies are judged in: train, val or test."""
    episodes: Number = 500
    """Episodes that each row is judged in; its policies share them."""
    films: Number = 0
    """Film the first N of them."""
    seed: Number = 0
    """Seed of everything."""
    assets: Assets = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    worlds: Number = 16
    """Episodes that run at the same time. Changes the speed, never the results."""
    threads: Number = 0
    """Threads of physics and network; 0 takes all cores. The last bits of what is learned depend on it."""
    resume: bool = False
    """Go on in --out; rows that are through are not run again."""
    json: bool = False
    """Print one line of JSON at the end."""
