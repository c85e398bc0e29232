"""Options of `mjhab score`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.cli.options.common import MaybeName, Name, Number, PolicyName
from mjhab.cli.options.policies.served import ServedOptions


@dataclass(frozen=True)
class ScoreOptions(ServedOptions):
    """Score a policy on the fixed episodes of a track, verify a score, or make a table of scores.

    A score: `mjhab score --policy my.safetensors --track subtasks --out scores/mine`

    A check: `mjhab score --check scores/mine/result.json` replays a hundred of its episodes.

    A table: `mjhab score --table scores/*/result.json --page docs/leaderboard.md`

    Ctrl-C keeps the finished episodes; the same command continues.
    """

    policy: PolicyName = "expert"
    """The policy, as for `mjhab eval`."""
    track: Annotated[str, tyro.conf.arg(metavar="subtasks|chains")] = "subtasks"
    """The episodes: single subtasks, or whole household tasks."""
    split: Name = "test"
    """Which homes: train, val or test. Official scores use the test homes."""
    robot: MaybeName = None
    """The robot (see: mjhab robots list); the default one if absent. Scores of different robots cannot be compared."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Folder of the runs and of result.json; scores/<policy>_<track>_<split> if absent."""
    worlds: Number = 8
    """How many episodes run at the same time. Changes the speed, never the results."""
    threads: Number = 0
    """Threads of the physics; 0 takes all cores. Changes the speed, never the results."""
    episodes: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """At most N episodes per row, for a quick estimate; the score is marked as incomplete."""
    check: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Check this result file instead."""
    check_seed: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """With --check: seed of the choice of episodes, to repeat a check; another one every time if absent."""
    table: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="FILE ...")] = ()
    """Make a table of these result files, or of the summary.json beside them, instead."""
    page: Annotated[Path | None, tyro.conf.arg(metavar="FILE.md")] = None
    """With --table: write it to this file instead of printing it."""
    starts: bool = False
    """Write the missing start digests of the track into the package instead; needed after a change of start states."""
    json: bool = False
    """Print one line of JSON at the end: track, score, episodes, digest."""
