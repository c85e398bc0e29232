"""Demonstrations in memory: a student's inputs in every control step, and the actions to imitate."""

from __future__ import annotations

import dataclasses
import itertools
import multiprocessing
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from mjhab.core.arrays import Array
from mjhab.core.errors import UsageError, fault
from mjhab.core.names import kind_of
from mjhab.data.select.interventions import taught_steps
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import first_of_targets, select
from mjhab.data.select.until import Until
from mjhab.data.store.reading import RecordedEpisode, open_shard
from mjhab.learning.configs import InputConfig
from mjhab.learning.observation.parts import Entry
from mjhab.learning.observation.recorded import check_inputs, encode_episode
from mjhab.learning.observation.spec import (
    ObservationSpec,
    compare_specs,
    described,
    profile_of,
)
from mjhab.rollout.records import EpisodeRecord
from mjhab.tasks.subtasks.registry import SUBTASKS

SUCCESSES = "success"
"""Default filter on the episodes to learn from."""


@dataclass(frozen=True, eq=False)
class Demonstrations:
    """N control steps of several episodes, in sequence; numpy arrays, or after `on` tensors.

    vector (N, D) float32: inputs except images, see `ObservationSpec.entries`. images (N, C, H, W) uint8: see
    `parts.IMAGE_PARTS`. actions (N, A) float32: actions to imitate. first, last (N,): first and last row of the step's
    episode. usable (M,): rows at which a training sample may start, numpy always. episodes: number of episodes.
    """

    vector: Array
    images: Array
    actions: Array
    first: Array
    last: Array
    usable: np.ndarray
    episodes: int

    @classmethod
    def join(cls, parts: Sequence[Demonstrations]) -> Demonstrations:
        """Concatenate several sets.

        Raises:
            UsageError: there is nothing to learn from.
        """
        if not parts or not sum(len(part.usable) for part in parts):
            raise nothing_to_learn()
        # Rows of each part count from its own start.
        offsets = np.cumsum([0, *(len(part.vector) for part in parts)])[:-1].tolist()
        return cls(
            np.concatenate([part.vector for part in parts]),
            np.concatenate([part.images for part in parts]),
            np.concatenate([part.actions for part in parts]),
            np.concatenate(
                [part.first + at for part, at in zip(parts, offsets, strict=True)]
            ),
            np.concatenate(
                [part.last + at for part, at in zip(parts, offsets, strict=True)]
            ),
            np.concatenate(
                [part.usable + at for part, at in zip(parts, offsets, strict=True)]
            ),
            sum(part.episodes for part in parts),
        )

    def on(self, device: torch.device) -> Demonstrations:
        """Copy as tensors on a device, from which `batches.take_chunks` then takes batches without the host."""
        arrays = ("vector", "images", "actions", "first", "last")
        return dataclasses.replace(
            self,
            **{
                name: torch.as_tensor(getattr(self, name), device=device)
                for name in arrays
            },
        )

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        return self.vector.nbytes + self.images.nbytes + self.actions.nbytes


def load_demonstrations(
    places: Path | Sequence[Path],
    layout: ObservationSpec,
    hold_steps: int,
    where: Filter | None = None,
    workers: int = 1,
    per_target: int = 0,
) -> Demonstrations:
    """Read shards into memory, each episode until ``hold_steps`` control steps after its first success.

    Args:
        places: shards, or folders of shards.
        layout: of the student.
        hold_steps: number of control steps; -1 keeps whole episodes.
        where: filter on the episodes; None takes the successful ones.
        workers: number of processes; each reads whole shards.
        per_target: of every target only this number, those with the lowest indices; 0 for all.

    Raises:
        UsageError: no episode passes the filter; an episode lacks images, or its state or actions differ from
            ``layout``.
    """
    found = select(places, where or Filter(SUCCESSES))
    matched = first_of_targets(found, per_target) if per_target else found.matched
    shards = [
        (path, [name for _, name in members])
        for path, members in itertools.groupby(matched, lambda place: place[0])
    ]
    paths = [path for path, _ in shards]
    names = [members for _, members in shards]
    read = partial(_read_shard, layout=layout, hold_steps=hold_steps)
    parts: dict[str, Demonstrations] = {}
    if min(workers, len(shards)) > 1:
        # Not forked: torch has threads.
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers, context) as pool:
            for episodes in pool.map(read, paths, names):
                parts |= episodes
    else:
        for path, members in shards:
            parts |= read(path, members)
    # Sorted, because the shard of an episode depends on which worker was faster.
    return Demonstrations.join([parts[name] for name in sorted(parts)])


def _read_shard(
    path: Path, names: Sequence[str], layout: ObservationSpec, hold_steps: int
) -> dict[str, Demonstrations]:
    """The named episodes of a shard."""
    with open_shard(path) as shard:
        return {
            name: read_episode(shard.episode(name), layout, hold_steps) for name in names
        }


def observation_spec_of_data(
    places: Path | Sequence[Path], inputs: InputConfig, where: Filter | None = None
) -> ObservationSpec:
    """ObservationSpec of a student that learns from a data set; its targets are those of the selected episodes.

    Raises:
        UsageError: no episode passes the filter, or the first one lacks the images.
    """
    found = select(places, where or Filter(SUCCESSES))
    if not found.matched:
        raise nothing_to_learn()
    path, name = found.matched[0]
    # Sorted, because the place of a target in the one-hot must not depend on the order of the files.
    targets = tuple(sorted({target for _, target in _goals(found.records)}))
    with open_shard(path) as shard:
        episode = shard.episode(name)
        state, actions, control = entries_of(episode)
        layout = ObservationSpec(
            inputs,
            state,
            actions,
            targets,
            control,
            recorded_profile(episode),
            kinds=SUBTASKS.names(),
            robot=str(episode.run.config["env"].get("robot", "")),
            backbone=described(inputs),
        ).in_conventions(episode.conventions)
        # The first episode tells most mistakes before all are read.
        check_inputs(episode, layout)
    return layout


def goals_of_data(
    places: Path | Sequence[Path], where: Filter | None = None
) -> set[tuple[str, str]]:
    """Subtask and type of target of every entry in the plans of the selected episodes."""
    return _goals(select(places, where or Filter(SUCCESSES)).records)


def _goals(records: Iterable[EpisodeRecord]) -> set[tuple[str, str]]:
    return {
        (entry.kind, kind_of(entry.target)) for record in records for entry in record.plan
    }


def entries_of(
    episode: RecordedEpisode,
) -> tuple[tuple[Entry, ...], tuple[str, ...], tuple[str, ...]]:
    """State, actions and control of a recorded episode, as in `ObservationSpec`.

    Raises:
        UsageError: the episode was imported without them.
    """
    env = episode.run.config["env"]
    missing = [name for name in ("control_mode", "base", "stationary") if name not in env]
    if "actions" not in episode.run.layout:
        missing.append("the names of the actions")
    if missing:
        raise fault(
            f"episode {episode.name} of {episode.shard.path}",
            f"does not say {', '.join(missing)}, so nothing can be "
            "trained on it; import its source again, into another folder: mjhab data import ms_hab FILE.h5 --out DIR",
        )
    control = (env["control_mode"], env["base"], *env["stationary"])
    actions = tuple(str(name) for name in episode.run.layout["actions"])
    return tuple(episode.columns("obs/state").items()), actions, control


def recorded_profile(episode: RecordedEpisode) -> str:
    """The profile of a recorded episode, see `profile_of`."""
    return profile_of({**episode.run.options, **episode.run.config["env"]})


def nothing_to_learn() -> UsageError:
    """Make the error for an empty selection of episodes."""
    return UsageError(
        "no demonstration is left to learn from: no episode passes the filter, or none of them succeeds. Inspect the "
        "data with: mjhab data stats"
    )


def read_episode(
    episode: RecordedEpisode, layout: ObservationSpec, hold_steps: int
) -> Demonstrations:
    """Read one episode as Demonstrations.

    Raises:
        UsageError: the episode lacks images, or its state or actions differ from ``layout``.
    """
    _check_layout(episode, layout)
    steps = Until(hold_steps).steps(episode.array("reward/success"))
    seen = encode_episode(episode, layout, steps)
    # All steps are kept, since histories and chunks reach over those that teach nothing.
    usable = np.flatnonzero(taught_steps(episode)[:steps])
    return Demonstrations(
        seen.vector,
        seen.images,
        # What the expert meant: the executed action has noise that nobody should learn.
        episode.array("actions_intended")[:steps],
        np.zeros(steps, np.int64),
        np.full(steps, steps - 1),
        usable,
        1,
    )


def _check_layout(episode: RecordedEpisode, layout: ObservationSpec) -> None:
    state, actions, control = entries_of(episode)
    wrong = compare_specs(layout, state, actions, control)
    profile = recorded_profile(episode)
    if profile != layout.profile:
        wrong.append(f"profile {profile} instead of {layout.profile}")
    if wrong:
        raise fault(
            f"episode {episode.name} of {episode.shard.path}",
            f"does not fit the student: {'; '.join(wrong)}.",
        )
