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
from mjhab.cli.options.datasets.data import Preset, Where


@dataclass(frozen=True)
class ViewOptions(PolicyProfileOptions):
    """View recorded episodes or running worlds in the browser, drive by hand, or write an episode as one page.

    Recorded: `mjhab view runs/pick`

    Running: `mjhab view --subtask pick --policy expert`

    By hand, recorded: `mjhab view --subtask pick --policy human --record runs/human/mine.h5`

    One episode as a page: `mjhab view runs/pick --export pick.html`

    From another machine: `ssh -L 8080:localhost:8080 HOST`, then open http://localhost:8080. Needs
    the extra `view` (`mjhab doctor` tells how to install it); --export does not.
    """

    places: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="[SHARD|FOLDER ...]"),
    ] = ()
    """Shards (*.h5) or folders of shards to view. Without any, new worlds run."""
    task: Name = "set_table"
    """Task of running worlds: set_table, tidy_house or prepare_groceries."""
    subtask: MaybeName = None
    """Subtask of running worlds instead of the whole chain: pick, place, navigate, open or close."""
    target: MaybeName = None
    """With --subtask: the object or link to act on, e.g. 024_bowl or kitchen_counter/drawer3. All of them if absent."""
    policy: PolicyName = "expert"
    """The policy, as in `mjhab eval`, or human: a person drives in the page from the first step on. Others can be
    chosen in the page."""
    policies: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ()
    """Further policies that the page offers."""
    worlds: Number = 1
    """Number of running worlds; the page shows one of them."""
    episode: Number = 0
    """Index of the first episode of running worlds; with recorded episodes, position of the one to show, or to write
    with --export, from 0."""
    seed: Number = 0
    """Seed of the episodes."""
    split: Name = "train"
    """Which homes: train, val or test."""
    home: MaybeName = None
    """Only this home."""
    navigate: Annotated[str, tyro.conf.arg(metavar="teleport|drive")] = "teleport"
    """Execution of Navigate subtasks in a chain, as in `mjhab eval`."""
    reward: Annotated[str, tyro.conf.arg(metavar="NAME")] = ""
    """Reward of running worlds: dense (with its terms, if absent), normalized_dense or sparse."""
    horizon: Number = 0
    """Control steps of 50 ms after which a subtask of running worlds ends, for instance to drive by hand for longer;
    0 for those of the task."""
    assets: Assets = "builtin"
    """Asset pack: builtin, or the folder of another pack."""
    stage_mesh: StageMesh = None
    """With a ReplicaCAD folder: walls and floor for every home, in place of the stages its scenes name."""
    articulate: Joints = None
    """With a ReplicaCAD folder: what opens besides counter and fridge: kitchen_cupboards, cabinet, chest_of_drawers."""
    where: Where = None
    """With recorded episodes: only these, as in `mjhab data query`."""
    preset: Preset = None
    """A filter with a name, see `mjhab data fields`."""
    record: Annotated[Path | None, tyro.conf.arg(metavar="FILE.h5")] = None
    """With running worlds: record every finished episode in this shard; existing episodes in it are kept."""
    export: Annotated[Path | None, tyro.conf.arg(metavar="FILE.html")] = None
    """Write a recorded episode as a self-contained page instead of serving."""
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "localhost"
    """Address to listen on. With addresses other than localhost, everybody who can reach this machine can drive."""
    port: Number = 8080
    """Port to listen on; if it is in use, the next free one is used and printed."""
    threads: Number = 0
    """Threads of the physics; 0 takes all cores."""
    json: bool = False
    """Print one line of JSON: with --export the file, else the address."""


@dataclass(frozen=True)
class BenchViewOptions(ViewSpec):
    """Measure the viewer: time until the first frame, frames per second, bytes and processor time per frame.

    `mjhab bench view --worlds 1 4 16`

    The test client counts frames without drawing. Fails below 30 frames per second with a single world.
    """

    worlds: Numbers = ViewSpec.worlds
    """Numbers of running worlds, measured one after the other."""
    policy: PolicyName = ViewSpec.policy
    """The policy, as in `mjhab eval`."""
    task: Name = ViewSpec.task
    """Task of the worlds: set_table, tidy_house or prepare_groceries."""
    subtask: Name = ViewSpec.subtask
    """Subtask of the worlds."""
    seconds: Annotated[float, tyro.conf.arg(metavar="S")] = ViewSpec.seconds
    """Duration of counting frames [s]."""
    threads: Number = ViewSpec.threads
    """Threads of the physics; 0 takes all cores."""
    assets: Assets = ViewSpec.assets
    """Asset pack: builtin, or the folder of another pack."""
    json: bool = False
    """Print one line of JSON instead of a table."""
