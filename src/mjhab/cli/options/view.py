"""The options of ``mjhab view``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mjhab.bench.specs import ViewSpec
from mjhab.cli.options.common import (
    Assets,
    Joints,
    MaybeName,
    Name,
    Number,
    Numbers,
    PolicyName,
    PolicyProfileOptions,
    StageMesh,
)
from mjhab.cli.options.data import Preset, Where


@dataclass(frozen=True)
class ViewOptions(PolicyProfileOptions):
    """Look at recorded episodes, or at running worlds, in the browser; drive by hand; write an episode as one page.

    Recorded: `mjhab view runs/pick`

    Running: `mjhab view --subtask pick --policy expert`

    By hand, recorded: `mjhab view --subtask pick --policy human --record runs/human/mine.h5`

    One episode as a page: `mjhab view runs/pick --export pick.html`

    From another machine: `ssh -L 8080:localhost:8080 HOST`, then open http://localhost:8080. Needs
    `pip install 'mjhab[view]'`; --export does not.
    """

    places: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="[SHARD|FOLDER ...]")
    ] = ()
    """Shards (*.h5) or folders of shards to look at. Without any, worlds run."""
    task: Name = "set_table"
    """Of running worlds, what to do: set_table, tidy_house or prepare_groceries."""
    subtask: MaybeName = None
    """Likewise: one subtask instead of the whole chain: pick, place, navigate, open or close."""
    target: MaybeName = None
    """With --subtask: the object or link to act on, e.g. 024_bowl or kitchen_counter/drawer3. All of them if absent."""
    policy: PolicyName = "expert"
    """What acts, as in `mjhab eval`, or human: a person drives in the page, from the first step on. Others can be
    chosen in the page."""
    policies: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Further policies that the page offers."""
    worlds: Number = 1
    """How many worlds run; the page shows one of them."""
    episode: Number = 0
    """Index of the first episode; with --export, which of the episodes to write, in their order."""
    seed: Number = 0
    """Seed of the episodes."""
    split: Name = "train"
    """Which homes: train, val or test."""
    home: MaybeName = None
    """Only this home."""
    navigate: Annotated[str, tyro.conf.arg(metavar="teleport|drive")] = "teleport"
    """How Navigate subtasks of a chain are done, as in `mjhab eval`."""
    reward: Annotated[str, tyro.conf.arg(metavar="NAME")] = ""
    """Reward to show: dense, normalized_dense or sparse; that of an evaluation if absent."""
    assets: Assets = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    stage_mesh: StageMesh = None
    """With a ReplicaCAD folder: walls and floor for every home, in place of the stages its scenes name."""
    articulate: Joints = None
    """With a ReplicaCAD folder: what opens besides counter and fridge: kitchen_cupboards, cabinet, chest_of_drawers."""
    where: Where = None
    """Of recorded episodes, only these, as in `mjhab data query`."""
    preset: Preset = None
    """A filter with a name, see `mjhab data fields`."""
    record: Annotated[Path | None, tyro.conf.arg(metavar="FILE.h5")] = None
    """Of running worlds: record every episode that ends in this shard; episodes of an older one are kept."""
    export: Annotated[Path | None, tyro.conf.arg(metavar="FILE.html")] = None
    """Write a recorded episode as one page that needs no network, instead of serving."""
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "localhost"
    """Address to listen on. Others than localhost let everybody drive who can reach this machine."""
    port: Number = 8080
    """Port to listen on; if it is in use, the next free one is taken, and said."""
    threads: Number = 0
    """Threads of the physics; 0 takes all cores."""
    json: bool = False
    """Print one line of JSON: with --export the file, else the address."""


@dataclass(frozen=True)
class BenchViewOptions(ViewSpec):
    """Measure the viewer: time until the first frame, frames per second, bytes and processor time per frame.

    `mjhab bench view --worlds 1 4 16`

    The page of this measurement counts and draws nothing. Fails below 30 frames per second with a single world.
    """

    worlds: Numbers = ViewSpec.worlds
    """How many worlds run; one measurement for each number."""
    policy: PolicyName = ViewSpec.policy
    """What acts, as in `mjhab eval`."""
    task: Name = ViewSpec.task
    """What the worlds do: set_table, tidy_house or prepare_groceries."""
    subtask: Name = ViewSpec.subtask
    """One subtask of it."""
    seconds: Annotated[float, tyro.conf.arg(metavar="S")] = ViewSpec.seconds
    """How long frames are counted."""
    threads: Number = ViewSpec.threads
    """Threads of the physics; 0 takes all cores."""
    assets: Assets = ViewSpec.assets
    """Asset pack: builtin, or the folder of another pack."""
    json: bool = False
    """Print one line of JSON instead of a table."""
