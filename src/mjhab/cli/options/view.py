"""The options of ``mjhab bench view``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from mjhab.bench.specs import ViewBenchSpec
from mjhab.cli.options.common import (
    Assets,
    Name,
    Number,
    Numbers,
    PolicyName,
)


@dataclass(frozen=True)
class BenchViewOptions(ViewBenchSpec):
    """Measure the viewer: time until the first frame, frames per second, bytes and processor time per frame.

    `mjhab bench view --worlds 1 4 16`

    The test client counts frames without drawing. Fails below 30 frames per second with a single world.
    """

    worlds: Numbers = ViewBenchSpec.worlds
    """Numbers of running worlds, measured one after the other."""
    policy: PolicyName = ViewBenchSpec.policy
    """The policy, as in `mjhab eval`."""
    task: Name = ViewBenchSpec.task
    """Task of the worlds: set_table, tidy_house or prepare_groceries."""
    subtask: Name = ViewBenchSpec.subtask
    """Subtask of the worlds."""
    seconds: Annotated[float, tyro.conf.arg(metavar="S")] = ViewBenchSpec.seconds
    """Duration of counting frames [s]."""
    threads: Number = ViewBenchSpec.threads
    """Threads of the physics; 0 takes all cores."""
    assets: Assets = ViewBenchSpec.assets
    """Asset pack: builtin, or the folder of another pack."""
    json: bool = False
    """Print one line of JSON instead of a table."""
