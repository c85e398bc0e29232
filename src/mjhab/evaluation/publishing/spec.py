"""What ``mjhab dataset make`` is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from mjhab.config.env_spec import EnvSpec, env_options
from mjhab.config.profiles import MS_HAB
from mjhab.core.errors import unknown_name, wrong_value
from mjhab.core.typed.bounds import Bound, Output, Positive
from mjhab.core.typed.flags import Flag
from mjhab.core.typed.options import take_options
from mjhab.data.select.query import PRESETS
from mjhab.evaluation.specs import GenerateSpec, PolicyName

if TYPE_CHECKING:
    from mjhab.evaluation.score.manifest import ScoreRow

SEVEN = "ms_hab_7"
TEN = "table1"
TRACKS = (SEVEN, TEN)
HORIZON = "end"
"""``until`` of episodes that run to their horizon."""
DEMONSTRATIONS = "demonstrations"
REST = ".rest"
"""Folders of the episodes that pass the filter, and, until the set is finished, of those that do not."""


@dataclass(frozen=True)
class DatasetSpec(EnvSpec):
    """Make a data set of demonstrations that can be published: episodes, failures and recoveries, splits, a card.

    `mjhab dataset make ms_hab_7 --per-target 1000 --workers 2 --out sets/ms_hab_7`

    In ReplicaCAD: `mjhab dataset make ms_hab_7 --assets data/replica_cad --per-target 1000 --out sets/rc`

    Ctrl-C and SIGTERM keep the finished episodes; the same command continues, also with a larger --per-target.

    Raises:
        UsageError: a name is unknown, or a number out of range.
    """

    WHAT: ClassVar[str] = "a data set"
    APART: ClassVar[frozenset[str]] = frozenset({"policy"})

    track: Annotated[str, Flag(metavar="ms_hab_7|table1", positional=True)]
    """What is demonstrated: the seven subtasks of SetTable that publications on MS-HAB compare, or the ten rows of the
    paper's Table 1."""
    out: Annotated[Path, Flag(metavar="FOLDER"), Output()]
    """Folder of the data set."""
    per_target: Positive = 1000
    """Demonstrations per target: of each object and link that a row of the track names, or of all its objects."""
    rows: Annotated[tuple[str, ...], Flag(metavar="NAME ...", shown="default: all")] = ()
    """Only these rows of the track, such as set_table.pick.024_bowl."""
    episodes: Annotated[
        int | None, Flag(shown="default: 20 times those to keep"), Bound(1)
    ] = None
    """Try at most the episodes 0 to N-1 of every row."""
    policy: PolicyName = "expert"
    """Who demonstrates, as in `mjhab eval`."""
    style: Annotated[tuple[str, ...], Flag(metavar="NAME=VALUE ...")] = ()
    """Style of the expert, as in `mjhab generate`."""
    keep: Annotated[
        str | None, Flag(metavar="FILTER", shown="default: that of the paper")
    ] = None
    """Which episodes are demonstrations, as in `mjhab data query`; by default those of the paper's data, the presets
    pick_paper, place_paper, ..."""
    until: Annotated[str, Flag(metavar="success+N|end")] = "success+10"
    """End an episode N control steps after its first success, or at its horizon (end) as the original's data do."""
    failures: bool = True
    """Keep what was tried and is no demonstration, too: failures, and successes after a mishap (recoveries), each in a
    subset of its own."""
    recoveries: Annotated[float, Bound(most=1.0)] = 0.0
    """Share of the tried episodes in which the expert has a mishap on purpose: its hand opens, its arm is pushed. They
    are no demonstrations; those that succeed all the same are the subset recoveries."""
    held_out: Annotated[float, Bound(most=0.5)] = 0.1
    """Share of the demonstrations whose homes are held out as the split val."""
    images: Annotated[str, Flag(metavar="none|depth|rgb|rgbd|seg")] = "rgbd"
    """Camera images to store, as in `mjhab generate`. Point clouds are made of them (`mjhab export lerobot --points`),
    other sizes of the stored states (`mjhab replay --render`)."""
    camera_size: Annotated[int | tuple[int, int], Bound(1, 4096)] = 128
    """Pixels of the stored images: their side, or height and width."""
    rgb: Annotated[str, Flag(metavar="png|jpeg")] = "png"
    """Format of colour images; png is lossless."""
    shard_mb: Annotated[float, Bound(1)] = 512
    """Approximate largest size of a file of demonstrations [MB]."""
    workers: Annotated[int, Bound(most=256)] = 0
    """Number of processes that record; 0 takes this process (`mjhab dataset make`: one process). Changes the speed,
    never the results."""
    ray: Annotated[str | None, Flag(metavar="ADDRESS", shown="default: none")] = None
    """Record with actors of this Ray cluster ("local" starts one here)."""
    env: Annotated[
        Mapping[str, Any],
        env_options(
            "profile",
            "assets",
            "seed",
            "num_envs",
            "threads",
            "randomise",
            docs={"profile": "Rules of the environment, see `profiles.Profile`."},
            profile=MS_HAB.name,
            num_envs=4,
        ),
    ] = field(default_factory=dict)
    """The homes, the seed of the episodes, and what they are computed with: fields of `EnvConfig`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.track not in TRACKS:
            raise unknown_name("track", self.track, TRACKS)
        if self.recoveries and not self.failures:
            raise wrong_value(
                "--recoveries",
                self.recoveries,
                "0 with --no-failures",
                "It keeps demonstrations alone.",
            )
        self.chosen()
        for row in self.chosen().values():
            # Made once here, so that a wrong filter or style is told before the first row runs for hours.
            self.generation(row)

    def chosen(self) -> dict[str, ScoreRow]:
        """The rows to make, by name.

        Raises:
            UsageError: the track has no such row.
        """
        rows = _rows(self.track)
        for name in self.rows:
            if name not in rows:
                raise unknown_name("row", name, rows)
        return {name: row for name, row in rows.items() if name in (self.rows or rows)}

    def folder(self, row: ScoreRow) -> Path:
        """Folder of a row's demonstrations."""
        return self.out / DEMONSTRATIONS / row.name

    def rest(self, row: ScoreRow) -> Path:
        """Folder of a row's other episodes, while the set is being made."""
        return self.out / REST / row.name

    def generation(self, row: ScoreRow) -> GenerateSpec:
        """What is recorded for a row; it goes on where it was begun.

        Raises:
            UsageError: an option is invalid.
        """
        env = {
            **self.env_options,
            "task": row.task,
            "subtask": row.subtask,
            "target": row.target,
            # The benchmark evaluates in the homes of val and test.
            "split": "train",
        }
        preset = f"{row.subtask}_paper"
        keep = self.keep
        style = self.style
        if self.recoveries:
            style = (*style, f"mishap={self.recoveries}")
            keep = f"({keep or PRESETS[preset][0]}) and style.mishap == 0"
        return GenerateSpec(
            out=self.folder(row),
            policy=self.policy,
            style=style,
            per_target=self.per_target,
            episodes=self.episodes,
            keep=keep,
            preset=None if keep else preset,
            rest=self.rest(row) if self.failures else None,
            until="" if self.until == HORIZON else self.until,
            env=env,
            images=self.images,
            camera_size=self.camera_size,
            rgb=self.rgb,
            workers=self.workers,
            ray=self.ray,
            # A row that was interrupted has a folder.
            resume=self.folder(row).is_dir(),
        )


def _rows(track: str) -> dict[str, ScoreRow]:
    from mjhab.evaluation.score.manifest import TRACKS as SCORED
    from mjhab.tasks.subtasks.registry import SUBTASKS

    # The track of subtasks has the ten rows of the table and Navigate.
    rows = SCORED[SEVEN if track == SEVEN else "subtasks"].rows
    return {row.name: row for row in rows if not SUBTASKS[row.subtask].navigates}


@dataclass(frozen=True)
class DatasetCheckSpec:
    """Compare the files of a data set, or of an export, with the sizes and hashes that it lists."""

    folder: Annotated[Path, Flag(metavar="FOLDER", positional=True)]
    """Its folder."""

    def __post_init__(self) -> None:
        take_options(self)


REPO = Flag(metavar="USER/NAME", positional=True)


@dataclass(frozen=True)
class DatasetPushSpec:
    """Upload a data set of `mjhab dataset make`, or an export, with its card to the Hugging Face Hub, in one commit.

    `mjhab dataset push sets/ms_hab_7 USER/ms_hab_7`

    Its files are compared with its list first. The token is that of HF_TOKEN or `hf auth login`; HF_ENDPOINT names
    another hub.
    """

    folder: Annotated[Path, Flag(metavar="FOLDER", positional=True)]
    """Its folder."""
    repo: Annotated[str, REPO]
    """The repository; it is made if it is not there."""
    private: bool = False
    """Make a new repository private."""

    def __post_init__(self) -> None:
        take_options(self)


@dataclass(frozen=True)
class PolicyPushSpec:
    """Upload a trained policy with a card made of its record to the Hugging Face Hub, in one commit.

    `mjhab policy push runs/pick/student.safetensors USER/pick-bowl`

    The token is that of HF_TOKEN or `hf auth login`; HF_ENDPOINT names another hub.
    """

    policy: Annotated[Path, Flag(metavar="FILE.safetensors|FOLDER", positional=True)]
    """A checkpoint of `mjhab train`, or a folder of training runs, of which every student is taken."""
    repo: Annotated[str, REPO]
    """The repository; it is made if it is not there."""
    licence: Annotated[str, Flag(metavar="NAME", shown="default: none is told")] = ""
    """Licence in the card, as the hub names it, such as apache-2.0."""
    private: bool = False
    """Make a new repository private."""

    def __post_init__(self) -> None:
        take_options(self)


@dataclass(frozen=True)
class PullSpec:
    """Download what `push` has uploaded from the Hugging Face Hub, and compare its files with its list.

    `mjhab dataset pull USER/ms_hab_7 --out sets/ms_hab_7`

    `mjhab policy pull USER/pick-bowl --out policies/pick`

    A download that was stopped goes on with the same command.
    """

    repo: Annotated[str, REPO]
    """The repository."""
    out: Annotated[Path, Flag(metavar="FOLDER"), Output()]
    """The folder to write."""
    revision: str = "main"
    """Branch, tag or commit."""

    def __post_init__(self) -> None:
        take_options(self)
