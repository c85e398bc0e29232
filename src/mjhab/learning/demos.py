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

from mjhab.core.arrays import Array, namespace
from mjhab.core.errors import UsageError
from mjhab.core.joints import BASE, BASE_X, BASE_Y, BASE_YAW
from mjhab.core.names import kind_of
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import first_of_targets, select
from mjhab.data.select.until import Until
from mjhab.data.store.images import decode
from mjhab.data.store.reading import RecordedEpisode, open_shard
from mjhab.learning.configs import InputConfig
from mjhab.learning.layout import Entry, Layout, compare_layouts, profile_of
from mjhab.learning.runs.take_over import expert_steps
from mjhab.rollout.records import EpisodeRecord
from mjhab.tasks.subtasks.registry import SUBTASKS

SUCCESSES = "success"
"""Default filter on the episodes to learn from."""
MILLIMETRES_PER_METRE = 1000.0
BYTE = 255


def _nearness_table() -> np.ndarray:
    metres = np.arange(np.iinfo(np.int16).max + 1) / MILLIMETRES_PER_METRE
    return np.rint(BYTE * (1.0 - np.tanh(metres))).astype(np.uint8)


_NEARNESS = _nearness_table()


def nearness(depth: np.ndarray) -> np.ndarray:
    """Map int16 depth [mm] to uint8 nearness 255 (1 - tanh(depth / 1 m)), 255 at the lens (mshab/agents/bc)."""
    return _NEARNESS[depth]


@dataclass(frozen=True, eq=False)
class Demonstrations:
    """N control steps of several episodes, in sequence; numpy arrays, or after `on` tensors.

    vector (N, D) float32: inputs except images, see `Layout.entries`. images (N, C, H, W) uint8: see `nearness`.
    actions (N, A) float32: actions to imitate. first, last (N,): first and last row of the step's episode.
    usable (M,): rows at which a training sample may start, numpy always. episodes: number of episodes.
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
    layout: Layout,
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
    path: Path, names: Sequence[str], layout: Layout, hold_steps: int
) -> dict[str, Demonstrations]:
    """The named episodes of a shard."""
    with open_shard(path) as shard:
        return {
            name: read_episode(shard.episode(name), layout, hold_steps) for name in names
        }


def layout_of_data(
    places: Path | Sequence[Path], inputs: InputConfig, where: Filter | None = None
) -> Layout:
    """Layout of a student that learns from a data set; its targets are those of the selected episodes.

    Raises:
        UsageError: no episode passes the filter, or the first one lacks the images.
    """
    found = select(places, where or Filter(SUCCESSES))
    if not found.matched:
        raise nothing_to_learn()
    path, name = found.matched[0]
    targets = tuple(sorted({target for _, target in _goals(found.records)}))
    with open_shard(path) as shard:
        episode = shard.episode(name)
        state, actions, control = entries_of(episode)
        layout = Layout(
            inputs,
            state,
            actions,
            targets,
            control,
            recorded_profile(episode),
            kinds=SUBTASKS.names(),
            robot=str(episode.run.config["env"].get("robot", "")),
        )
        _images(episode, layout, 1)
        _sentences(episode, layout)
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
    """State, actions and control of a recorded episode, as in `Layout`.

    Raises:
        UsageError: the episode was imported without them.
    """
    env = episode.run.config["env"]
    missing = [name for name in ("control_mode", "base", "stationary") if name not in env]
    if "actions" not in episode.run.layout:
        missing.append("the names of the actions")
    if missing:
        raise UsageError(
            f"episode {episode.name} of {episode.shard.path} does not say {', '.join(missing)}, so nothing can be "
            "trained on it; import its source again, into another folder: mjhab data import ms_hab FILE.h5 --out DIR"
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
    episode: RecordedEpisode, layout: Layout, hold_steps: int
) -> Demonstrations:
    """Read one episode as Demonstrations.

    Raises:
        UsageError: the episode lacks images, or its state or actions differ from ``layout``.
    """
    _check_layout(episode, layout)
    executed = episode.array("actions")
    steps = Until(hold_steps).steps(episode.array("reward/success"))
    vector = _vectors(episode, layout, executed)[:steps]
    images = _images(episode, layout, steps)
    usable = np.flatnonzero(expert_steps(episode)[:steps])
    return Demonstrations(
        vector,
        images,
        episode.array("actions_intended")[:steps],
        np.zeros(steps, np.int64),
        np.full(steps, steps - 1),
        usable,
        1,
    )


def _check_layout(episode: RecordedEpisode, layout: Layout) -> None:
    state, actions, control = entries_of(episode)
    wrong = compare_layouts(layout, state, actions, control)
    profile = recorded_profile(episode)
    if profile != layout.profile:
        wrong.append(f"profile {profile} instead of {layout.profile}")
    if wrong:
        raise UsageError(
            f"episode {episode.name} of {episode.shard.path} does not fit the student: {'; '.join(wrong)}."
        )


def _vectors(
    episode: RecordedEpisode, layout: Layout, executed: np.ndarray
) -> np.ndarray:
    """The student's inputs except images in every step, (N, D) float32."""
    steps = len(executed)
    parts = [episode.array("obs/state")[:steps]]
    if layout.inputs.base_velocity:
        parts.append(base_velocity_of(episode)[:steps])
    if layout.inputs.link_state:
        raise UsageError(
            "recorded demonstrations hold no link_state; use a preset with images, or leave out the data: the "
            "expert then generates demonstrations in the environment."
        )
    if layout.inputs.previous_action:
        parts.append(np.concatenate([np.zeros_like(executed[:1]), executed[:-1]]))
    if layout.condition_width:
        plan = episode.record.plan
        sentences = _sentences(episode, layout)
        pointers = np.minimum(episode.array("subtasks/active")[:steps], len(plan) - 1)
        codes = [
            layout.condition(entry.kind, kind_of(entry.target), sentence)
            for entry, sentence in zip(plan, sentences, strict=True)
        ]
        parts.append(np.stack(codes)[pointers])
    return np.concatenate(parts, axis=1, dtype=np.float32)


def _sentences(episode: RecordedEpisode, layout: Layout) -> Sequence[str]:
    """The instruction of every subtask of the plan; "" if the student takes none.

    Raises:
        UsageError: the episode was recorded without instructions.
    """
    plan = episode.record.plan
    if not layout.inputs.sentence:
        return [""] * len(plan)
    told = episode.record.instructions
    if len(told) != len(plan) or not all(told):
        raise UsageError(
            f"episode {episode.name} of {episode.shard.path} was recorded without instructions, which a student with "
            "inputs.sentence=true learns from; leave out this input, or record new episodes: mjhab generate"
        )
    return told


def base_velocity_of(episode: RecordedEpisode) -> np.ndarray:
    """Forward speed [m/s] and turning rate [rad/s] of the base (N+1, 2) float32, from the recorded states.

    Raises:
        UsageError: the episode was imported from data without states.
    """
    if lacks_states(episode):
        raise UsageError(
            f"episode {episode.name} of {episode.shard.path} was imported from data without states, which the velocity "
            "of the base is computed from; take a student without it: --preset paper, or --set "
            "inputs.base_velocity=false."
        )
    columns = episode.run.layout["columns"]
    q = episode.array("states/qpos")[:, columns["robot_q"][BASE]]
    qd = episode.array("states/qvel")[:, columns["robot_v"][BASE]]
    return base_velocity(q, qd)


def lacks_states(episode: RecordedEpisode) -> bool:
    """Whether the episode was imported from data without states, from which nothing can be computed anew."""
    return "states/initial" in episode.run.absent


def base_velocity(q: Array, qd: Array) -> Array:
    """Forward speed [m/s] and turning rate [rad/s] of the base, (N, 2) float32; numpy or torch, like ``q``.

    Args:
        q: (N, 3+) joint positions that start with x, y [m] and yaw [rad] of the base. qd: their velocities.
    """
    yaw = q[:, BASE_YAW]
    xp = namespace(q)
    forward = xp.cos(yaw) * qd[:, BASE_X] + xp.sin(yaw) * qd[:, BASE_Y]
    return xp.astype(xp.stack([forward, qd[:, BASE_YAW]], axis=1), xp.float32)


def _images(episode: RecordedEpisode, layout: Layout, steps: int) -> np.ndarray:
    """Images (N, C, H, W) uint8 of the first ``steps`` states."""
    size = layout.inputs.image_size
    if not layout.image_keys:
        return np.zeros((steps, 0, 0, 0), np.uint8)
    cameras = []
    for camera in layout.inputs.cameras:
        if (camera, "depth") not in episode.images:
            raise _no_images(episode, layout, f"has no depth images of {camera}", None)
        files = episode.array(f"images/{camera}/depth/bytes").tobytes()
        ends = episode.array(f"images/{camera}/depth/ends").tolist()
        starts = [0, *ends]
        frames = [
            decode(files[starts[t] : ends[t]], "depth")[..., 0] for t in range(steps)
        ]
        if frames[0].shape != (size, size):
            height, width = frames[0].shape
            raise _no_images(
                episode,
                layout,
                f"has depth images of {width}x{height} px",
                (height, width),
            )
        cameras.append(nearness(np.stack(frames)))
    return np.stack(cameras, axis=1)


def _no_images(
    episode: RecordedEpisode, layout: Layout, found: str, have: tuple[int, int] | None
) -> UsageError:
    """Make the error for images that are missing (``have`` None) or of another size (height, width) [px]."""
    size = layout.inputs.image_size
    cameras = " ".join(layout.inputs.cameras)
    told = f"episode {episode.name} of {episode.shard.path} {found}; the preset needs {size}x{size} px. "
    if not lacks_states(episode):
        return UsageError(
            f"{told}Render them from the recorded states: mjhab replay {episode.shard.path} --render depth "
            f"--camera-size {size} --cameras {cameras} --out FILE.h5"
        )
    told += "It was imported from data without states, so its images cannot be rendered again; "
    if have and have[0] == have[1]:
        return UsageError(
            f"{told}train with images of its size: --set inputs.image_size={have[0]}"
        )
    with_depth = sorted(
        {camera for camera, output in episode.images if output == "depth"}
    )
    return UsageError(
        f"{told}train with the cameras it has depth of ({', '.join(with_depth) or 'none'}): --set inputs.cameras=..."
    )
