"""Point clouds of recorded episodes, made of their colour and depth images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjhab.core.errors import UsageError, fault
from mjhab.core.joints import BASE, BASE_XY, BASE_YAW
from mjhab.core.seeding import stream
from mjhab.data.store.reading import RecordedEpisode

_POSE = "obs/sensor_param/{}/cam2world_gl"
_INTRINSIC = "obs/sensor_param/{}/intrinsic_cv"
_M_PER_MM = 1e-3
CHANNELS = ("x", "y", "z", "red", "green", "blue")
"""Columns of a cloud: position [m] in the frame of the robot's base link, colour in 0..1 (sRGB)."""


@dataclass(frozen=True)
class _Camera:
    """What a camera saw. pose: (N+1, 4, 4) in the world. intrinsic: (3, 3)."""

    name: str
    pose: np.ndarray
    intrinsic: np.ndarray


class Clouds:
    """Clouds of ``count`` points of an episode: pixels of all cameras that have colour and depth, drawn at random.

    The same pixels are drawn whenever the clouds of an episode are made in order. Where fewer pixels hit something than
    points are wanted, some are drawn again; where none does, all points are zero.

    Args:
        episode: with images, their cameras' poses, and states.
        count: number of points per state.
        base_height: of the robot's base link above the floor [m].

    Raises:
        UsageError: the episode lacks depth or colour images of a camera, its poses, or states.
    """

    def __init__(self, episode: RecordedEpisode, count: int, base_height: float) -> None:
        images = set(episode.images)
        names = [camera for camera, output in episode.images if output == "depth"]
        # Points have colours, so that a camera of depth alone gives none.
        names = [name for name in names if (name, "rgb") in images]
        paths = set(episode.paths)
        names = [name for name in names if _POSE.format(name) in paths]
        if not names:
            raise _lacking(episode)
        self._episode = episode
        self._count = count
        self._cameras = [
            _Camera(
                name,
                episode.array(_POSE.format(name)),
                # Cameras do not zoom: the matrix of every state is the same.
                episode.array(_INTRINSIC.format(name))[0],
            )
            for name in names
        ]
        columns = episode.run.layout["columns"]["robot_q"]
        self._base = episode.array("states/qpos")[
            :, [columns[k] for k in range(BASE.stop)]
        ]
        self._height = base_height
        record = episode.record
        # Named by the episode, so that an export draws the same points whoever makes it.
        self._random = stream(record.seed, "points", record.index)

    def at(self, t: int) -> np.ndarray:
        """The cloud of state ``t``, (count, 6) float32, see CHANNELS."""
        depths = [self._episode.frame(c.name, "depth", t)[..., 0] for c in self._cameras]
        # Depth 0 stands for no hit.
        hits = [np.flatnonzero(depth) for depth in depths]
        sizes = [len(hit) for hit in hits]
        total = int(np.sum(sizes))
        if not total:
            return np.zeros((self._count, len(CHANNELS)), np.float32)
        # Drawn over all cameras together, so that each pixel has the same chance.
        drawn = self._random.choice(total, self._count, replace=total < self._count)
        ends = np.cumsum(sizes)
        parts = [
            self._points(
                camera,
                t,
                depth,
                hit[drawn[(drawn >= end - len(hit)) & (drawn < end)] - end + len(hit)],
            )
            for camera, depth, hit, end in zip(
                self._cameras, depths, hits, ends, strict=True
            )
        ]
        return np.concatenate(parts).astype(np.float32)

    def _points(
        self, camera: _Camera, t: int, depth: np.ndarray, pixels: np.ndarray
    ) -> np.ndarray:
        """Points (n, 6) of some pixels (n,) of an image, counted along its rows."""
        v, u = np.divmod(pixels, depth.shape[1])
        (fx, _, cx), (_, fy, cy), _ = camera.intrinsic
        # Depth is along the optical axis and not along the ray.
        z = depth[v, u] * _M_PER_MM
        # Axes of the camera: x right, y up, z backwards.
        seen = np.stack(
            [(u + 0.5 - cx) / fx * z, (cy - v - 0.5) / fy * z, -z, np.ones_like(z)],
            axis=1,
        )
        world = (seen @ camera.pose[t].astype(np.float64).T)[:, :3]
        colour = self._episode.frame(camera.name, "rgb", t)[v, u] / 255.0
        return np.concatenate([self._in_base(world, t), colour], axis=1)

    def _in_base(self, world: np.ndarray, t: int) -> np.ndarray:
        x, y = self._base[t, BASE_XY]
        yaw = self._base[t, BASE_YAW]
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        # A row times the matrix is the inverse rotation.
        return (world - [x, y, self._height]) @ turn


def _lacking(episode: RecordedEpisode) -> UsageError:
    return fault(
        f"episode {episode.name} of {episode.shard.path}",
        "has no camera with colour, depth and poses, of which points are made; draw them: "
        "mjhab replay FILE --render rgbd --out FILE.h5",
    )
