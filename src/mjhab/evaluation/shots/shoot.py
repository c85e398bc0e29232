"""Take pictures of episodes. `shot` is `mjhab.shot`; ``mjhab shot`` calls `run_shot`. Both do the same."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.boxes import sphere_box_distance
from mjhab.core.files.cache import write_atomic
from mjhab.core.joints import BASE
from mjhab.evaluation.shots.spec import FILM, PLAN, TOP, ShotSpec, check_step
from mjhab.evaluation.shots.takes import Take, open_take
from mjhab.render.film import FilmWriter
from mjhab.render.home_scene import HomeRenderer
from mjhab.render.pictures.captions import with_words
from mjhab.render.pictures.film_camera import FilmCamera, FilmedMoment, Setup
from mjhab.render.pictures.home_views import from_top
from mjhab.render.pictures.viewpoint import Viewpoint, cameras_of, plan_of
from mjhab.render.raster.rasterizer import FILM as FILM_QUALITY
from mjhab.render.raster.rasterizer import NICE
from mjhab.reports.contact_sheet import Tile, save_png
from mjhab.scenes.free_camera import free_camera

TURN_FPS = 20
TURN_FRAMES = 120
"""Frames per second, and frames of a turn around the target."""
TURN_RADIUS_M = 1.7
TURN_HEIGHT_M = 0.9
"""Distance of the turning camera from the middle, and its height above it [m]; nearer where walls are in its way."""
TURN_ROOM_M = 0.2
"""Distance of the turning camera from walls and tall furniture [m]."""
NEAREST_TURN_M = 0.7
SMOOTHED_FRAMES = 8
"""Frames before and after one whose distances its own does not exceed."""
SHEET_COLUMNS = 3


@dataclass(frozen=True, eq=False)
class TakenShot:
    """A picture of an episode.

    Attributes:
        image: (height, width, 3) uint8 sRGB; of a turntable its first frame.
        file: what was written; None if nothing was.
        seconds: how long drawing took, without opening the episode.
        home: name of the home.
        episode, step, steps: index of the episode, the control step, and how many the episode has.
        view: where the camera was; of a sheet in its first picture.
    """

    image: np.ndarray
    file: Path | None
    seconds: float
    home: str
    episode: int
    step: int
    steps: int
    view: Viewpoint

    def facts(self) -> dict[str, Any]:
        """All but the image, as JSON data."""
        height, width = self.image.shape[:2]
        return {
            "file": None if self.file is None else str(self.file),
            "seconds": self.seconds,
            "home": self.home,
            "episode": self.episode,
            "step": self.step,
            "steps": self.steps,
            "width": width,
            "height": height,
            "camera": [round(float(x), 3) for x in self.view.eye],
            "look_at": [round(float(x), 3) for x in self.view.target],
            "fov": round(float(np.degrees(self.view.fovy)), 2),
        }


def shot(place: str | PathLike[str], **options: Any) -> TakenShot:
    """Take a picture of an episode at one control step, as ``mjhab shot`` does.

    >>> import mjhab
    >>> made = mjhab.generate("zero", subtask="close", episodes=1, horizon=5, out="runs/close")
    >>> taken = mjhab.shot("runs/close", step=2, width=64, height=36)
    >>> taken.image.shape, taken.step, taken.steps
    ((36, 64, 3), 2, 5)

    Args:
        place: the folder of an evaluation, a shard or a folder of shards.
        **options: fields of `ShotSpec`; with ``out`` the picture is written, too.

    Returns:
        The picture, and where the camera was.

    Raises:
        UsageError: an option is unknown or invalid, or there is no such episode or step.
        DamagedError: the episode is damaged.
    """
    spec = ShotSpec.of(place=place, **options)
    return take_shot(spec, spec.out if not spec.turntable else spec.file)


def take_shot(spec: ShotSpec, file: Path | None) -> TakenShot:
    """Take the picture of a specification and write it to a file, if one is given.

    Raises:
        UsageError, DamagedError: see `shot`.
    """
    take = open_take(spec)
    try:
        return _taken(spec, take, file)
    finally:
        take.env.close()


def _taken(spec: ShotSpec, take: Take, file: Path | None) -> TakenShot:
    name = f"episode {spec.episode}"
    step = take.steps // 2 if spec.step is None else spec.step
    step = check_step(step, take.steps, name)
    studio = Studio(spec, take)
    begun = time.perf_counter()
    if spec.turntable:
        assert file is not None
        image, view = studio.turntable(step, file)
    elif spec.sheet:
        step = spec.step or 0
        image, view = studio.sheet(step, file)
    else:
        image, view = studio.still(step)
        if file is not None:
            _save(image, file)
    seconds = round(time.perf_counter() - begun, 2)
    return TakenShot(
        image, file, seconds, take.home, spec.episode, step, take.steps, view
    )


def _save(image: np.ndarray, file: Path) -> None:
    from PIL import Image

    # A viewer that watches the file never sees half of it.
    write_atomic(file, Image.fromarray(image).save)


class Studio:
    """Draws the states of an episode."""

    def __init__(self, spec: ShotSpec, take: Take) -> None:
        self._spec = spec
        self._take = take
        self._renderer: HomeRenderer = take.env.observer.renderer
        self._camera = FilmCamera(self._renderer)
        homes = {home.name: home for home in take.env.layout.pack.homes}
        self._home = homes[take.home]

    def still(self, step: int) -> tuple[np.ndarray, Viewpoint]:
        """The picture (height, width, 3) of a step, and where it was taken from."""
        scene = self._scene(step)
        view = self._view(scene)
        image = self._drawn(view, (self._spec.width, self._spec.height), NICE)
        words = self._take.sentences[step] if self._spec.caption else ""
        return with_words(image, words), view

    def sheet(self, first: int, file: Path | None) -> tuple[np.ndarray, Viewpoint]:
        """A sheet of pictures of steps from the first to the last of the episode."""
        import io

        from PIL import Image

        columns = min(SHEET_COLUMNS, self._spec.sheet, self._take.steps - first + 1)
        size = (
            max(16, self._spec.width // columns),
            max(16, self._spec.height // columns),
        )
        tiles = []
        views = []
        for step, image, view in self.stills(first, self._spec.sheet, size):
            views.append(view)
            tiles.append(Tile(f"step {step}", "", self._take.sentences[step], image))
        save = _sheet_writer(self._take.title, tiles)
        if file is not None:
            write_atomic(file, save)
            return np.asarray(Image.open(file).convert("RGB")), views[0]
        buffer = io.BytesIO()
        save(buffer)
        return np.asarray(Image.open(buffer).convert("RGB")), views[0]

    def stills(
        self, first: int, count: int, size: tuple[int, int]
    ) -> Iterator[tuple[int, np.ndarray, Viewpoint]]:
        """Pictures (height, width, 3) of ``count`` steps from ``first`` to the last, by a camera that follows.

        Yields:
            The step, its picture, and where it was taken from; fewer of a short episode, every step once.
        """
        steps = np.linspace(first, self._take.steps, count).round().astype(int)
        last: Setup | None = None
        # A short episode has fewer steps than were asked for.
        for step in np.unique(steps).tolist():
            scene = self._scene(step)
            view = self._view(scene)
            if self._spec.view == FILM and self._spec.camera is None:
                last = self._camera.follow(scene, last)
                view = last.view
            yield step, self._drawn(view, size, NICE), view

    def turntable(self, step: int, file: Path) -> tuple[np.ndarray, Viewpoint]:
        """Write a film around hand and target at a step; returns its first frame."""
        scene = self._scene(step)
        views = self._around(scene)
        first: np.ndarray | None = None
        words = self._take.sentences[step] if self._spec.caption else ""
        size = (self._spec.width, self._spec.height)
        with FilmWriter(file, TURN_FPS) as film:
            for view in views:
                image = with_words(self._drawn(view, size, FILM_QUALITY), words)
                # A film may be long, so that its other frames are not kept.
                first = image if first is None else first
                film.add(image)
        assert first is not None
        return first, views[0]

    def _drawn(self, view: Viewpoint, size: tuple[int, int], quality: Any) -> np.ndarray:
        state = self._take.env.sim.state()
        cameras = cameras_of([view], *size)
        return self._renderer.picture(state, 0, self._take.home, cameras, quality)[0]

    def _scene(self, step: int) -> FilmedMoment:
        """Put the world into the state of a step, and tell what a picture of it should show."""
        env = self._take.env
        env.sim.reset([0], [self._take.home], self._take.qpos[[step]])
        state = env.sim.state()
        tcp = env.sensing.tcp_pose(state)[0, :3]
        target = self._take.targets[step]
        return FilmedMoment(
            self._take.home,
            state.body_pos[0].copy(),
            state.body_mat[0].copy(),
            state.robot_q[0, BASE].copy(),
            tcp,
            # Subtasks without a target, such as Navigate, have none in their state.
            target if np.isfinite(target).all() else tcp,
        )

    def _view(self, scene: FilmedMoment) -> Viewpoint:
        spec = self._spec
        free = free_camera(spec.camera, spec.look_at, spec.fov)
        if free is not None:
            target = free.target if np.isfinite(free.target).all() else scene.middle
            return Viewpoint(free.eye, target, free.fovy)
        if spec.view == TOP:
            return from_top(self._home, spec.width, spec.height)
        if spec.view == PLAN:
            return plan_of(self._home, spec.width, spec.height)
        if spec.view == FILM:
            return self._camera.best(scene)
        return self._robot_view(spec.view)

    def _robot_view(self, camera: str) -> Viewpoint:
        """The place of a camera of the robot."""
        pos, mat = self._renderer.camera_poses(self._take.env.sim.state(), [camera])
        fovy = float(self._renderer.fields_of_view([camera])[0])
        # Cameras of MuJoCo look along their -z.
        return Viewpoint(pos[0, 0], pos[0, 0] - mat[0, 0, :, 2], fovy, mat[0, 0, :, 1])

    def _around(self, scene: FilmedMoment) -> Sequence[Viewpoint]:
        """Places of a camera that turns around hand and target, nearer where walls are in its way."""
        tall = self._renderer.follow.tall(scene.home)
        x0, y0, x1, y1 = self._home.floor
        start = self._camera.best(scene).eye - scene.middle
        # Begins where the film camera would stand, from where hand and target are in sight.
        turns = np.arctan2(start[1], start[0]) + np.linspace(
            0.0, 2.0 * np.pi, TURN_FRAMES, endpoint=False
        )
        ways = np.stack([np.cos(turns), np.sin(turns)], axis=1)
        radii = np.linspace(NEAREST_TURN_M, TURN_RADIUS_M, 11)
        eyes = scene.middle + np.concatenate(
            [
                radii[None, :, None] * ways[:, None],
                np.full((TURN_FRAMES, len(radii), 1), TURN_HEIGHT_M),
            ],
            axis=2,
        )
        low, high = np.array([x0, y0]) + TURN_ROOM_M, np.array([x1, y1]) - TURN_ROOM_M
        free = ((eyes[..., :2] > low) & (eyes[..., :2] < high)).all(axis=2)
        if len(tall):
            near = sphere_box_distance(eyes.reshape(-1, 3), tall).min(axis=1)
            free &= (near > TURN_ROOM_M).reshape(free.shape)
        reach = radii[
            # The farthest radius up to which all nearer ones are free: the camera must not stand behind a wall.
            np.maximum(np.logical_and.accumulate(free, axis=1).sum(axis=1) - 1, 0)
        ]
        smooth = _smoothed(reach)
        return [
            Viewpoint(
                scene.middle + np.append(r * way, TURN_HEIGHT_M), scene.middle, self._fovy
            )
            for r, way in zip(smooth, ways, strict=True)
        ]

    @property
    def _fovy(self) -> float:
        return float(np.radians(self._spec.fov))


def _smoothed(values: np.ndarray) -> np.ndarray:
    """Values (n,) around a circle: the least of neighbours, then their mean, so that none is above its own."""
    least = _around_each(values).min(axis=1)
    return _around_each(least).mean(axis=1)


def _around_each(values: np.ndarray) -> np.ndarray:
    """(n, m) the neighbours of every value (n,) around a circle, itself among them."""
    padded = np.pad(values, SMOOTHED_FRAMES, mode="wrap")
    return np.lib.stride_tricks.sliding_window_view(padded, 2 * SMOOTHED_FRAMES + 1)


def _sheet_writer(title: str, tiles: Sequence[Tile]) -> Any:
    return lambda where: save_png(where, title, tiles)
