"""One episode before the robot's spawn: where its objects lie, and its targets; and its file in the cache."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.files.cache import write_cached
from mjhab.core.seeding import EpisodeId
from mjhab.scenes.spec import Vec3
from mjhab.tasks.plan import Target


@dataclass(frozen=True, eq=False)
class Episode(EpisodeId):
    """Settled objects of an episode and its targets; the robot's spawn is not part of it.

    Attributes:
        task: household task.
        split: split of its home.
        home: name of its home.
        object_pose: (N, 7) pose of every object slot, world frame [m, wxyz].
        link_q: (L,) joint positions of drawers and doors [m or rad].
        targets: targets in the order of the plan.
        skipped_homes: homes that had no room and whose place this one took, in the order in which they were tried.
        perturbed: what came of perturbations of its objects and of its start, by axis; no part of its file.
    """

    task: str
    split: str
    home: str
    object_pose: np.ndarray
    link_q: np.ndarray
    targets: tuple[Target, ...]
    skipped_homes: tuple[str, ...] = ()
    perturbed: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


def episode_content(episode: Episode) -> dict[str, Any]:
    """Return an episode as plain data for JSON, which keeps floats exactly; without task, split, seed and index."""
    content: dict[str, Any] = {
        "home": episode.home,
        "object_pose": episode.object_pose.tolist(),
        "link_q": episode.link_q.tolist(),
        "targets": [dataclasses.asdict(target) for target in episode.targets],
    }
    if episode.skipped_homes:
        content["skipped_homes"] = list(episode.skipped_homes)
    return content


def write_episode(path: Path, episode: Episode) -> None:
    """Write an episode as JSON, which reads ten times as fast as an npz of small arrays.

    Task, split, seed and index are not in the file: they are in its name.
    """
    content = episode_content(episode)
    write_cached(path, lambda temporary: temporary.write_text(json.dumps(content)))


def read_episode(path: Path, task: str, split: str, seed: int, index: int) -> Episode:
    """Read the file of an episode, see `write_episode`."""
    content = json.loads(path.read_text(encoding="utf-8"))
    return episode_of(content, task, split, seed, index)


def episode_of(
    content: dict[str, Any], task: str, split: str, seed: int, index: int
) -> Episode:
    """Return the episode of plain data, see `episode_content`."""
    # The shape keeps an episode without objects an array of rows.
    pose = np.array(content["object_pose"], dtype=np.float64).reshape(-1, 7)
    link_q = np.array(content["link_q"], dtype=np.float64)
    targets = tuple(_target(entry) for entry in content["targets"])
    skipped = tuple(content.get("skipped_homes", ()))
    return Episode(
        seed, index, task, split, content["home"], pose, link_q, targets, skipped
    )


def _target(entry: dict[str, Any]) -> Target:
    """Make a target from an entry of a cached episode."""
    points = {
        name: _point(entry[name]) for name in ("goal_pos", "start_pos", "handle_pos")
    }
    return Target(**{**entry, **points})


def _point(row: Sequence[float]) -> Vec3:
    # Lists of JSON become tuples, because targets are compared and hashed.
    x, y, z = row
    return (x, y, z)
