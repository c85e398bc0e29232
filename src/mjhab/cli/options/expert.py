"""The options of ``mjhab bench experts``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.bench.specs import ExpertsSpec
from mjhab.cli.options.common import Name, Number, ProfileOptions

Names = Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")]


@dataclass(frozen=True)
class BenchExpertsOptions(ProfileOptions, ExpertsSpec):
    """Measure the success rates of the scripted experts per task, subtask and target, next to the paper's policies.

    All rows: `mjhab bench experts --assets builtin FOLDER --workers 2 --out runs/experts`

    One row: `mjhab bench experts --task tidy_house --subtask pick --target 003_cracker_box --episodes 20`

    Writes results.json, table.csv, report.html, episodes.jsonl (one line per episode) and rows/, a folder of recorded
    episodes for every row, which `mjhab replay` and `mjhab data` read. Ctrl-C and SIGTERM keep the finished episodes;
    the same command with `--resume` continues. The table depends on the seed, not on the number of workers.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = ExpertsSpec.out
    """Folder of the results."""
    assets: Annotated[tuple[str, ...], tyro.conf.arg(metavar="builtin|FOLDER ...")] = (
        ExpertsSpec.assets
    )
    """Asset packs, one after the other. FOLDER?stage=FILE.glb puts that stage into all homes of a ReplicaCAD folder."""
    split: Name = ExpertsSpec.split
    """Which homes: train, val or test."""
    task: Names = ExpertsSpec.task
    """Only these tasks: set_table, tidy_house, prepare_groceries."""
    subtask: Names = ExpertsSpec.subtask
    """Only these: pick, place, navigate, open, close, and chain for whole tasks. All if absent."""
    target: Names = ExpertsSpec.target
    """Only rows with these targets, e.g. 003_cracker_box or fridge/top_door. All if absent."""
    episodes: Number = ExpertsSpec.episodes
    """Number of episodes per row, with indices 0 to N-1; 0 leaves out single subtasks."""
    chains: Number = ExpertsSpec.chains
    """Episodes of every chain; 0 leaves the chains out."""
    navigate: Names = ExpertsSpec.navigate
    """Navigation in chains: teleport, as in the paper, or drive, by the expert; every chain is measured with each."""
    workers: Number = ExpertsSpec.workers
    """Number of processes. Changes the speed, never the results."""
    worlds: Number = ExpertsSpec.worlds
    """Parallel episodes per worker. Changes the speed, never the results."""
    seed: Number = ExpertsSpec.seed
    """Seed of the run; seed and index determine an episode."""
    resume: bool = ExpertsSpec.resume
    """Continue in --out; rows may be added, and --episodes, --chains, --workers and --worlds may differ."""
    json: bool = False
    """Print one line of JSON at the end instead of tables."""
