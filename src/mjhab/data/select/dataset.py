"""Windows of recorded episodes for torch: some observations up to a step, and the actions from it on.

The only module of the package that imports torch.
"""

from __future__ import annotations

import bisect
import itertools
import os
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset, Sampler

from mjhab.core.errors import UsageError, unknown_name
from mjhab.core.seeding import stream
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import nothing_passes, select
from mjhab.data.select.statistics import Statistics, fingerprint
from mjhab.data.select.until import Until
from mjhab.data.store.images import decode
from mjhab.data.store.reading import Episode, open_shard
from mjhab.data.store.schema import VERSION, DamagedError

STATE = "state"
ACTION = "action"
EXECUTED = "executed"
INTENDED = "intended"
LABELS: dict[str, str] = {EXECUTED: "actions", INTENDED: "actions_intended"}
"""Actions that a policy can be trained on, and the datasets that they lie in."""
_OPEN = 64
"""Shards that a process keeps open."""


class WindowDataset(Dataset[dict[str, Any]]):
    """One window per control step t of every episode.

    An item holds
    ``state`` (history, D) float32 and ``<camera>/<output>`` (history, C, H, W) of states t-history+1 to t, the first
    state repeated where there is none before it; rgb is uint8, depth int16 [mm];
    ``action`` (chunk, A) float32 of steps t to t+chunk-1, the last one repeated after the end;
    ``action_is_pad`` (chunk,) bool;
    ``actor`` (chunk,) uint8, who acted in these steps as a place in ``actors``, the last one repeated after the end;
    ``episode`` and ``step``.

    States and actions are held in memory; images are read from the files when they are asked for. HDF5 is done with
    when this is made: what workers do needs no open HDF5 file, so they may be forked or spawned.

    Args:
        places: shards or folders of them.
        history: observations in a window.
        chunk: actions in a window.
        labels: "executed" takes the actions that moved the robot, "intended" those that were meant, without noise.
        images: camera images, such as "fetch_head/depth".
        where: which episodes; all of them if None.
        until: "success+N" ends every episode N control steps after its first success, see `Until.parse`.
        normalize: "spread" gives states and actions with mean 0 and spread 1, "range" from -1 to 1, "" as they are.
        statistics: those to normalize with, of another set; those of this one if not given.
        cache: file to keep the statistics in; read if it is of this data, else written.

    Raises:
        UsageError: no episode passes, episodes differ in their sizes or lack an image; no such labels.
    """

    def __init__(
        self,
        places: Path | Sequence[Path],
        *,
        history: int = 1,
        chunk: int = 1,
        labels: str = EXECUTED,
        images: Sequence[str] = (),
        where: Filter | None = None,
        until: str = "",
        normalize: str = "",
        statistics: Statistics | None = None,
        cache: Path | None = None,
    ) -> None:
        if history < 1 or chunk < 1:
            raise UsageError(f"history and chunk must be at least 1, got {history} and {chunk}.")
        if labels not in LABELS:
            raise unknown_name("labels", labels, LABELS)
        self.history = history
        self.chunk = chunk
        self.images = tuple(images)
        self.labels = labels
        self.actors: tuple[str, ...] = ()
        self._until = Until.parse(until)
        self._members = select(places, where).matched
        if not self._members:
            raise nothing_passes()
        self._files = _Files()
        self._frames: dict[str, list[_Frames]] = {image: [] for image in self.images}
        self._states: list[np.ndarray] = []
        self._actions: list[np.ndarray] = []
        self._actor: list[np.ndarray] = []
        mark = self._read()
        self._starts: list[int] = np.cumsum([0, *map(len, self._actions)]).tolist()
        self.statistics = statistics or self._statistics(mark, cache)
        if normalize:
            self._states = [
                self.statistics.normalize(STATE, values, normalize) for values in self._states
            ]
            self._actions = [
                self.statistics.normalize(ACTION, values, normalize) for values in self._actions
            ]

    def _read(self) -> str:
        digests = [("labels", self.labels), ("schema", str(VERSION))]
        if not self._until.is_whole:
            digests.append(("until", self._until.text))
        for path, names in itertools.groupby(self._members, lambda member: member[0]):
            with open_shard(path) as shard:
                for _, name in names:
                    episode = shard.episode(name)
                    self._add(episode)
                    digests.append((name, str(episode.attributes["digest"])))
        return fingerprint(digests)

    def _add(self, episode: Episode) -> None:
        steps = self._until.steps(episode.array("reward/success"))
        self._states.append(episode.array("obs/state")[: steps + 1])
        self._actions.append(episode.array(LABELS[self.labels])[:steps])
        self.actors = tuple(dict.fromkeys((*self.actors, *episode.actors)))
        places = np.array([self.actors.index(name) for name in episode.actors], np.uint8)
        self._actor.append(places[episode.array("actor")[:steps]])
        where = f"episode {episode.name} of {episode.shard.path}"
        if not all(np.isfinite(each[-1]).all() for each in (self._states, self._actions)):
            raise DamagedError(
                f"{where} holds numbers that are not finite; see `mjhab data check {episode.shard.path}`."
            )
        sizes = [each[-1].shape[1] for each in (self._states, self._actions)]
        if sizes != [each[0].shape[1] for each in (self._states, self._actions)]:
            raise UsageError(f"{where} has other sizes of state and action than the ones before.")
        for image, frames in self._frames.items():
            frames.append(_Frames.of(episode, image))

    def _statistics(self, mark: str, cache: Path | None) -> Statistics:
        if cache is not None and cache.exists():
            known = Statistics.load(cache)
            if known.fingerprint == mark:
                return known
        new = Statistics.of({STATE: self._states, ACTION: self._actions}, mark)
        if cache is not None:
            new.save(cache)
        return new

    def __len__(self) -> int:
        return self._starts[-1]

    def place_of(self, index: int) -> tuple[int, int]:
        """Episode and control step of a window."""
        episode = bisect.bisect_right(self._starts, index) - 1
        return episode, index - self._starts[episode]

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not 0 <= index < len(self):
            raise IndexError(index)
        episode, t = self.place_of(index)
        states = self._states[episode]
        actions = self._actions[episode]
        seen = np.maximum(np.arange(t - self.history + 1, t + 1), 0)
        ahead = np.arange(t, t + self.chunk)
        done = np.minimum(ahead, len(actions) - 1)
        item: dict[str, Any] = {
            STATE: torch.from_numpy(states[seen]),
            ACTION: torch.from_numpy(actions[done]),
            "action_is_pad": torch.from_numpy(ahead >= len(actions)),
            "actor": torch.from_numpy(self._actor[episode][done]),
            "episode": episode,
            "step": t,
        }
        for image in self.images:
            source = self._frames[image][episode]
            frames = {step: source.read(step, self._files) for step in sorted(set(seen.tolist()))}
            item[image] = torch.from_numpy(
                np.stack([frames[step].transpose(2, 0, 1) for step in seen.tolist()])
            )
        return item

    def __getstate__(self) -> dict[str, Any]:
        """What a worker process is given: everything but open files."""
        return {**self.__dict__, "_files": _Files()}


@dataclass(frozen=True)
class _Frames:
    """Where the images of one camera of an episode lie: ``offset`` in the file, and ``ends`` from there on."""

    path: Path
    name: str
    camera: str
    output: str
    offset: int
    ends: np.ndarray | None

    @classmethod
    def of(cls, episode: Episode, image: str) -> _Frames:
        camera, _, output = image.partition("/")
        offset, ends = episode.frame_places(camera, output) or (0, None)
        return cls(episode.shard.path, episode.name, camera, output, offset, ends)

    def read(self, t: int, files: _Files) -> np.ndarray:
        """The image of state t (H, W, C)."""
        if self.ends is None:
            with open_shard(self.path) as shard:
                return shard.episode(self.name).frame(self.camera, self.output, t)
        start = int(self.ends[t - 1]) if t else 0
        try:
            data = os.pread(files.get(self.path), int(self.ends[t]) - start, self.offset + start)
            return decode(data, self.output)
        except (OSError, ValueError) as error:
            raise DamagedError(
                f"image {t} of {self.camera} {self.output} in episode {self.name} of {self.path} cannot be read: "
                f"{error}. Has the file been replaced? See what is wrong with: mjhab data check {self.path}"
            ) from error


class _Files:
    """Files open for reading. Reads give their place themselves, so processes may share them after a fork."""

    def __init__(self) -> None:
        self._open: OrderedDict[Path, int] = OrderedDict()

    def get(self, path: Path) -> int:
        """Descriptor of a file."""
        if path not in self._open:
            self._open[path] = os.open(path, os.O_RDONLY)
            if len(self._open) > _OPEN:
                os.close(self._open.popitem(last=False)[1])
        self._open.move_to_end(path)
        return self._open[path]

    def __del__(self) -> None:
        for fd in self._open.values():
            os.close(fd)


class SeededSampler(Sampler[int]):
    """Every index once per epoch, in an order that seed and epoch alone decide.

    Call ``set_epoch`` before each epoch, or let it count the epochs itself.
    """

    def __init__(self, size: int, seed: int = 0) -> None:
        self._size = size
        self._seed = seed
        self._epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """The number of the epoch that begins next."""
        self._epoch = epoch

    def __iter__(self) -> Iterator[int]:
        order = stream(self._seed, "shuffle", self._epoch).permutation(self._size)
        self._epoch += 1
        return iter(order.tolist())

    def __len__(self) -> int:
        return self._size
