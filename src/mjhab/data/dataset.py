"""Windows of recorded episodes for torch: some observations up to a step, and the actions from it on.

The only module of the package that imports torch.
"""

from __future__ import annotations

import bisect
import os
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset, Sampler

from mjhab.core.errors import UsageError
from mjhab.core.seeding import stream
from mjhab.data.query import Filter
from mjhab.data.reading import Shard, open_shard
from mjhab.data.sets import nothing_passes, select
from mjhab.data.statistics import Statistics, fingerprint

STATE, ACTION = "state", "action"
_OPEN = 16
"""Shards that a process keeps open."""


class WindowDataset(Dataset[dict[str, Any]]):
    """One window per control step t of every episode.

    An item holds
    ``state`` (history, D) float32 and ``<camera>/<output>`` (history, C, H, W) of states t-history+1 to t, the first
    state repeated where there is none before it; rgb is uint8, depth int16 [mm];
    ``action`` (chunk, A) float32 of steps t to t+chunk-1, the last one repeated after the end;
    ``action_is_pad`` (chunk,) bool; ``episode`` and ``step``.

    States and actions are held in memory; images are read when asked for, by every process from files it opens itself.

    Args:
        places: shards or folders of them.
        history: observations in a window.
        chunk: actions in a window.
        images: camera images, such as "fetch_head/depth".
        where: which episodes; all of them if None.
        normalize: give states and actions with mean 0 and spread 1.
        statistics: those to normalize with, of another set; those of this one if not given.
        cache: file to keep the statistics in; read if it is of this data, else written.

    Raises:
        UsageError: no episode passes, episodes differ in their sizes or lack an image.
    """

    def __init__(
        self,
        places: Path | Sequence[Path],
        *,
        history: int = 1,
        chunk: int = 1,
        images: Sequence[str] = (),
        where: Filter | None = None,
        normalize: bool = False,
        statistics: Statistics | None = None,
        cache: Path | None = None,
    ) -> None:
        if history < 1 or chunk < 1:
            raise UsageError(f"history and chunk must be at least 1, got {history} and {chunk}.")
        self.history, self.chunk, self.images = history, chunk, tuple(images)
        self._members = select(places, where).matched
        if not self._members:
            raise nothing_passes()
        self._shards: OrderedDict[Path, Shard] = OrderedDict()
        self._process = os.getpid()
        self._states: list[np.ndarray] = []
        self._actions: list[np.ndarray] = []
        mark = self._read()
        self._starts: list[int] = np.cumsum([0, *map(len, self._actions)]).tolist()
        self.statistics = statistics or self._statistics(mark, cache)
        if normalize:
            self._states = [self.statistics.normalize(STATE, values) for values in self._states]
            self._actions = [self.statistics.normalize(ACTION, values) for values in self._actions]

    def _read(self) -> str:
        digests = []
        for path, name in self._members:
            episode = self._shard(path).episode(name)
            self._states.append(episode.array("obs/state"))
            self._actions.append(episode.array("actions"))
            sizes = [each[-1].shape[1] for each in (self._states, self._actions)]
            if sizes != [each[0].shape[1] for each in (self._states, self._actions)]:
                raise UsageError(f"episode {name} of {path} has other sizes of state and action than the ones before.")
            for image in self.images:
                camera, _, output = image.partition("/")
                if (camera, output) not in episode.images:
                    episode.frame(camera, output, 0)
            digests.append((name, str(episode.attributes["digest"])))
        return fingerprint(digests)

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
        states, actions = self._states[episode], self._actions[episode]
        seen = np.maximum(np.arange(t - self.history + 1, t + 1), 0)
        ahead = np.arange(t, t + self.chunk)
        item: dict[str, Any] = {
            STATE: torch.from_numpy(states[seen]),
            ACTION: torch.from_numpy(actions[np.minimum(ahead, len(actions) - 1)]),
            "action_is_pad": torch.from_numpy(ahead >= len(actions)),
            "episode": episode,
            "step": t,
        }
        path, name = self._members[episode]
        for image in self.images:
            camera, _, output = image.partition("/")
            source = self._shard(path).episode(name)
            frames = {step: source.frame(camera, output, step) for step in sorted(set(seen.tolist()))}
            item[image] = torch.from_numpy(np.stack([frames[step].transpose(2, 0, 1) for step in seen.tolist()]))
        return item

    def _shard(self, path: Path) -> Shard:
        """A shard open in this process; HDF5 files must not be shared with a parent."""
        if self._process != os.getpid():
            self._shards, self._process = OrderedDict(), os.getpid()
        if path not in self._shards:
            self._shards[path] = open_shard(path)
            if len(self._shards) > _OPEN:
                self._shards.popitem(last=False)[1].close()
        self._shards.move_to_end(path)
        return self._shards[path]

    def __getstate__(self) -> dict[str, Any]:
        """What a worker process is given: everything but open files."""
        return {**self.__dict__, "_shards": OrderedDict()}


class SeededSampler(Sampler[int]):
    """Every index once per epoch, in an order that seed and epoch alone decide.

    Call ``set_epoch`` before each epoch, or let it count the epochs itself.
    """

    def __init__(self, size: int, seed: int = 0) -> None:
        self._size, self._seed, self._epoch = size, seed, 0

    def set_epoch(self, epoch: int) -> None:
        """The number of the epoch that begins next."""
        self._epoch = epoch

    def __iter__(self) -> Iterator[int]:
        order = stream(self._seed, "shuffle", self._epoch).permutation(self._size)
        self._epoch += 1
        return iter(order.tolist())

    def __len__(self) -> int:
        return self._size
