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
    """Measure how often the scripted experts succeed: every task, subtask and target, next to the paper's policies.

    All of it: `mjhab bench experts --assets builtin FOLDER --workers 2 --out runs/experts`

    One row: `mjhab bench experts --task tidy_house --subtask pick --target 003_cracker_box --episodes 20`

    Writes results.json, table.csv, report.html, episodes.jsonl (one line per episode) and rows/, a folder of recorded
    episodes for every row, which `mjhab replay` and `mjhab data` take. Ctrl-C and SIGTERM keep the finished episodes;
    the same command with `--resume` goes on. Same seed, same table, whatever the number of workers.
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
    """Only rows about these targets, e.g. 003_cracker_box or fridge/top_door. All if absent."""
    episodes: Number = ExpertsSpec.episodes
    """Episodes of every row: those with index 0 to N-1; 0 leaves the single subtasks out."""
    chains: Number = ExpertsSpec.chains
    """Episodes of every chain; 0 leaves the chains out."""
    navigate: Names = ExpertsSpec.navigate
    """How chains get from place to place: teleport, as in the paper, or drive, by the expert; one chain for each."""
    workers: Number = ExpertsSpec.workers
    """Processes. Changes the speed, never the results."""
    worlds: Number = ExpertsSpec.worlds
    """Episodes that a worker runs at the same time. Changes the speed, never the results."""
    seed: Number = ExpertsSpec.seed
    """Seed of the run; with the index it fixes the episode."""
    resume: bool = ExpertsSpec.resume
    """Go on in --out; rows may be added, and --episodes, --chains, --workers and --worlds may differ."""
    json: bool = False
    """Print one line of JSON at the end instead of tables."""
