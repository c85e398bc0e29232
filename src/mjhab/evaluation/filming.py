"""Films of evaluations: the camera, the sentence of the subtask below, teleports marked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mjhab.core.joints import BASE
from mjhab.experts.gaze import worked_on

if TYPE_CHECKING:
    from mjhab.envs.sequential import SequentialTaskEnv
    from mjhab.render.pictures.film_camera import FilmCamera, FilmedMoment, Setup

MARKED_FRAMES = 15
"""Number of frames that say that the robot was teleported."""
TELEPORT = "teleport"


def scene_of(env: SequentialTaskEnv, world: int) -> FilmedMoment:
    """What a picture of a world should show."""
    from mjhab.render.pictures.film_camera import FilmedMoment  # loads numba

    view = env.view(world)
    tcp = view.tcp_pose[:3]
    target = worked_on(view)
    return FilmedMoment(
        env.homes[world],
        env.state.body_pos[world].copy(),
        env.state.body_mat[world].copy(),
        env.state.robot_q[world, BASE].copy(),
        tcp,
        tcp if target is None else target,
    )


class FilmCrew:
    """Shoots films of an evaluation, see `rollout.films.Crew`.

    Args:
        width, height: of the frames [px].
    """

    def __init__(self, width: int, height: int) -> None:
        self._size = (width, height)
        self._camera: FilmCamera | None = None
        self._last: dict[int, Setup] = {}
        self._marked: dict[int, int] = {}

    def begin(self, world: int) -> None:
        """A new film begins in a world."""
        # The camera must not glide from the home of the episode before.
        self._last.pop(world, None)
        self._marked.pop(world, None)

    def shoot(
        self, env: SequentialTaskEnv, worlds: Sequence[int], info: Mapping[str, Any]
    ) -> list[np.ndarray]:
        """Frames (n, height, width, 3) uint8 sRGB; of several worlds they are drawn at the same time."""
        from mjhab.render.home_scene import is_sane
        from mjhab.render.pictures.captions import with_words
        from mjhab.render.pictures.viewpoint import one_camera_each

        width, height = self._size
        frames = dict.fromkeys(worlds, np.zeros((height, width, 3), np.uint8))
        state = env.state
        sane = is_sane(state.body_pos, state.body_mat)
        # A simulation that diverged has positions that cannot be drawn; the film goes on in black.
        drawn = [world for world in worlds if sane[world]]
        if drawn:
            shots = [self._follow(env, world) for world in drawn]
            pictures = env.observer.renderer.pictures(
                state,
                drawn,
                [env.homes[world] for world in drawn],
                one_camera_each([shot.view for shot in shots], width, height),
            )
            for world, picture in zip(drawn, pictures[:, 0], strict=True):
                sentence = str(info["instruction"][world])
                frames[world] = with_words(picture, sentence, self._mark(world))
        return list(frames.values())

    def _follow(self, env: SequentialTaskEnv, world: int) -> Setup:
        """Where the camera of a world stands now."""
        from mjhab.render.pictures.film_camera import FilmCamera

        # Made with the first frame, because a run without films needs none.
        if self._camera is None:
            self._camera = FilmCamera(env.observer.renderer)
        shot = self._camera.follow(scene_of(env, world), self._last.get(world))
        self._last[world] = shot
        if shot.teleported:
            self._marked[world] = MARKED_FRAMES
        return shot

    def _mark(self, world: int) -> str:
        """What marks the next frame of a world, "" for nothing."""
        left = self._marked.get(world, 0)
        self._marked[world] = left - 1
        return TELEPORT if left > 0 else ""
