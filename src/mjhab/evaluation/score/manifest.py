"""The manifest: the fixed episodes of a score, identified by row, seed and index."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import numpy as np

from mjhab.config.env import SPLITS
from mjhab.config.profiles import DEFAULT_PROFILE, MS_HAB
from mjhab.core.errors import unknown_name
from mjhab.data.record.worlds import RecordedEnv
from mjhab.evaluation.resolve import Wanted
from mjhab.robots.registry import DEFAULT_ROBOT, ROBOTS
from mjhab.scenes.pack_source import Assets, pack_request
from mjhab.scenes.packs import open_pack
from mjhab.tasks.household.set_table import BOWL_DRAWER, FRIDGE_DOOR

HAB_TASKS = ("tidy_house", "prepare_groceries", "set_table")
"""The scored tasks. The list is fixed, so that plugins do not change a score."""

VERSION = 1
"""Increases when a row or a number of this file changes, because scores of two versions cannot be compared."""
SEED = 7001
SUBTASK_EPISODES = 50
CHAIN_EPISODES = 20
PUBLISHED_EPISODES = 100
"""Seed of the episodes, and numbers of episodes per row (and seed)."""
STARTS_FILE = Path(__file__).parent / "starts.json"
"""Digests of the episodes' start states, by `Manifest.starts_key` and by row; `mjhab score starts` writes them."""
START_DECIMALS = 4
"""Decimals of the positions [m, rad] in a start digest; differences of settling between machines are smaller."""


@dataclass(frozen=True)
class ScoreRow(Wanted):
    """The episodes 0 to ``episodes`` - 1 of one subtask, or of a whole task if ``subtask`` is ""."""

    episodes: int = SUBTASK_EPISODES

    @property
    def name(self) -> str:
        """Name, also used as a folder name."""
        words = (self.task, self.subtask, self.target.replace("/", "-"))
        return ".".join(word for word in words if word)


@dataclass(frozen=True)
class ScoreTrack:
    """What a score is made of.

    rows: its rows. split: of the homes of official scores. profile: of the rules. seeds: each row is done once per
    seed. continuing: what succeeds after a failing termination is counted, too, apart; for single subtasks.
    """

    rows: tuple[ScoreRow, ...]
    split: str = "test"
    profile: str = DEFAULT_PROFILE
    seeds: tuple[int, ...] = (SEED,)
    continuing: bool = False


TRACKS: dict[str, ScoreTrack] = {
    "subtasks": ScoreTrack(
        (
            ScoreRow("tidy_house", "pick"),
            ScoreRow("tidy_house", "place"),
            ScoreRow("tidy_house", "navigate"),
            ScoreRow("prepare_groceries", "pick"),
            ScoreRow("prepare_groceries", "place"),
            ScoreRow("set_table", "pick"),
            ScoreRow("set_table", "place"),
            ScoreRow("set_table", "open", FRIDGE_DOOR),
            ScoreRow("set_table", "open", BOWL_DRAWER),
            ScoreRow("set_table", "close", FRIDGE_DOOR),
            ScoreRow("set_table", "close", BOWL_DRAWER),
        )
    ),
    "chains": ScoreTrack(
        tuple(ScoreRow(task, episodes=CHAIN_EPISODES) for task in HAB_TASKS)
    ),
    "ms_hab_7": ScoreTrack(
        tuple(
            ScoreRow("set_table", subtask, target, PUBLISHED_EPISODES)
            for subtask, target in (
                ("pick", "013_apple"),
                ("pick", "024_bowl"),
                ("place", "013_apple"),
                ("place", "024_bowl"),
                ("open", FRIDGE_DOOR),
                ("open", BOWL_DRAWER),
                ("close", BOWL_DRAWER),
            )
        ),
        split="val",
        profile=MS_HAB.name,
        seeds=(SEED, SEED + 1, SEED + 2),
        continuing=True,
    ),
}
"""Tracks by name. "subtasks" has the ten rows of the MS-HAB paper's Table 1 and Navigate, "chains" the whole tasks,
"ms_hab_7" the seven subtasks that later publications compare."""


@dataclass(frozen=True)
class ScoreHomes:
    """The homes of a score: names that hold on every machine, in place of paths.

    pack: name of the pack. stage: see `Pack.stage`. options: further options of the `PackRequest` that were given, as
    text.
    """

    pack: str = "builtin"
    stage: str = ""
    options: str = ""

    @classmethod
    def of(cls, assets: Assets) -> ScoreHomes:
        """Those of a pack.

        Raises:
            UsageError: see `open_pack`.
        """
        request = pack_request(assets)
        pack = open_pack(request)
        others = [name for name in request.given() if name not in ("stage", "stage_mesh")]
        told = "; ".join(f"{name}: {','.join(getattr(request, name))}" for name in others)
        return cls(pack.name, pack.stage, told)

    def __str__(self) -> str:
        """The words of messages: "replica_cad (stage: stand-in)"."""
        parts = [f"stage: {self.stage}"] if self.stage else []
        parts += [self.options] if self.options else []
        return f"{self.pack} ({'; '.join(parts)})" if parts else self.pack


BUILTIN_HOMES = ScoreHomes()


@dataclass(frozen=True)
class Manifest:
    """The episodes of a track on a split with a robot in the homes of a pack.

    starts: digests of the start states by row; of a row those of the first seed come first, by index. Only the default
    robot has start digests; scores of two robots, or in other homes, have two manifests and cannot be compared.
    """

    track: str
    split: str
    rows: tuple[ScoreRow, ...]
    seeds: tuple[int, ...]
    starts: Mapping[str, tuple[str, ...]]
    robot: str = DEFAULT_ROBOT
    homes: ScoreHomes = BUILTIN_HOMES
    profile: str = DEFAULT_PROFILE
    continuing: bool = False

    @property
    def digest(self) -> str:
        """Hash of the whole manifest."""
        rows = [asdict(row) for row in self.rows]
        # As a number where it is one: digests of older scores stay what they are.
        seeds = self.seeds[0] if len(self.seeds) == 1 else self.seeds
        content: list[object] = [VERSION, self.track, self.split, rows, seeds]
        content.append(dict(self.starts))
        if self.robot != DEFAULT_ROBOT:
            content.append(self.robot)
        # Left out where they are as ever: older scores stay comparable.
        if self.homes != BUILTIN_HOMES:
            content.append(asdict(self.homes))
        if self.profile != DEFAULT_PROFILE:
            content.append({"profile": self.profile})
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[
            :16
        ]

    def place(self, row: ScoreRow, seed: int, index: int) -> int:
        """Position of an episode among those of its row."""
        return self.seeds.index(seed) * row.episodes + index

    def count(self, row: ScoreRow) -> int:
        """Number of episodes of a row, of all seeds."""
        return row.episodes * len(self.seeds)


def manifest(
    track: str,
    split: str = "",
    robot: str = DEFAULT_ROBOT,
    homes: ScoreHomes = BUILTIN_HOMES,
) -> Manifest:
    """The manifest of a track; ``starts`` lacks rows whose digests were never written.

    Args:
        track: its name.
        split: of the homes; "" for that of official scores.
        robot: its name.
        homes: those of a pack.

    Raises:
        UsageError: the track, split or robot is unknown.
    """
    if track not in TRACKS:
        raise unknown_name("track", track, TRACKS)
    told = TRACKS[track]
    split = split or told.split
    if split not in SPLITS:
        raise unknown_name("split", split, SPLITS)
    ROBOTS.check(robot)
    key = starts_key(track, split, homes)
    # Another robot begins elsewhere, and has no digests to compare with.
    written = _starts().get(key, {}) if robot == DEFAULT_ROBOT else {}
    starts = {row: tuple(digests) for row, digests in written.items()}
    return Manifest(
        track,
        split,
        told.rows,
        told.seeds,
        starts,
        robot,
        homes,
        told.profile,
        told.continuing,
    )


def starts_key(track: str, split: str, homes: ScoreHomes) -> str:
    """Name of the start digests of a track on a split in STARTS_FILE."""
    parts = [track, split]
    return "/".join(parts if homes == BUILTIN_HOMES else [*parts, str(homes)])


def start_digest(env: RecordedEnv, world: int) -> str:
    """Digest of an episode's start state: its home and its qpos, rounded to START_DECIMALS."""
    positions = np.round(env.sim.get_world(world)["qpos"], START_DECIMALS)
    # Adding 0.0 turns -0.0 into 0.0; their bytes differ.
    positions = positions + 0.0
    content = env.homes[world].encode() + positions.tobytes()
    return hashlib.sha256(content).hexdigest()[:12]


@cache
def _starts() -> dict[str, dict[str, list[str]]]:
    if not STARTS_FILE.exists():
        return {}
    return json.loads(STARTS_FILE.read_text(encoding="utf-8"))
