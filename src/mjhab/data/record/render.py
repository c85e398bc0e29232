"""Rendering: images of recorded states, drawn without simulation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.conventions.images import RGB, TARGET_OUTPUTS
from mjhab.core.errors import UsageError, fault, wrong_value
from mjhab.core.version import __version__
from mjhab.data.record.batches import MakeEnv, batches
from mjhab.data.record.provenance import describe_views
from mjhab.data.record.targets import targets_in_base
from mjhab.data.record.worlds import RecordedEnv
from mjhab.data.select.query import Filter
from mjhab.data.select.sets import check_outside
from mjhab.data.store.damage import refuse_damage
from mjhab.data.store.episode_data import EpisodeData
from mjhab.data.store.episode_files import part_folder
from mjhab.data.store.images import ImageFormat, encode, stored_frames
from mjhab.data.store.places import entries
from mjhab.data.store.reading import RecordedEpisode, open_shard
from mjhab.data.store.schema import DamagedError
from mjhab.data.store.shard import ShardWriter

FOLLOW = "follow"
"""Name of a camera that follows the robot from behind."""
_IMAGE = "sensor_data/"


@dataclass(frozen=True)
class Rendered:
    """Result of ``render``. present: number of episodes that the shard already had."""

    episodes: int
    frames: int
    bytes: int
    present: int


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
        # A request that is refused at its first episode leaves no file behind.
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
    # Read before the writer locks and changes the file.
    before = _rendered_options(out)
    with ShardWriter(out) as writer:
        for env, batch in batches(request.places, make_env, request.where):
            for episode in batch:
                # The shard is replaced at the end, so that its own episodes would be lost.
                if episode.shard.path.resolve() == out.resolve():
                    raise wrong_value(
                        "out", str(out), "a new file, not one of the shards to replay"
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
    # A killed call has left parts and no shard yet.
    if not shard.exists() and not part_folder(shard).is_dir():
        return {}
    return {
        episode.name: episode.run.options.get("rendered", {})
        for episode in entries(shard)
    }


def _view_options(env: RecordedEnv, cameras: Sequence[str]) -> dict[str, Any]:
    """Options that determine the rendered images, as JSON data."""
    shading = env.observer.shading
    return {
        "obs_mode": "+".join(env.observer.outputs) or "state",
        "cameras": list(cameras),
        "camera_size": list(env.observer.size),
        # Of the rasterizer nothing is said, as in shards of before.
        **({} if shading is None else {"shading": dataclasses.asdict(shading)}),
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
        raise fault(
            out,
            f"has episodes with other images (their {', '.join(other)}); give the options that it was made "
            "with, or a new file as --out.",
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
    looks = {*TARGET_OUTPUTS} & {*env.observer.outputs}
    target = targets_in_base(episode) if looks else None
    for start in range(0, len(qpos), env.num_envs):
        # The last batch repeats its last state to fill all worlds.
        steps = np.minimum(np.arange(start, start + env.num_envs), len(qpos) - 1)
        worlds = list(range(min(env.num_envs, len(qpos) - start)))
        # Images depend on positions only, so the worlds are set to the states and not stepped.
        env.sim.reset(range(env.num_envs), [home] * env.num_envs, qpos[steps])
        state = env.sim.state()
        drawn = {}
        if env.observer.outputs:
            seen = None if target is None else target[steps]
            asked = (state, [home] * env.num_envs, seen)
            drawn = env.observer.draw(*asked, *_moments(env, episode, steps))
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
                files.setdefault(f"{FOLLOW}/{RGB}", []).append(
                    encode(picture, RGB, images)
                )
    arrays = {path: np.stack(values) for path, values in rows.items()}
    return arrays | stored_frames(files)


def _moments(
    env: RecordedEnv, episode: RecordedEpisode, steps: np.ndarray
) -> tuple[Any, ...]:
    """When states of an episode were seen, where something perturbed what was seen; else nothing."""
    record = episode.record
    perturber = env.observer.perturber if record.perturbation else None
    if perturber is None:
        return ()
    # Perturbations are drawn from the identity of the episode, so that they come out as recorded.
    first = perturber.moment(record.seed, record.index, 0)
    return ([first._replace(step=int(step)) for step in steps],)


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
        # The new calibration of a camera tells one size for all its outputs.
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
