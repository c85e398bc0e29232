"""What ``mjhab score`` and its commands are asked for."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

from mjhab.config.env_spec import EnvSpec, env_options
from mjhab.config.perturbing import axes_text, parse_axes
from mjhab.core.typed.bounds import Bound, Output
from mjhab.core.typed.flags import Flag
from mjhab.core.typed.options import take_options
from mjhab.evaluation.specs import OfServer, given_to_server
from mjhab.robots.registry import ROBOTS
from mjhab.scenes.pack_source import pack_request
from mjhab.scenes.spec import OWN_STAGE
from mjhab.serving.address import with_options, without_password

OF_TRACK = ("split", "robot", "assets", "num_envs", "threads")
TRACK = Flag(metavar="subtasks|chains|ms_hab_7")
OFFICIAL_SPLIT = {"split": "default: that of official scores"}


class TrackSpec(EnvSpec):
    """What specifications about the episodes of a track have in common."""

    track: str

    @property
    def env_defaults(self) -> Mapping[str, Any]:
        """Worlds, and the split of the track's official scores."""
        # Here: the help of a command does not wait for the packs.
        from mjhab.evaluation.score.manifest import TRACKS

        usual = super().env_defaults
        if self.track not in TRACKS:
            return usual
        return {**usual, "split": TRACKS[self.track].split}


@dataclass(frozen=True)
class ScoreSpec(TrackSpec):
    """Score a policy on the fixed episodes of a track.

    A score: `mjhab score --policy my.safetensors --track subtasks --out scores/mine`

    A check: `mjhab score check scores/mine/result.json` replays a hundred of its episodes.

    A table: `mjhab score table scores/*/result.json --page docs/leaderboard.md`

    Ctrl-C keeps the finished episodes; the same command continues.

    Raises:
        UsageError: a number is out of range, or the robot is unknown.
    """

    APART: ClassVar[frozenset[str]] = frozenset({"served"})

    policy: Annotated[str, Flag(metavar="NAME|FILE.py:CLASS|ws://HOST:PORT")] = "expert"
    """The policy, as for `mjhab eval`. A POLICIES.json or a FOLDER of training runs gives each row its own; rows for
    which there is none are left out."""
    track: Annotated[str, TRACK] = "subtasks"
    """The episodes: single subtasks, whole household tasks, or the seven subtasks that publications on MS-HAB
    compare, by its rules."""
    out: Annotated[
        Path | None,
        Flag(metavar="FOLDER", shown="default: scores/<policy>_<track>_<split>"),
        Output(),
    ] = None
    """Folder of the runs and of result.json; existing runs are continued."""
    episodes: Annotated[int | None, Flag(shown="default: all"), Bound(1)] = None
    """At most N episodes per row and seed, for a quick estimate; the score is marked as incomplete."""
    rows: Annotated[tuple[str, ...], Flag(metavar="NAME ...", shown="default: all")] = ()
    """Only these rows of the track, such as set_table.pick; the score is marked as incomplete."""
    perturb: Annotated[
        str | Mapping[str, int], Flag(metavar="AXIS:LEVEL,...", kind=str)
    ] = ""
    """Run the same episodes once more under each of these axes alone, such as camera:3,light:2, or all:2 for every one
    (see docs/perturbations.md), and compare in pairs; the score stays that of the clean episodes."""
    films: Annotated[int, Bound(most=10_000)] = 0
    """Film the first N episodes of each row and seed; films lie beside the reports in runs/."""
    env: Annotated[
        Mapping[str, Any],
        env_options(
            *OF_TRACK,
            docs={
                "split": "Which homes: train, val or test. Official scores use the test homes, those of ms_hab_7 val.",
                "robot": "The robot (see: mjhab robots list). Scores of different robots cannot be compared.",
            },
            shown=OFFICIAL_SPLIT,
            split="test",
            num_envs=8,
        ),
    ] = field(default_factory=dict)
    """The homes, the robot, and what a score is computed with: fields of `EnvConfig`."""
    served: OfServer = field(default_factory=dict)
    """With a served policy: how it is asked, fields of `serving.address.Address`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        ROBOTS.check(self.asked.robot)
        # The class is frozen; in one form, so that equal requests compare equal.
        object.__setattr__(self, "perturb", axes_text(self.axes))
        given = given_to_server(self.served)
        object.__setattr__(self, "policy", with_options(self.policy, given))

    @property
    def axes(self) -> dict[str, int]:
        """Axes of ``perturb`` and their levels."""
        return parse_axes(self.perturb)

    @property
    def folder(self) -> Path:
        """``out``, or the folder of the policy and the track."""
        if self.out is not None:
            return self.out
        # Addresses of servers may hold one, and folder names are seen by others.
        words = [without_password(self.policy), self.track, self.asked.split]
        words += [self.env["robot"]] if "robot" in self.env else []
        if "assets" in self.env:
            homes = pack_request(self.asked.assets)
            stage = "" if homes.stage == OWN_STAGE else homes.stage
            words += [Path(homes.place).name, stage]
        return Path("scores") / "_".join(
            re.sub(r"[^\w.-]+", "-", word) for word in words if word
        )


@dataclass(frozen=True)
class CheckSpec(EnvSpec):
    """Verify a score: replay a hundred of its episodes, and compare their outcomes.

    `mjhab score check scores/mine/result.json`

    Raises:
        UsageError: a number is out of range.
    """

    file: Annotated[Path, Flag(metavar="FILE", positional=True)]
    """The result file."""
    env: Annotated[
        Mapping[str, Any],
        env_options(
            "assets",
            "seed",
            docs={"seed": "Seed of the choice of episodes, to repeat a check."},
            shown={"seed": "default: another one every time"},
        ),
    ] = field(default_factory=dict)
    """The homes, which must be those of the score, and the seed: fields of `EnvConfig`."""


@dataclass(frozen=True)
class LeaderboardSpec:
    """Make a table of scores.

    `mjhab score table scores/*/result.json --page docs/leaderboard.md`
    """

    files: Annotated[tuple[Path, ...], Flag(metavar="FILE ...", positional=True)]
    """Result files, or the summary.json beside them."""
    page: Annotated[
        Path | None, Flag(metavar="FILE.md", shown="default: none"), Output(".md")
    ] = None
    """Write the table to this file instead of printing it."""

    def __post_init__(self) -> None:
        take_options(self)


@dataclass(frozen=True)
class StartsSpec(TrackSpec):
    """Write the missing start digests of a track into the package; needed after a change of start states."""

    track: Annotated[str, TRACK] = "subtasks"
    """The episodes, as for `mjhab score`."""
    env: Annotated[
        Mapping[str, Any],
        env_options(
            "split",
            "assets",
            "num_envs",
            "threads",
            shown=OFFICIAL_SPLIT,
            split="test",
            num_envs=8,
        ),
    ] = field(default_factory=dict)
    """The homes, and what the starts are computed with: fields of `EnvConfig`."""
