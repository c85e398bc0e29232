"""Make spawn sets (files of precomputed starts) with several threads; an interrupted run is resumed."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.config.env import EnvConfig
from mjhab.config.thresholds import task_config
from mjhab.core.errors import fault, wrong_value
from mjhab.core.files.cache import write_text
from mjhab.episodes.episode import Episode
from mjhab.episodes.generator import EpisodeMaker
from mjhab.episodes.source import open_setting
from mjhab.episodes.spawn_sets import (
    SPAWNS_SUFFIX,
    SpawnRecipe,
    SpawnRow,
    SpawnSet,
    check_size,
    header_of,
    join,
    pack_rows,
    write,
)
from mjhab.episodes.starts import StartMaker
from mjhab.sim.mujoco.cpu import CpuSimulator
from mjhab.tasks.subtasks.registry import SUBTASKS

CHUNK = 32
"""Starts per partial file: at most so many are lost when a run is interrupted."""


class SpawnFactory:
    """Makes the starts of a recipe. Several threads may use it.

    Args:
        recipe: content of the spawn set.

    Raises:
        UsageError: the recipe names a task, subtask, target, home or robot that does not exist, or the robot lacks
            joints that the subtask needs.
    """

    def __init__(self, recipe: SpawnRecipe) -> None:
        self.recipe = recipe
        config = EnvConfig(
            task=recipe.task,
            subtask=recipe.subtask,
            target=recipe.target,
            split=recipe.split,
            home=recipe.home,
            assets=recipe.assets,
            seed=recipe.seed,
            spawn_rule=recipe.spawn_rule,
            robot=recipe.robot,
            joint_dynamics=recipe.joint_dynamics,
        )
        self.layout = open_setting(config).layout
        self.sim = CpuSimulator(self.layout, 1, 1)
        wanted = recipe.target if recipe.target in self.layout.roster else ""
        self.episodes = EpisodeMaker(
            self.sim, recipe.task, recipe.split, config.home, wanted
        )
        self.starts = StartMaker(
            self.sim, config, task_config(config, self.layout.robot), recipe.harvested
        )

    def episode(self, index: int) -> Episode:
        """Return the episode of start ``index``."""
        recipe = self.recipe
        # A pool, because settling takes longer than finding a spawn.
        arrangement = self.episodes.episode(
            recipe.seed, index % recipe.pool if recipe.pool else index
        )
        return dataclasses.replace(arrangement, index=index)

    def row(self, index: int) -> SpawnRow:
        """Make start ``index``.

        Raises:
            UsageError: a home has no room for the objects.
        """
        episode = self.episode(index)
        start = self.starts.start(episode)
        return SpawnRow(episode, start.qpos, start.position, start.fallback, start.tries)

    @property
    def _may_hold(self) -> bool:
        """Whether the robot may start with an object in its gripper."""
        return bool(self.recipe.subtask) and SUBTASKS[self.recipe.subtask].may_hold

    def header(self) -> dict[str, Any]:
        """Return the header of the file, see `spawn_sets.header_of`."""
        # The grasps decide the starts only where the robot may hold something.
        kinds = sorted(set(self.layout.roster)) if self._may_hold else []
        library = self.starts.arms if self.starts.published else self.starts.held
        return header_of(
            self.recipe, self.layout, {kind: library.digest(kind) for kind in kinds}
        )


def partial_folder(out: Path) -> Path:
    """Return the folder of the partial files, which exists until the set is complete."""
    return out.with_name(out.name + ".partial")


def make_set(
    recipe: SpawnRecipe,
    out: Path,
    threads: int,
    tell: Callable[[int, int], None],
    overwrite: bool = False,
) -> SpawnSet:
    """Make the starts of a recipe and write them to a file; an interrupted run of the same recipe is resumed.

    Args:
        recipe: content of the spawn set.
        out: ``*.npz``.
        threads: at least 1; the set does not depend on it.
        tell: called with the number of finished starts and of fallbacks so far.
        overwrite: replace ``out``, and delete the partial files of an interrupted run of another recipe.

    Raises:
        UsageError: ``out`` exists or does not end with ``.npz``, there are partial files of another recipe, or the set
            would be too large to be read.
    """
    if out.suffix != SPAWNS_SUFFIX:
        raise wrong_value("out", str(out), f"a name that ends with {SPAWNS_SUFFIX}")
    if out.exists() and not overwrite:
        raise fault(out, "exists; add --overwrite, or choose another --out.")
    factory = SpawnFactory(recipe)
    header = factory.header()
    folder = partial_folder(out)
    if not folder.exists():
        # Before hours of work: the size of one start tells that of all.
        check_size(pack_rows([factory.row(0)]), recipe.count)
    _resume(folder, header, overwrite)
    parts: list[dict[str, np.ndarray]] = []
    done = fallbacks = 0
    with ThreadPoolExecutor(threads) as pool:
        for first in range(0, recipe.count, CHUNK):
            path = folder / f"{first:08d}{SPAWNS_SUFFIX}"
            # Partial files are written atomically: one that exists is complete.
            if not path.exists():
                rows = list(
                    pool.map(factory.row, range(first, min(first + CHUNK, recipe.count)))
                )
                write(path, header, pack_rows(rows))
            # Read back even if just made, so that a resumed run gives the same bytes.
            parts.append(SpawnSet.read(path).columns)
            done = done + len(parts[-1]["home"])
            fallbacks = fallbacks + int(parts[-1]["fallback"].sum())
            tell(done, fallbacks)
    made = write(out, header, join(parts))
    # Only once the whole set is on disk.
    _clear(folder)
    return made


def _resume(folder: Path, header: dict[str, Any], overwrite: bool) -> None:
    """Prepare the folder of partial files: keep those of the same recipe, delete others.

    Raises:
        UsageError: the files are of another recipe, and ``overwrite`` is not set.
    """
    note = folder / "header.json"
    # Sorted, because it is compared as text.
    text = json.dumps(header, sort_keys=True)
    if note.exists() and note.read_text(encoding="utf-8") != text:
        if not overwrite:
            raise fault(
                folder,
                "was left by a run with other options, assets or code; finish that run, delete the folder, "
                "or add --overwrite.",
            )
        _clear(folder)
    write_text(note, text)


def _clear(folder: Path) -> None:
    """Delete the partial files in a folder, and the folder itself if it is then empty."""
    for file in (*folder.glob(f"[0-9]*{SPAWNS_SUFFIX}"), folder / "header.json"):
        file.unlink(missing_ok=True)
    # Somebody may keep other files there.
    if not any(folder.iterdir()):
        folder.rmdir()
