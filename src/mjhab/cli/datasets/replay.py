"""``mjhab replay``: verify that the simulator reproduces recorded episodes, or render recorded states."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from mjhab.cli.datasets.data import read_filter
from mjhab.cli.options.datasets.generate import ReplayOptions
from mjhab.cli.output import at_least, print_json, print_table
from mjhab.core.errors import UsageError
from mjhab.core.files.outputs import check_file
from mjhab.core.progress import progress_bar
from mjhab.data.record.replay import FOLLOW, RenderRequest, render, verify
from mjhab.data.record.worlds import RecordedEnv
from mjhab.data.store.episode_data import RunInfo
from mjhab.data.store.images import ImageFormat
from mjhab.data.store.places import shard_paths
from mjhab.data.store.reading import open_shard
from mjhab.evaluation.recorded import recorded_env

_MOST_ROWS = 20


def run_replay(options: ReplayOptions) -> int:
    """Run the command; returns 0, or 1 if a replayed episode differs from its recording."""
    at_least("worlds", options.worlds, 1)
    at_least("threads", options.threads, 0)
    if options.verify == (options.render is not None):
        raise UsageError(
            "say what to do, one of the two: --verify, or --render depth (or rgb, rgbd, ...)."
        )
    return _verify(options) if options.verify else _render(options)


def _verify(options: ReplayOptions) -> int:
    where = read_filter(options.where, options.preset)
    with progress_bar("replaying", _count(options)) as advance:
        found = verify(options.places, _maker(options), where, advance)
    if options.json:
        error = found.max_error if math.isfinite(found.max_error) else None
        others = {"unlike": len(found.unlike), "moved": len(found.moved)}
        print_json(
            {
                "episodes": found.episodes,
                "exact": found.exact,
                "max_error": error,
                **others,
            }
        )
    else:
        if found.wrong:
            rows = [
                (name, "yes" if name in found.unlike else "", what)
                for name, what in found.wrong.items()
            ]
            print_table(
                "Not as recorded",
                ("episode", "other model", "what differs"),
                rows[:_MOST_ROWS],
            )
        print(
            f"{found.exact} of {found.episodes} episodes exact, largest difference {found.max_error:g}"
        )
        if found.moved:
            print(
                f"{len(found.moved)} of them have another start state here and were replayed from the recorded one."
            )
        if found.wrong and found.unlike:
            print(
                "Other model: the home compiles to another model here than when it was recorded, with another version "
                "of mjhab or of its assets (see `versions` and `commit` in the shard)."
            )
    return 0 if found.exact == found.episodes else 1


def _render(options: ReplayOptions) -> int:
    if options.out is None:
        raise UsageError(
            "--render needs --out FILE.h5: the recorded shard is not changed."
        )
    check_file(options.out, ".h5")
    if any(
        path.resolve() == options.out.resolve() for path in shard_paths(options.places)
    ):
        raise UsageError(
            f"--out {options.out} is one of the shards to replay; give a new file."
        )
    if len(options.camera_size) > 2:
        raise UsageError(
            f"--camera-size is one number or height and width, got {options.camera_size}."
        )
    if FOLLOW in (options.cameras or ()) and "rgb" not in (options.render or ""):
        raise UsageError(
            "the camera 'follow' gives colour only: add rgb to --render, as in --render rgb."
        )
    request = RenderRequest(
        options.places,
        options.out,
        ImageFormat(options.rgb),
        options.cameras,
        read_filter(options.where, options.preset),
    )
    with progress_bar("drawing", _count(options)) as advance:
        done = render(request, _maker(options), advance)
    if options.json:
        print_json(vars(done))
    else:
        print(
            f"{done.episodes} episodes, {done.frames} frames each camera and image, {done.bytes:,} bytes in "
            f"{options.out}; {done.present} were there already"
        )
    return 0


def _count(options: ReplayOptions) -> int:
    count = 0
    for path in shard_paths(options.places):
        with open_shard(path) as shard:
            count += len(shard)
    return count


def _maker(options: ReplayOptions) -> Callable[[RunInfo], RecordedEnv]:
    """Make a function that builds the environment of a recorded run with the cameras of the options."""
    # None stands for all cameras of the robot, which the environment knows.
    robot_cameras = None
    if options.cameras is not None:
        robot_cameras = tuple(name for name in options.cameras if name != FOLLOW)
    drawn = options.render if robot_cameras != () else "state"
    size = (
        options.camera_size[0]
        if len(options.camera_size) == 1
        else tuple(options.camera_size)
    )
    sight: dict[str, Any] = {"obs_mode": "state"}
    if options.render is not None:
        sight = {"obs_mode": drawn, "camera_size": size}
        if robot_cameras:
            sight["cameras"] = robot_cameras

    def make_env(run: RunInfo) -> RecordedEnv:
        return recorded_env(
            run, **sight, num_envs=options.worlds, threads=options.threads
        )

    return make_env
