"""The camera of films: a place from which hand and target are seen, kept while they are.

Places around the robot are judged by small depth images: a point is in sight if nothing nearer is drawn there. A camera
stands still and turns; it moves to another place, as a film cuts, when it lost sight of hand or target, when the robot
went away, or when another place is much better.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjhab.core.boxes import Boxes, sphere_box_distance
from mjhab.core.joints import BASE_XY, BASE_YAW
from mjhab.render.home_scene import HomeRenderer
from mjhab.render.pictures.viewpoint import Viewpoint, cameras_of
from mjhab.render.raster.rasterizer import FAST
from mjhab.scenes.spec import Home

RADII_M = (1.4, 1.9, 2.6)
HEIGHTS_M = (1.5, 2.1)
AZIMUTHS = 16
"""Candidates stand on rings around the middle of robot, hand and target."""
JUDGED = 30
"""Number of candidates that are drawn: those that promise most."""
JUDGED_SIZE = (96, 54)
"""Width and height of the images that candidates are judged by [px]."""
FOVY = 0.85
"""Vertical field of view [rad]."""
SPREAD_M = 0.04
"""Distance of the points that stand for hand and target from their middle [m]."""
AROUND_M = 0.2
"""Distance from the target of the points that stand for its surroundings [m]: a target that is seen through the gap of
a door is hardly seen."""
HIDDEN_M = 0.12
"""A point is hidden by what is drawn this much nearer: neither fingers around it nor its own object count."""
EYE_ROOM_M = 0.2
"""Distance of the camera from walls and tall furniture."""
FAR_TARGET_M = 2.2
"""A target farther than this from the hand need not be in sight: the robot is on its way."""
EYE_LEVEL_M = 1.0
"""Height of the point that stands for the robot [m]."""
IN_FRAME = 0.92
"""Share of half the image beyond which points count as outside of it."""
PAN = 0.12
"""Share of the way by which the camera turns towards what it should look at, per frame."""
HOLD_FRAMES = 30
"""Least number of frames between two cuts, unless nothing is in sight."""
JUDGE_EVERY = 5
"""Frames between two looks at whether hand and target are still in sight."""
LOST = 0.55
"""Share of hand and target in sight below which another place is looked for."""
BETTER = 0.6
"""How much better another place must be for a cut (of about 2.5)."""
AWAY_M = 4.0
"""Distance of the robot from the camera above which another place is looked for."""
JUMP_M = 0.5
"""A base that moves farther than this between two frames was teleported."""


class FilmedMoment(NamedTuple):
    """What a picture of a working robot should show.

    home: name. body_pos, body_mat: (B, 3) [m], (B, 3, 3) poses of all bodies. base: (3,) x, y [m], yaw [rad] of the
    robot. tcp, target: (3,) hand, and what is worked on, in the world [m].
    """

    home: str
    body_pos: np.ndarray
    body_mat: np.ndarray
    base: np.ndarray
    tcp: np.ndarray
    target: np.ndarray

    @property
    def points(self) -> np.ndarray:
        """(3, 3) hand, target and robot: what should be in sight."""
        robot = np.append(self.base[BASE_XY], EYE_LEVEL_M)
        # The hand stands for a far target, so that the weights stay what they are.
        near = np.linalg.norm(self.target - self.tcp) < FAR_TARGET_M
        return np.stack([self.tcp, self.target if near else self.tcp, robot])

    @property
    def middle(self) -> np.ndarray:
        """(3,) what the camera looks at."""
        return np.array([0.45, 0.3, 0.25]) @ self.points


class Setup(NamedTuple):
    """A place of the camera, and since how many frames it stands there. base: (3,) of the robot in the last frame."""

    view: Viewpoint
    frames: int
    base: np.ndarray
    cut: bool
    teleported: bool


class FilmCamera:
    """Choose places for pictures of robots at work.

    Args:
        renderer: of the layout.
    """

    def __init__(self, renderer: HomeRenderer) -> None:
        self._renderer = renderer
        self._homes = {home.name: home for home in renderer.layout.pack.homes}

    def follow(self, scene: FilmedMoment, last: Setup | None) -> Setup:
        """The camera of the next frame of a film.

        Args:
            scene: what it should show.
            last: the camera of the frame before; None for the first frame.
        """
        if last is None:
            return Setup(self.best(scene), 0, scene.base, True, False)
        moved = np.linalg.norm((scene.base - last.base)[BASE_XY])
        if moved > JUMP_M:
            return Setup(self.best(scene), 0, scene.base, True, True)
        # A share of the way: the camera follows smoothly and comes to rest.
        aim = last.view.target + PAN * (scene.middle - last.view.target)
        view = last.view._replace(target=aim)
        frames = last.frames + 1
        # Judging draws an image, and the scene changes little in a quarter of a second.
        if frames % JUDGE_EVERY == 0:
            away = np.linalg.norm((view.eye - scene.points[2])[:2]) > AWAY_M
            seen = self.sight(scene, [view])[0]
            lost = seen[[0, 1, 3]].mean() < LOST
            # Cuts in quick succession are hard to watch.
            if (away or lost) and (frames >= HOLD_FRAMES or not seen[:2].any()):
                found = self.best(scene)
                gain = self.worth(scene, [found])[0] - self.worth(scene, [view])[0]
                # Another place that is hardly better is not worth a cut.
                if away or gain > BETTER:
                    return Setup(found, 0, scene.base, True, False)
        return Setup(view, frames, scene.base, False, False)

    def best(self, scene: FilmedMoment) -> Viewpoint:
        """The place from which hand, target and robot are seen best."""
        views = self._candidates(scene)
        return views[int(np.argmax(self.worth(scene, views)))]

    def worth(self, scene: FilmedMoment, views: list[Viewpoint]) -> np.ndarray:
        """(n,) how good viewpoints are.

        1 for hand and target each, 0.4 for the robot, 0.8 for the surroundings of the target, and `_taste`.
        """
        seen = self.sight(scene, views)
        return seen @ np.array([1.0, 1.0, 0.4, 0.8]) + _taste(scene, views)

    def sight(self, scene: FilmedMoment, views: list[Viewpoint]) -> np.ndarray:
        """(n, 4) shares of hand, target, robot and surroundings of the target in sight, by depth images drawn there."""
        width, height = JUDGED_SIZE
        depth = self._renderer.rasterizer.render(
            self._renderer.home_numbers([scene.home]),
            scene.body_pos[None],
            scene.body_mat[None],
            cameras_of(views, width, height),
            ("depth",),
            FAST,
        )["depth"][0]
        return np.array(
            [
                np.append(
                    shares_in_sight(view, image, scene.points),
                    shares_in_sight(view, image, scene.points[1:2], AROUND_M),
                )
                for view, image in zip(views, depth, strict=True)
            ]
        )

    def _candidates(self, scene: FilmedMoment) -> list[Viewpoint]:
        """Places to be judged: inside the home, clear of tall things, those that promise most first."""
        turns = scene.base[BASE_YAW] + np.arange(AZIMUTHS) * (2.0 * np.pi / AZIMUTHS)
        ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
        eyes = np.array(
            [
                np.append(scene.middle[:2] + radius * way, height)
                for radius in RADII_M
                for height in HEIGHTS_M
                for way in ring
            ]
        )
        tall = self._renderer.follow.tall(scene.home)
        keep = _inside(self._homes[scene.home], eyes) & _clear(eyes, scene.points, tall)
        found = [Viewpoint(eye, scene.middle, FOVY) for eye in eyes[keep]]
        found.append(self._over_shoulder(scene))
        order = np.argsort(-_taste(scene, found), kind="stable")
        # The place over the shoulder in any case: no other need be free.
        return [found[k] for k in order[:JUDGED].tolist()] + found[-1:]

    def _over_shoulder(self, scene: FilmedMoment) -> Viewpoint:
        """The place of the follow camera, which there always is."""
        eye, target = self._renderer.follow.look(scene.home, scene.base)
        return Viewpoint(eye, target, FOVY)


def _taste(scene: FilmedMoment, views: list[Viewpoint]) -> np.ndarray:
    """(n,) what is liked of viewpoints besides what they see: from the side of the robot, near, not steep."""
    eyes = np.stack([view.eye for view in views])
    to_eye = eyes - scene.middle
    away = np.linalg.norm(to_eye, axis=1)
    turn = np.arctan2(to_eye[:, 1], to_eye[:, 0]) - scene.base[BASE_YAW]
    side = np.abs(np.sin(turn))
    # Of the two sides of the hand the one ahead shows the face of things, the one behind the robot's back.
    ahead = np.cos(turn)
    steep = to_eye[:, 2] / away
    return (
        0.35 * side + 0.1 * ahead - 0.15 * np.abs(away - 1.9) - 0.3 * np.abs(steep - 0.35)
    )


def _inside(home: Home, eyes: np.ndarray) -> np.ndarray:
    """(n,) bool: places over the floor of a home."""
    x0, y0, x1, y1 = home.floor
    low, high = np.array([x0, y0]) + EYE_ROOM_M, np.array([x1, y1]) - EYE_ROOM_M
    return np.asarray(((eyes[:, :2] > low) & (eyes[:, :2] < high)).all(axis=1))


def _clear(eyes: np.ndarray, points: np.ndarray, tall: Boxes) -> np.ndarray:
    """(n,) bool: places with room around them and nothing tall on most of the way to the robot (row 2 of points)."""
    if not len(tall):
        return np.ones(len(eyes), bool)
    # A cheap test by boxes, before images are drawn.
    room = sphere_box_distance(eyes, tall).min(axis=1) > EYE_ROOM_M
    share = np.linspace(0.1, 0.7, 7)[:, None, None]
    way = (eyes + share * (points[2] - eyes)).reshape(-1, 3)
    free = (sphere_box_distance(way, tall) > 0.02).all(axis=1)
    return np.asarray(room & free.reshape(len(share), -1).all(axis=0))


def shares_in_sight(
    view: Viewpoint, depth: np.ndarray, points: np.ndarray, spread: float = SPREAD_M
) -> np.ndarray:
    """How much of some points is seen from a viewpoint.

    Args:
        view: the viewpoint.
        depth: (h, w) image from there [m], 0 where nothing is hit.
        points: (n, 3) in the world [m].
        spread: distance of four more points that stand for each, across the line of sight [m].

    Returns:
        (n,) shares 0..1 of the five points.
    """
    height, width = depth.shape
    mat = view.mat
    offsets = spread * np.array(
        [np.zeros(3), mat[:, 0], -mat[:, 0], mat[:, 1], -mat[:, 1]]
    )
    here = (points[:, None] + offsets - view.eye) @ mat
    far = -here[..., 2]
    focal = 0.5 * height / np.tan(0.5 * view.fovy)
    ahead = np.maximum(far, 1e-6)
    x = focal * here[..., 0] / ahead
    y = -focal * here[..., 1] / ahead
    inside = (
        (far > 0.1)
        & (np.abs(x) < IN_FRAME * width / 2)
        & (np.abs(y) < IN_FRAME * height / 2)
    )
    column = np.clip((x + width / 2).astype(int), 0, width - 1)
    row = np.clip((y + height / 2).astype(int), 0, height - 1)
    # 0 is the sky: nothing hides the point.
    drawn = depth[row, column]
    open_to = (drawn == 0.0) | (drawn > far - HIDDEN_M)
    return (inside & open_to).mean(axis=1)
