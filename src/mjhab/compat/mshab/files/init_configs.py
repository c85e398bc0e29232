"""Files of single episodes that task plans name: ``<split>/<task>/episode_<n>.json`` below the rearrangement folder.

They are in the HAB format. Those that mjhab writes also hold the settled state and the targets to the last bit, for the
layout they were made on; other files, and ours on another layout, are settled by simulation.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

from mjhab.core.errors import about, fault
from mjhab.core.files.cache import write_text
from mjhab.core.files.reading import read_json_object
from mjhab.core.names import below
from mjhab.episodes.episode import Episode, episode_content, episode_of
from mjhab.episodes.hab.format import HabEpisode, HabFile, from_json, to_json
from mjhab.episodes.hab.reader import FileEpisodes
from mjhab.episodes.hab.writer import to_hab
from mjhab.episodes.spawn_sets import layout_digest
from mjhab.layout.layout import Layout
from mjhab.sim.mujoco.cpu import CpuSimulator

_SETTLED = "settled"
"""Entry of ``info`` with the layout's digest and the content of `episode_content`."""


def init_config_name(task: str, split: str, index: int) -> str:
    """Name of the file of an episode, relative to the rearrangement folder."""
    return f"{split}/{task}/episode_{index}.json"


def write_init_config(root: Path, name: str, layout: Layout, episode: Episode) -> Path:
    """Write the file of an episode below ``root``, atomically, and return its path."""
    hab = to_hab(layout, layout.pack.homes_by_name[episode.home], episode)
    # A settled state holds for one layout only, as columns and contacts depend on it.
    settled = {"layout": layout_digest(layout), **episode_content(episode)}
    row = to_json(dataclasses.replace(hab, info={**hab.info, _SETTLED: settled}))
    # Other readers of JSON refuse NaN, which Python would write.
    text = json.dumps(row, allow_nan=False)
    path = below(root, name)
    write_text(path, text)
    return path


def read_init_config(root: Path, name: str) -> HabEpisode:
    """Read the file of an episode below ``root``.

    Raises:
        UsageError: there is no such file, the name leads out of the folder, or it is no episode.
    """
    path = below(root, name)
    if not path.is_file():
        raise fault(
            path,
            f"there is no such episode. Task plans name episodes below the folder of rearrangement data, {root}: give "
            "the folder that the plans came with, or make plans with `mjhab episodes plans`.",
        )
    row = read_json_object(path)
    with about(path):
        return from_json(row)


class InitConfigs:
    """The episodes of some task plans on a layout. Several threads may use it.

    Args:
        sim: CPU simulator of a layout with their objects, see `reader.file_roster`.
        task: household task of the plans.
        split: split of the plans.
        files: episodes by name, from `read_init_config`.
        root: folder of the files, for messages.
    """

    def __init__(
        self,
        sim: CpuSimulator,
        task: str,
        split: str,
        files: Mapping[str, HabEpisode],
        root: Path,
    ) -> None:
        self.sim = sim
        self.task = task
        self.split = split
        self.root = root
        self.files = files
        self._numbers = {name: number for number, name in enumerate(files)}
        self._digest = layout_digest(sim.layout)

    @cached_property
    # Made when asked for: files of mjhab's own need no simulation to settle.
    def _settling(self) -> FileEpisodes:
        """The episodes as those of one file."""
        file = HabFile(tuple(self.files.values()), path=self.root)
        return FileEpisodes(self.sim, file, self.task)

    def is_own(self, name: str) -> bool:
        """Whether the file holds the settled state for this layout."""
        settled = self.files[name].info.get(_SETTLED)
        return isinstance(settled, dict) and settled.get("layout") == self._digest

    def episode(self, name: str) -> Episode:
        """Return the episode of a file.

        Raises:
            UsageError: its home, objects or furniture are not those of the layout, or a field is damaged.
        """
        if not self.is_own(name):
            return dataclasses.replace(
                self._settling.settled(self._numbers[name])[0], split=self.split
            )
        info = self.files[name].info
        try:
            seed, index = int(info["seed"]), int(info["index"])
            found = episode_of(info[_SETTLED], self.task, self.split, seed, index)
            self._check(found)
        except (KeyError, TypeError, ValueError) as error:
            raise fault(
                self.root / name,
                f"its settled state is damaged ({error}); make it again.",
            ) from error
        return found

    def _check(self, episode: Episode) -> None:
        """Check an episode against the layout.

        Raises:
            ValueError: sizes or names differ.
        """
        layout = self.sim.layout
        shapes: dict[str, tuple[Any, Any]] = {
            "object_pose": (episode.object_pose.shape, (len(layout.roster), 7)),
            "link_q": (episode.link_q.shape, (len(layout.links),)),
        }
        for name, (given, wanted) in shapes.items():
            if given != wanted:
                raise ValueError(f"{name} has shape {given} instead of {wanted}")
        if episode.home not in layout.pack.homes_by_name:
            raise ValueError(f"there is no home {episode.home!r}")
        for target in episode.targets:
            if target.obj not in layout.object_names:
                raise ValueError(f"there is no object {target.obj!r}")
