"""The options of the benches of learning."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.bench.specs import CurvesSpec, LearnerSpec
from mjhab.cli.options.common import Number, Numbers

MaybeNumber = Annotated[int | None, tyro.conf.arg(metavar="N")]


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
