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
    """Train students for results of the MS-HAB paper, judge them, and set them beside the paper's policies.

    `mjhab reproduce table1 --rows set_table/close/drawer --preset quick --budget-minutes 20 --out runs/table1`

    Every row is trained by take-over DAgger in the homes of split train and has a folder of its own in --out. Ctrl-C
    keeps what is done; the same command with `--resume` goes on.
    """

    what: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="table1")]
    """table1: success in single subtasks, of ten rows."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """Folder of the runs, of results.json and of report.html."""
    rows: Annotated[tuple[str, ...], tyro.conf.arg(metavar="ROW ...")] = ()
    """Which rows: TASK/pick, TASK/place, set_table/open/drawer, set_table/close/fridge, ...; all ten if absent."""
    preset: Name = "small"
    """Preset of `mjhab train dagger`."""
    budget_minutes: Minutes = 0.0
    """Stop the training of each row after so many minutes; 0 for no limit."""
    profile: Annotated[str, tyro.conf.arg(metavar="mjhab|ms_hab")] = "ms_hab"
    """Environment that students are trained and judged in; ms_hab is that of the paper."""
    split: Name = "val"
    """Homes that students are judged in: train, val or test."""
    episodes: Number = 500
    """Episodes that each student is judged in."""
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
