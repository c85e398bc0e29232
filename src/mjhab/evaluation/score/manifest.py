"""The manifest: which episodes a score is made of. They are the same for everyone, named by row, seed and index."""

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

HAB_TASKS = ("tidy_house", "prepare_groceries", "set_table")
"""What is scored stays the same whatever plugins add."""

VERSION = 1
"""Changes when a row or a number of this file does: scores of two versions cannot be compared."""
SEED = 7001
SUBTASK_EPISODES = 50
CHAIN_EPISODES = 20
STARTS_FILE = Path(__file__).parent / "starts.json"
"""Digests of the starts of the episodes, by track and split and by row; `mjhab score --starts` writes them."""
START_DECIMALS = 4
"""Positions of a start are compared to so many decimals [m, rad]: settling differs less between machines."""


@dataclass(frozen=True)
class Row:
    """Episodes of one kind: those with index 0 to ``episodes`` - 1. ``subtask`` "" is a whole chain."""

    task: str
    subtask: str = ""
    target: str = ""
    episodes: int = SUBTASK_EPISODES

    @property
    def name(self) -> str:
        """A name that is also that of a folder."""
        words = (self.task, self.subtask, self.target.replace("/", "-"))
        return ".".join(word for word in words if word)


FRIDGE = "fridge/top_door"
DRAWER = "kitchen_counter/drawer3"
TRACKS: dict[str, tuple[Row, ...]] = {
    "subtasks": (
        Row("tidy_house", "pick"),
        Row("tidy_house", "place"),
        Row("tidy_house", "navigate"),
        Row("prepare_groceries", "pick"),
        Row("prepare_groceries", "place"),
        Row("set_table", "pick"),
        Row("set_table", "place"),
        Row("set_table", "open", FRIDGE),
        Row("set_table", "open", DRAWER),
        Row("set_table", "close", FRIDGE),
        Row("set_table", "close", DRAWER),
    ),
    "chains": tuple(Row(task, episodes=CHAIN_EPISODES) for task in HAB_TASKS),
}
"""The ten rows of the MS-HAB paper's Table 1 and a navigation; the three household tasks as a whole."""


@dataclass(frozen=True)
class Manifest:
    """What a track asks for on a split: its rows, the seed of all episodes, and the digests of their starts by row."""

    track: str
    split: str
    rows: tuple[Row, ...]
    seed: int
    starts: Mapping[str, tuple[str, ...]]

    @property
    def digest(self) -> str:
        """Hash of everything in it."""
        rows = [asdict(row) for row in self.rows]
        content = [VERSION, self.track, self.split, rows, self.seed, dict(self.starts)]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def manifest(track: str, split: str) -> Manifest:
    """The manifest of a track on a split; there are no digests of starts where none were written.

    Raises:
        UsageError: an unknown track or split.
    """
    if track not in TRACKS:
        raise unknown_name("track", track, TRACKS)
    if split not in SPLITS:
        raise unknown_name("split", split, SPLITS)
    starts = {row: tuple(digests) for row, digests in _starts().get(f"{track}/{split}", {}).items()}
    return Manifest(track, split, TRACKS[track], SEED, starts)


def start_digest(env: RecordedEnv, world: int) -> str:
    """Digest of the state in which an episode begins: its home and positions, rounded to START_DECIMALS."""
    positions = np.round(env.sim.get_world(world)["qpos"], START_DECIMALS)
    # There is a minus zero, whose bytes differ.
    positions = positions + 0.0
    content = env.homes[world].encode() + positions.tobytes()
    return hashlib.sha256(content).hexdigest()[:12]


@cache
def _starts() -> dict[str, dict[str, list[str]]]:
    if not STARTS_FILE.exists():
        return {}
    return json.loads(STARTS_FILE.read_text(encoding="utf-8"))
