"""Replay: check that the recorded actions reproduce the recorded states bit by bit; render recorded states."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.errors import UsageError
from mjhab.core.files.reading import reason
from mjhab.core.version import __version__
from mjhab.data.record.provenance import describe_views, model_hash
from mjhab.data.record.worlds import RecordedEnv
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import check_outside, nothing_passes
from mjhab.data.store.damage import refuse_damage
from mjhab.data.store.episode_data import EpisodeData, RunInfo
from mjhab.data.store.images import ImageFormat, encode
from mjhab.data.store.places import shard_paths
from mjhab.data.store.reading import UNREADABLE, RecordedEpisode, open_shard
from mjhab.data.store.schema import DamagedError
from mjhab.data.store.shard import ShardWriter

FOLLOW = "follow"
"""Name of a camera that follows the robot from behind."""
_IMAGE = "sensor_data/"
MakeEnv = Callable[[RunInfo], RecordedEnv]
"""Makes an environment (autoreset "disabled") equal to the one that a run was recorded in."""


@dataclass
class Verified:
    """Result of ``verify``.

    exact: number of bit-exact episodes. max_error: largest difference of a position or velocity [m, rad, m/s, rad/s];
    infinite if a value is NaN. wrong: the difference, by episode. unlike: episodes whose home compiles to another
    model here. moved: episodes whose start state differs here; they were replayed from the recorded first state.
    """

    episodes: int = 0
    exact: int = 0
    max_error: float = 0.0
    wrong: dict[str, str] = field(default_factory=dict)
    unlike: list[str] = field(default_factory=list)
    moved: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Rendered:
    """Result of ``render``. present: number of episodes that the shard already had."""

    episodes: int
    frames: int
    bytes: int
    present: int


def verify(
    places: Path | Sequence[Path],
    make_env: MakeEnv,
    where: Filter | None = None,
    tell: Callable[[], object] = bool,
) -> Verified:
    """Simulate recorded actions again and compare positions and velocities of every state, bit by bit.

    Episodes without states are only compared in the last state, by the hash in their record.

    Args:
        places: shards, or folders of shards. where: filter on the episodes.
        make_env: called once for every config.
        tell: called after every episode.

    Raises:
        UsageError: no episode passes the filter.
        UsageError, DamagedError: see ``open_shard``.
    """
    found = Verified()
    for env, batch in _batches(places, make_env, where):
        for episode, problem, error, moved in _verify_batch(env, batch):
            found.episodes += 1
            found.exact += not problem
            found.max_error = max(found.max_error, error)
            if problem:
                found.wrong[episode.name] = problem
            if moved:
                found.moved.append(episode.name)
            if (
                model_hash(env.sim.model(episode.record.home))
                != episode.attributes["model"]
            ):
                found.unlike.append(episode.name)
            tell()
    return found


def _batches(
    places: Path | Sequence[Path], make_env: MakeEnv, where: Filter | None
) -> Iterator[tuple[RecordedEnv, list[RecordedEpisode]]]:
    """Batches of an environment and episodes of one shard and config, at most as many as it has worlds.

    Raises:
        UsageError: no episode passes the filter.
    """
    envs: dict[str, RecordedEnv] = {}
    for path in shard_paths(places):
        # Episodes are read faster while their shard is open.
        with open_shard(path) as shard:
            groups: dict[str, list[RecordedEpisode]] = defaultdict(list)
            for episode in shard:
                if where is None or where(episode.record, episode.run):
                    groups[episode.run.config_id].append(episode)
            for name, members in groups.items():
                require_states(members)
                if name not in envs:
                    envs[name] = make_env(members[0].run)
                worlds = envs[name].num_envs
                for start in range(0, len(members), worlds):
                    yield envs[name], members[start : start + worlds]
    if not envs:
        raise nothing_passes()


def require_states(members: Sequence[RecordedEpisode]) -> None:
    """Refuse imported episodes, which mjhab did not simulate.

    Raises:
        UsageError: the source of an episode had no states.
    """
    for episode in members:
        if "states/initial" in episode.run.absent:
            raise UsageError(
                f"episode {episode.name} of {episode.shard.path} was imported from data without states, so it can "
                'neither be simulated again nor rendered; leave it out with a filter such as --where "policy == '
                "'expert'\"."
            )


class _Comparison:
    """Comparison of one episode's states during a replay."""

    def __init__(self, episode: RecordedEpisode) -> None:
        self.actions = episode.array("actions")
        self.final = episode.record.final_state
        self.first = episode.initial()["sim"]
        self.states = None
        if "states/qpos" in episode.paths and "states/qvel" in episode.paths:
            self.states = episode.array("states/qpos"), episode.array("states/qvel")
        self.problem = ""
        self.error = 0.0

    @property
    def steps(self) -> int:
        return len(self.actions)

    def refuse_other_shapes(self, episode: RecordedEpisode, width: int) -> None:
        """Refuse actions that are not (N, ``width``), and states that are not N+1 rows.

        Raises:
            DamagedError: names the episode.
        """
        rows = [len(values) for values in self.states or ()]
        if self.actions.shape != (self.steps, width) or set(rows) - {self.steps + 1}:
            raise DamagedError(
                f"episode {episode.name} of {episode.shard.path} has actions {self.actions.shape} and {rows} states; "
                f"its environment takes actions (N, {width}), and N of them lead to N+1 states. See what is wrong "
                f"with: mjhab data check {episode.shard.path}"
            )

    def begins_with(self, state: Mapping[str, np.ndarray]) -> bool:
        """Whether a state equals the recorded first state."""
        return all(_same_bits(state[name], self.first[name]) for name in ("qpos", "qvel"))

    def compare(self, t: int, state: Mapping[str, np.ndarray], digest: str) -> None:
        """Compare state ``t``."""
        if t == self.steps and digest != self.final and not self.problem:
            self.problem = "the last state is another one"
        if self.states is None:
            return
        for name, rows in zip(("qpos", "qvel"), self.states, strict=True):
            if _same_bits(state[name], rows[t]):
                continue
            if not self.problem or self.problem.startswith("the last"):
                self.problem = f"{name} differs from state {t} of {self.steps} on"
            with np.errstate(invalid="ignore"):
                error = (
                    float(np.abs(state[name] - rows[t]).max())
                    if state[name].shape == rows[t].shape
                    else np.inf
                )
            self.error = max(self.error, error if np.isfinite(error) else np.inf)


def _same_bits(a: np.ndarray, b: np.ndarray) -> bool:
    return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


def _verify_batch(
    env: RecordedEnv, batch: list[RecordedEpisode]
) -> list[tuple[RecordedEpisode, str, float, bool]]:
    """Replay at most W episodes of one config.

    Returns:
        Per episode: itself, what is wrong ("" if nothing), the largest difference, and whether its start state differs.
    """
    compared = [_Comparison(episode) for episode in batch]
    for episode, one in zip(batch, compared, strict=True):
        one.refuse_other_shapes(episode, len(env.action_table))
    moved = _begin(env, batch, compared)
    longest = max(one.steps for one in compared)
    actions = np.zeros((env.num_envs, compared[0].actions.shape[1]), np.float32)
    for t in range(longest + 1):
        for world, one in enumerate(compared):
            if t <= one.steps:
                one.compare(t, env.sim.get_world(world), env.state_digest(world))
        if t < longest:
            for world, one in enumerate(compared):
                actions[world] = one.actions[t] if t < one.steps else 0.0
            env.step(actions)
    return [
        (episode, one.problem, one.error, other)
        for episode, one, other in zip(batch, compared, moved, strict=True)
    ]


def _begin(
    env: RecordedEnv, batch: list[RecordedEpisode], compared: list[_Comparison]
) -> list[bool]:
    """Reset worlds to episodes; where the start state differs, set the recorded one. Returns which ones differed."""
    mask = np.arange(env.num_envs) < len(batch)
    seeds = [episode.record.seed for episode in batch] + [None] * (
        env.num_envs - len(batch)
    )
    indices = np.array([episode.record.index for episode in batch])
    env.reset(seed=seeds, options={"episode": indices, "reset_mask": mask})
    moved = [
        not one.begins_with(env.sim.get_world(world))
        for world, one in enumerate(compared)
    ]
    for world, (episode, one) in enumerate(zip(batch, compared, strict=True)):
        if moved[world]:
            try:
                env.set_state(world, episode.initial())
            except (UsageError, *UNREADABLE) as error:
                one.problem = f"it cannot begin here: {reason(error)}"
    return moved


@dataclass(frozen=True)
class RenderRequest:
    """Episodes to render, and the shard to write.

    places: shards, or folders of shards. out: the shard to make or to continue. images: format of colour images.
    cameras: names of cameras, FOLLOW may be among them; None takes all cameras of the robot. where: filter on the
    episodes.
    """

    places: Path | Sequence[Path]
    out: Path
    images: ImageFormat
    cameras: Sequence[str] | None = None
    where: Filter | None = None


def render(
    request: RenderRequest, make_env: MakeEnv, tell: Callable[[], object] = bool
) -> Rendered:
    """Render images of recorded states into a new shard, without simulation. Episodes that it already has are skipped.

    All recorded data are copied, except images that are rendered again.

    Args:
        request: the episodes and the shard.
        make_env: its ``observer`` determines the images (obs_mode, cameras, camera_size).
        tell: called after every episode.

    Raises:
        UsageError: no episode passes the filter; an episode has no states; ``out`` is or lies in one of the places, or
            has an episode with other images. A new shard is deleted if nothing was drawn.
    """
    check_outside(request.places, request.out)
    is_new = not request.out.exists()
    try:
        return _render(request, make_env, tell)
    except UsageError:
        if is_new and _is_empty(request.out):
            request.out.unlink()
        raise


def _is_empty(shard: Path) -> bool:
    """Whether a file is a shard without episodes."""
    if not shard.is_file():
        return False
    with open_shard(shard) as opened:
        return len(opened) == 0


def _render(
    request: RenderRequest, make_env: MakeEnv, tell: Callable[[], object]
) -> Rendered:
    written = frames = size = present = 0
    out = request.out
    follow = FOLLOW in (request.cameras or ())
    before = _rendered_options(out)
    with ShardWriter(out) as writer:
        for env, batch in _batches(request.places, make_env, request.where):
            for episode in batch:
                if episode.shard.path.resolve() == out.resolve():
                    raise UsageError(
                        f"--out {out} is one of the shards to replay; give a new file."
                    )
                cameras = (
                    env.observer.cameras if request.cameras is None else request.cameras
                )
                if episode.name in writer.names:
                    wanted = _view_options(env, cameras)
                    _refuse_others(out, before.get(episode.name, wanted), wanted)
                    present += 1
                else:
                    drawn = _draw(env, episode, follow, request.images)
                    size += writer.append(_with_images(episode, drawn, env, cameras))
                    written += 1
                    frames = frames + episode.steps + 1
                tell()
    return Rendered(written, frames, size, present)


def _rendered_options(shard: Path) -> dict[str, Mapping[str, Any]]:
    """How the images of every episode of a shard were rendered; empty if they were not, or there is no shard."""
    if not shard.exists():
        return {}
    with open_shard(shard) as opened:
        return {
            episode.name: episode.run.options.get("rendered", {}) for episode in opened
        }


def _view_options(env: RecordedEnv, cameras: Sequence[str]) -> dict[str, Any]:
    """Options that determine the rendered images, as JSON data."""
    return {
        "obs_mode": "+".join(env.observer.outputs) or "state",
        "cameras": list(cameras),
        "camera_size": list(env.observer.size),
    }


def _refuse_others(
    out: Path, rendered: Mapping[str, Any], wanted: Mapping[str, Any]
) -> None:
    """Refuse to continue a shard whose images were rendered otherwise.

    Raises:
        UsageError: names the options that differ.
    """
    other = [name for name in wanted if rendered.get(name) != wanted[name]]
    if other:
        raise UsageError(
            f"{out} has episodes with other images (their {', '.join(other)}); give the options that it was made "
            "with, or a new file as --out."
        )


def _draw(
    env: RecordedEnv, episode: RecordedEpisode, follow: bool, images: ImageFormat
) -> dict[str, np.ndarray]:
    """Datasets of an episode's images and of observations that the observer derives from them, by path."""
    refuse_damage(episode)
    qpos = episode.array("states/qpos")
    width = len(env.sim.get_world(0)["qpos"])
    if qpos.shape[1] != width:
        raise DamagedError(
            f"episode {episode.name} of {episode.shard.path} has {qpos.shape[1]} positions in a state, and its "
            f"environment has {width} here."
        )
    home = episode.record.home
    files: dict[str, list[bytes]] = {}
    rows: dict[str, list[np.ndarray]] = {}
    side = env.observer.size
    for start in range(0, len(qpos), env.num_envs):
        part = qpos[start : start + env.num_envs]
        worlds = list(range(len(part)))
        # Images depend on positions only, so the worlds are set to the states and not stepped.
        padded = np.concatenate(
            [part, np.repeat(part[-1:], env.num_envs - len(part), axis=0)]
        )
        env.sim.reset(range(env.num_envs), [home] * env.num_envs, padded)
        state = env.sim.state()
        drawn = (
            env.observer.draw(state, [home] * env.num_envs)
            if env.observer.outputs
            else {}
        )
        for w in worlds:
            for key, values in drawn.items():
                if key.startswith(_IMAGE):
                    output = key.rpartition("/")[2]
                    files.setdefault(key.removeprefix(_IMAGE), []).append(
                        encode(values[w], output, images)
                    )
                else:
                    rows.setdefault(f"obs/{key}", []).append(values[w].copy())
            if follow:
                picture = env.observer.renderer.follow_view(
                    state, home, w, side[1], side[0]
                )
                files.setdefault(f"{FOLLOW}/rgb", []).append(
                    encode(picture, "rgb", images)
                )
    arrays = {path: np.stack(values) for path, values in rows.items()}
    for key, parts in files.items():
        arrays[f"images/{key}/bytes"] = np.frombuffer(b"".join(parts), np.uint8)
        arrays[f"images/{key}/ends"] = np.cumsum(
            [len(part) for part in parts], dtype=np.int64
        )
    return arrays


def _with_images(
    episode: RecordedEpisode,
    drawn: dict[str, np.ndarray],
    env: RecordedEnv,
    cameras: Sequence[str],
) -> EpisodeData:
    """The episode with new images; its run describes them and the version that rendered them."""
    # As they are stored: the new shard names the schema of the old one.
    stored, _ = episode.contents()
    arrays = {path: values for path, values in stored.items() if path != "record"}
    size = tuple(env.observer.size)
    for camera, output in episode.images:
        if camera in cameras and episode.frame(camera, output, 0).shape[:2] != size:
            arrays = {
                path: a
                for path, a in arrays.items()
                if not path.startswith(f"images/{camera}/{output}/")
            }
    arrays |= drawn
    columns = {path: _columns(episode, path) for path in arrays if path in episode.paths}
    rendered = {**_view_options(env, cameras), "mjhab": __version__}
    options = {**episode.run.options, "rendered": rendered}
    layout = {**episode.run.layout, **describe_views(env.observer)}
    if "cameras" in episode.run.layout:
        # Cameras whose images are kept keep their calibration.
        layout["cameras"] = {**episode.run.layout["cameras"], **layout["cameras"]}
    run = dataclasses.replace(episode.run, options=options, layout=layout)
    attributes = episode.attributes
    try:
        return EpisodeData(
            episode.record,
            run,
            str(attributes["model"]),
            str(attributes["ending"]),
            arrays,
            {path: names for path, names in columns.items() if names},
            episode.actors,
            episode.schema,
        )
    except ValueError as error:
        raise DamagedError(f"{episode.shard.path}: {error}") from error


def _columns(episode: RecordedEpisode, path: str) -> tuple[str, ...]:
    return tuple(
        f"{name}:{width}" if width else name
        for name, width in episode.columns(path).items()
    )
