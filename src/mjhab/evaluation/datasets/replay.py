"""Replay: verify that the simulator reproduces recorded episodes, or render recorded states.

`replay` is `mjhab.replay`; ``mjhab replay`` calls `run_verification` or `run_rendering`. All do the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, overload

from mjhab.core.errors import wrong_value
from mjhab.data.record.render import FOLLOW, Rendered, RenderRequest, render
from mjhab.data.record.verify import Verified, verify
from mjhab.data.record.worlds import RecordedEnv
from mjhab.data.store.episode_data import RunInfo
from mjhab.data.store.images import ImageFormat
from mjhab.data.store.places import shard_paths
from mjhab.evaluation.datasets.specs import PlacesLike, ReplaySpec
from mjhab.evaluation.recorded import recorded_env


@overload
def replay(path: PlacesLike, *, render: None = None, **options: Any) -> Verified: ...


@overload
def replay(path: PlacesLike, *, render: str, **options: Any) -> Rendered: ...


def replay(
    path: PlacesLike, *, render: str | None = None, **options: Any
) -> Verified | Rendered:
    """Simulate recorded actions again and compare every bit, or render recorded states, as ``mjhab replay`` does.

    >>> import mjhab
    >>> made = mjhab.generate("zero", subtask="close", episodes=1, horizon=5, out="runs/close")
    >>> found = mjhab.replay("runs/close", worlds=1)
    >>> found.episodes, found.exact, found.max_error
    (1, 1, 0.0)
    >>> done = mjhab.replay("runs/close", render="depth", camera_size=16, worlds=1, out="runs/close_depth.h5")
    >>> done.episodes, done.frames
    (1, 6)

    Args:
        path: a shard, a folder of shards, or several of them.
        render: images to draw of every state into the new shard ``out``, such as "rgbd"; None simulates the actions.
        **options: further fields of `ReplaySpec`.

    Returns:
        Without ``render``: how many episodes are exact, and what differs in the others. With it: how much was drawn.

    Raises:
        UsageError: an option is unknown or invalid, no episode passes the filter, or what the episodes were recorded
            with is missing.
        StorageError: the disk is full; the same call continues.
        DamagedError: an episode is damaged.
    """
    options = {"verify": render is None, **options}
    spec = ReplaySpec.of(path, render=render, **options)
    return run_verification(spec) if spec.verify else run_rendering(spec)


def run_verification(spec: ReplaySpec, tell: Callable[[], object] = bool) -> Verified:
    """Simulate recorded actions again and compare every state.

    Args:
        spec: the episodes.
        tell: called after every episode.

    Raises:
        UsageError, DamagedError: see `replay`.
    """
    return verify(spec.places, _maker(spec), spec.filter(), tell)


def run_rendering(spec: ReplaySpec, tell: Callable[[], object] = bool) -> Rendered:
    """Render recorded states into a new shard; episodes that it already has are skipped.

    Args:
        spec: the episodes, the images and the shard.
        tell: called after every episode.

    Raises:
        UsageError, StorageError, DamagedError: see `replay`.
    """
    # A specification with ``render`` has it.
    assert spec.out is not None
    if any(path.resolve() == spec.out.resolve() for path in shard_paths(spec.places)):
        raise wrong_value(
            "out", str(spec.out), "a new file, not one of the shards to replay"
        )
    request = RenderRequest(
        spec.places, spec.out, ImageFormat(spec.rgb), spec.cameras, spec.filter()
    )
    return render(request, _maker(spec), tell)


def _maker(spec: ReplaySpec) -> Callable[[RunInfo], RecordedEnv]:
    """Make a function that builds the environment of a recorded run with the cameras of the specification."""
    # None stands for all cameras of the robot, which the environment knows.
    robot_cameras = None
    if spec.cameras is not None:
        robot_cameras = tuple(name for name in spec.cameras if name != FOLLOW)
    sight: dict[str, Any] = {"obs_mode": "state"}
    if spec.render is not None:
        # With the following camera alone the robot's own need not be drawn.
        drawn = spec.render if robot_cameras != () else "state"
        sight = {
            "obs_mode": drawn,
            "camera_size": spec.asked.camera_size,
            "shader": spec.asked.shader,
            "shading": spec.asked.shading,
        }
        if robot_cameras:
            sight["cameras"] = robot_cameras

    def make_env(run: RunInfo) -> RecordedEnv:
        asked = spec.asked
        return recorded_env(run, **sight, num_envs=asked.num_envs, threads=asked.threads)

    return make_env
