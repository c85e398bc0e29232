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
from mjhab.core.errors import unknown_name
from mjhab.data.record.worlds import RecordedEnv
from mjhab.robots.registry import DEFAULT_ROBOT, ROBOTS

HAB_TASKS = ("tidy_house", "prepare_groceries", "set_table")
"""The scored tasks. The list is fixed, so that plugins do not change a score."""

VERSION = 1
"""Increases when a row or a number of this file changes, because scores of two versions cannot be compared."""
SEED = 7001
SUBTASK_EPISODES = 50
CHAIN_EPISODES = 20
"""Seed of all episodes, and numbers of episodes per row."""
STARTS_FILE = Path(__file__).parent / "starts.json"
"""Digests of the episodes' start states, by "track/split" and by row; `mjhab score starts` writes them."""
START_DECIMALS = 4
"""Decimals of the positions [m, rad] in a start digest; differences of settling between machines are smaller."""


@dataclass(frozen=True)
class ScoreRow:
    """The episodes 0 to ``episodes`` - 1 of one subtask, or of a whole task if ``subtask`` is ""."""

    task: str
    subtask: str = ""
    target: str = ""
    episodes: int = SUBTASK_EPISODES

    @property
    def name(self) -> str:
        """Name, also used as a folder name."""
        words = (self.task, self.subtask, self.target.replace("/", "-"))
        return ".".join(word for word in words if word)


FRIDGE = "fridge/top_door"
DRAWER = "kitchen_counter/drawer3"
TRACKS: dict[str, tuple[ScoreRow, ...]] = {
    "subtasks": (
        ScoreRow("tidy_house", "pick"),
        ScoreRow("tidy_house", "place"),
        ScoreRow("tidy_house", "navigate"),
        ScoreRow("prepare_groceries", "pick"),
        ScoreRow("prepare_groceries", "place"),
        ScoreRow("set_table", "pick"),
        ScoreRow("set_table", "place"),
        ScoreRow("set_table", "open", FRIDGE),
        ScoreRow("set_table", "open", DRAWER),
        ScoreRow("set_table", "close", FRIDGE),
        ScoreRow("set_table", "close", DRAWER),
    ),
    "chains": tuple(ScoreRow(task, episodes=CHAIN_EPISODES) for task in HAB_TASKS),
}
"""Rows by track: "subtasks" has the ten rows of the MS-HAB paper's Table 1 and Navigate, "chains" the whole tasks."""


@dataclass(frozen=True)
class Manifest:
    """The episodes of a track on a split with a robot. starts: digests of the start states by row and index.

    Only the default robot has start digests; scores of two robots have two manifests and cannot be compared.
    """

    track: str
    split: str
    rows: tuple[ScoreRow, ...]
    seed: int
    starts: Mapping[str, tuple[str, ...]]
    robot: str = DEFAULT_ROBOT

    @property
    def digest(self) -> str:
        """Hash of the whole manifest."""
        rows = [asdict(row) for row in self.rows]
        content = [VERSION, self.track, self.split, rows, self.seed, dict(self.starts)]
        if self.robot != DEFAULT_ROBOT:
            content.append(self.robot)
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[
            :16
        ]


def manifest(track: str, split: str, robot: str = DEFAULT_ROBOT) -> Manifest:
    """The manifest of a track on a split with a robot; ``starts`` lacks rows whose digests were never written.

    Raises:
        UsageError: the track, split or robot is unknown.
    """
    if track not in TRACKS:
        raise unknown_name("track", track, TRACKS)
    if split not in SPLITS:
        raise unknown_name("split", split, SPLITS)
    ROBOTS.check(robot)
    written = _starts().get(f"{track}/{split}", {}) if robot == DEFAULT_ROBOT else {}
    starts = {row: tuple(digests) for row, digests in written.items()}
    return Manifest(track, split, TRACKS[track], SEED, starts, robot)


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
