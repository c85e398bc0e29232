"""A torch Dataset of windows of recorded episodes: observations up to a control step, and the actions from it on.

This is the only module of `mjhab.data` that imports torch.
"""

from __future__ import annotations

import bisect
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset, Sampler

from mjhab.core.errors import fault, unknown_name, wrong_value
from mjhab.core.machine import available_mb
from mjhab.core.seeding import stream
from mjhab.data.select.frames import EncodedFrames, FrameStore, decoded_bytes
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import nothing_passes, select
from mjhab.data.select.statistics import Statistics, fingerprint
from mjhab.data.select.until import Until
from mjhab.data.store.reading import RecordedEpisode, open_shard
from mjhab.data.store.schema import VERSION, DamagedError

STATE = "state"
ACTION = "action"
EXECUTED = "executed"
INTENDED = "intended"
LABELS: dict[str, str] = {EXECUTED: "actions", INTENDED: "actions_intended"}
"""Kinds of action labels, and the datasets that hold them."""
PLACES = ("episode", "step")
"""Entries of a window that are plain integers."""
AUTO = "auto"
MEMORY = "memory"
DECODE = "decode"
# The other half is for the network, and for loaders that decode besides.
MEMORY_SHARE = 0.5
"""Fraction of the free memory that "auto" uses for decoded images."""


@dataclass(frozen=True)
class Window:
    """What a window holds.

    Attributes:
        history: number of observations.
        chunk: number of actions.
        labels: "executed" for the actions that moved the robot, "intended" for those without the expert's noise.
        images: camera images, "CAMERA/OUTPUT" each.

    Raises:
        UsageError: ``history`` or ``chunk`` is less than 1, or ``labels`` is unknown.
    """

    history: int = 1
    chunk: int = 1
    labels: str = EXECUTED
    images: Sequence[str] = ()

    def __post_init__(self) -> None:
        if self.history < 1 or self.chunk < 1:
            raise wrong_value(
                "history and chunk", (self.history, self.chunk), "at least 1"
            )
        if self.labels not in LABELS:
            raise unknown_name("labels", self.labels, LABELS)


@dataclass(frozen=True, eq=False)
class Normalization:
    """How states and actions are normalized.

    Attributes:
        kind: "spread" to mean 0 and standard deviation 1, "range" to [-1, 1]; "" leaves them unchanged.
        statistics: of other data, e.g. of the training set; None takes those of the data set itself.
        cache: file for the statistics; it is read if it belongs to the data, else written.
    """

    kind: str = ""
    statistics: Statistics | None = None
    cache: Path | None = None


class WindowDataset(Dataset[dict[str, Any]]):
    """One window per control step t of every episode.

    An item is a dict with
    ``state`` (history, D) float32 and ``<camera>/<output>`` (history, C, H, W): states t-history+1 to t; the first
    state of the episode is repeated where there are none before it. rgb is uint8, depth int16 [mm];
    ``action`` (chunk, A) float32: actions of steps t to t+chunk-1; the last one is repeated after the end;
    ``action_is_pad`` (chunk,) bool: True after the end;
    ``actor`` (chunk,) uint8: who acted in these steps, as an index into ``actors``; padded like ``action``;
    ``episode`` and ``step``: indices of the window.

    A sequence of indices gives a batch with a leading axis. This is faster than collating single windows: pass a
    `BatchSampler` as the loader's ``sampler`` and ``batch_size=None``.

    States and actions are held in memory; images are decoded on first access. Data loader workers may be forked or
    spawned, because HDF5 files are only read during construction. Forked workers share decoded images.

    Args:
        places: shards, or folders of shards.
        window: what a window holds.
        where: filter on the episodes; None takes all.
        until: "success+N" ends every episode N control steps after its first success, see `Until.parse`.
        normalization: of states and actions.
        frames: storage of decoded images. "memory" keeps them in memory; "decode" decodes on every access; a folder
            keeps them in an unnamed file there, which may be larger than the memory; "auto" is "memory" if they take
            less than MEMORY_SHARE of the free memory, else "decode".

    Raises:
        UsageError: no episode passes the filter, episodes differ in their sizes or lack an image, the kind of
            normalization is unknown, or there is no room for the images.
    """

    def __init__(
        self,
        places: Path | Sequence[Path],
        window: Window | None = None,
        *,
        where: Filter | None = None,
        until: str = "",
        normalization: Normalization | None = None,
        frames: str | Path = AUTO,
    ) -> None:
        window = window or Window()
        normalization = normalization or Normalization()
        self.history = window.history
        self.chunk = window.chunk
        self.images = tuple(window.images)
        self.labels = window.labels
        self.actors: tuple[str, ...] = ()
        self._until = Until.parse(until)
        self._members = select(places, where).matched
        if not self._members:
            raise nothing_passes()
        self._frames: dict[str, list[EncodedFrames]] = {
            image: [] for image in self.images
        }
        self._states: list[np.ndarray] = []
        self._actions: list[np.ndarray] = []
        self._actor: list[np.ndarray] = []
        # Hash of what the statistics are of, so that a cache of other episodes is not taken.
        mark = self._read()
        self._starts: list[int] = np.cumsum([0, *map(len, self._actions)]).tolist()
        self.statistics = normalization.statistics or self._statistics(
            mark, normalization.cache
        )
        kind = normalization.kind
        if kind:
            self._states = [
                self.statistics.normalize(STATE, values, kind) for values in self._states
            ]
            self._actions = [
                self.statistics.normalize(ACTION, values, kind)
                for values in self._actions
            ]
        self._firsts = np.array(self._starts)
        # One array each, so that a batch is one indexing and not a loop over episodes.
        self._all_states = np.concatenate(self._states)
        self._all_actions = np.concatenate(self._actions)
        self._all_actors = np.concatenate(self._actor)
        # They would keep a second copy of all numbers.
        del self._states, self._actions, self._actor
        self._stores = _stores(self._frames, frames)

    def _read(self) -> str:
        digests = [("labels", self.labels), ("schema", str(VERSION))]
        if not self._until.is_whole:
            digests.append(("until", self._until.text))
        # Grouped, so that a shard is opened once and not for every episode.
        for path, names in itertools.groupby(self._members, lambda member: member[0]):
            with open_shard(path) as shard:
                for _, name in names:
                    episode = shard.episode(name)
                    self._add(episode)
                    digests.append((name, str(episode.attributes["digest"])))
        return fingerprint(digests)

    def _add(self, episode: RecordedEpisode) -> None:
        steps = self._until.steps(episode.array("reward/success"))
        self._states.append(episode.array("obs/state")[: steps + 1])
        self._actions.append(episode.array(LABELS[self.labels])[:steps])
        self.actors = tuple(dict.fromkeys((*self.actors, *episode.actors)))
        # Episodes number their actors each for itself; the set needs one numbering.
        places = np.array([self.actors.index(name) for name in episode.actors], np.uint8)
        self._actor.append(places[episode.array("actor")[:steps]])
        where = f"episode {episode.name} of {episode.shard.path}"
        # One nan in a batch would end the training without a hint where it came from.
        if not all(np.isfinite(each[-1]).all() for each in (self._states, self._actions)):
            raise DamagedError(
                f"{where} holds numbers that are not finite; see `mjhab data check {episode.shard.path}`."
            )
        sizes = [each[-1].shape[1] for each in (self._states, self._actions)]
        if sizes != [each[0].shape[1] for each in (self._states, self._actions)]:
            raise fault(
                where, "differs from those before it in the sizes of state and action."
            )
        for image, frames in self._frames.items():
            frames.append(EncodedFrames.of(episode, image, steps + 1))

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

    def __getitem__(self, index: int | Sequence[int]) -> dict[str, Any]:
        """One window, or a batch of them with a leading axis for a sequence of indices."""
        if isinstance(index, int | np.integer):
            window = self._batch(np.array([index]))
            return {
                key: int(value[0]) if key in PLACES else value[0]
                for key, value in window.items()
            }
        return self._batch(np.asarray(index, np.int64))

    def _batch(self, indices: np.ndarray) -> dict[str, torch.Tensor]:
        """The windows ``indices`` (B,); every entry has B as its first axis."""
        wrong = indices[(indices < 0) | (indices >= len(self))]
        if len(wrong):
            raise IndexError(int(wrong[0]))
        episode = np.searchsorted(self._starts, indices, side="right") - 1
        first = self._firsts[episode]
        step = indices - first
        # An episode has one more state than actions.
        seen = np.maximum(step[:, None] + np.arange(1 - self.history, 1), 0)
        seen = seen + (first + episode)[:, None]
        ahead = step[:, None] + np.arange(self.chunk)
        length = (self._firsts[episode + 1] - first)[:, None]
        # The last action is repeated past the end, and "action_is_pad" tells where.
        done = first[:, None] + np.minimum(ahead, length - 1)
        batch = {
            STATE: self._all_states[seen],
            ACTION: self._all_actions[done],
            "action_is_pad": ahead >= length,
            "actor": self._all_actors[done],
            "episode": episode,
            "step": step,
        }
        for image, store in self._stores.items():
            pictures = store.rows(seen.ravel())
            batch[image] = pictures.reshape(*seen.shape, *pictures.shape[1:])
        return {key: torch.from_numpy(value) for key, value in batch.items()}


def _stores(
    frames: Mapping[str, Sequence[EncodedFrames]], where: str | Path
) -> dict[str, FrameStore]:
    """Make the store of each camera output; ``where`` is ``frames`` of `WindowDataset`."""
    if isinstance(where, Path):
        return {image: FrameStore(each, True, where) for image, each in frames.items()}
    if where not in (AUTO, MEMORY, DECODE):
        raise unknown_name("place of decoded images", where, (AUTO, MEMORY, DECODE))
    free_mb = available_mb()
    needed = sum(decoded_bytes(each) for each in frames.values())
    keeps = where == MEMORY or (
        # Where the system does not tell its free memory, nothing is kept.
        where == AUTO and needed < MEMORY_SHARE * 2**20 * (free_mb or 0)
    )
    return {image: FrameStore(each, keeps) for image, each in frames.items()}


class SeededSampler(Sampler[int]):
    """Yields every index once per epoch, in an order that depends on seed and epoch only.

    Call ``set_epoch`` before each epoch; otherwise the sampler counts the epochs itself.
    """

    def __init__(self, size: int, seed: int = 0) -> None:
        self._size = size
        self._seed = seed
        self._epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Set the number of the next epoch."""
        self._epoch = epoch

    def __iter__(self) -> Iterator[int]:
        # A stream per epoch, so that a resumed training goes on with the same order.
        order = stream(self._seed, "shuffle", self._epoch).permutation(self._size)
        self._epoch += 1
        return iter(order.tolist())

    def __len__(self) -> int:
        return self._size
