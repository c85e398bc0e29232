"""The camera of films keeps hand and target in sight; ceilings and captions are in pictures for people alone."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

import mjhab
from mjhab.core.joints import BASE_XY, BASE_YAW
from mjhab.envs.sequential import SequentialTaskEnv
from mjhab.evaluation.filming import scene_of
from mjhab.render.pictures.captions import with_words
from mjhab.render.pictures.film_camera import FilmCamera, FilmedMoment
from mjhab.render.pictures.home_views import from_inside
from mjhab.render.pictures.viewpoint import Viewpoint, cameras_of, plan_of
from mjhab.render.raster.rasterizer import FAST, FILM


@pytest.fixture(scope="module")
def env() -> Iterator[SequentialTaskEnv]:
    env = mjhab.make(
        task="set_table",
        subtask="pick",
        target="013_apple",
        num_envs=1,
        autoreset="disabled",
        obs_mode="state",
        home="builtin_m0_00",
    ).unwrapped
    env.reset(seed=0)
    yield env
    env.close()


def moved(scene: FilmedMoment, x: float) -> FilmedMoment:
    """The scene with a robot and its hand, but no body, elsewhere."""
    shift = np.array([x, 0.0, 0.0])
    return scene._replace(base=scene.base + shift, tcp=scene.tcp + shift)


def test_an_apple_in_a_fridge_is_in_sight(env: SequentialTaskEnv) -> None:
    camera = FilmCamera(env.observer.renderer)
    scene = scene_of(env, 0)
    best = camera.best(scene)
    hand, target, robot, around = camera.sight(scene, [best])[0]
    assert hand >= 0.8 and target >= 0.8 and robot > 0.0 and around >= 0.4
    # From behind the wall that the fridge stands at nothing of it is seen.
    ahead = scene.target - scene.tcp
    behind = scene.target + 2.0 * ahead / np.linalg.norm(ahead)
    hidden = camera.sight(scene, [Viewpoint(behind, scene.middle, 0.85)])[0]
    assert hidden[0] < 0.5
    x0, y0, x1, y1 = env.layout.pack.homes[0].floor
    assert x0 < best.eye[0] < x1 and y0 < best.eye[1] < y1


def test_a_camera_stands_still_while_it_sees_and_cuts_at_a_teleport(
    env: SequentialTaskEnv,
) -> None:
    camera = FilmCamera(env.observer.renderer)
    scene = scene_of(env, 0)
    setup = camera.follow(scene, None)
    assert setup.cut and not setup.teleported
    eye = setup.view.eye
    for _ in range(12):
        setup = camera.follow(scene, setup)
        assert not setup.cut and np.array_equal(setup.view.eye, eye)
    slightly = camera.follow(moved(scene, 0.1), setup)
    assert not slightly.cut
    turn = slightly.view.target - setup.view.target
    assert 0.0 < np.linalg.norm(turn) < 0.05
    jumped = camera.follow(moved(scene, 1.5), setup)
    assert jumped.cut and jumped.teleported and jumped.frames == 0


def test_ceilings_are_seen_from_below_and_in_pictures_for_people_alone(
    env: SequentialTaskEnv,
) -> None:
    renderer = env.observer.renderer
    home = env.layout.pack.homes[0]
    x, y, yaw = env.state.robot_q[0, [*range(2), 2]]
    assert (x, y) == tuple(env.state.robot_q[0, BASE_XY]) and yaw == env.state.robot_q[
        0, BASE_YAW
    ]
    up = Viewpoint(np.array([x, y, 1.5]), np.array([x, y, 2.5]), 0.8, (1.0, 0.0, 0.0))
    seen = {}
    for quality in (FAST, FILM):
        seen[quality] = renderer.render(
            renderer.home_numbers([home.name]),
            env.state.body_pos,
            env.state.body_mat,
            cameras_of([up], 16, 16),
            ("depth",),
            quality,
        )["depth"][0, 0]
    tops = [wall.pos[2] + wall.size[2] for wall in home.walls]
    assert not seen[FAST].any()
    assert np.allclose(seen[FILM], max(tops) - 1.5, atol=1e-3)
    plan = renderer.render(
        renderer.home_numbers([home.name]),
        env.state.body_pos,
        env.state.body_mat,
        cameras_of([plan_of(home, 96, 72)], 96, 72),
        ("seg",),
        FILM,
    )["seg"][0, 0]
    names = {renderer.scene.seg_names[k] for k in np.unique(plan)}
    assert "floor" in names and any(name.startswith("robot/") for name in names)


def test_a_plan_has_no_perspective(env: SequentialTaskEnv) -> None:
    """The top of a wall covers its foot: the same column for all heights, to a hundredth of a pixel per meter."""
    home = env.layout.pack.homes[0]
    view = plan_of(home, 400, 300)
    mat = view.mat
    x0, y0, x1, y1 = home.floor
    corners = np.array([[x0, y0, 0.0], [x0, y0, 2.5], [x1, y1, 0.0], [x1, y1, 2.5]])
    here = (corners - view.eye) @ mat
    focal = 150 / np.tan(view.fovy / 2)
    at = focal * here[:, :2] / -here[:, 2:]
    assert np.abs(at[0] - at[1]).max() < 1.0 and np.abs(at[2] - at[3]).max() < 1.0
    assert np.abs(at[:, 0]).max() < 200 and np.abs(at[:, 1]).max() < 150


def test_the_corner_of_the_view_from_inside_stands_in_the_home(
    env: SequentialTaskEnv,
) -> None:
    renderer = env.observer.renderer
    for home in env.layout.pack.homes[:2]:
        tall = renderer.follow.tall(home.name)
        view = from_inside(home, env.layout.pack, tall)
        x0, y0, x1, y1 = home.floor
        assert x0 < view.eye[0] < x1 and y0 < view.eye[1] < y1
        # It looks along the home, not at the wall beside it.
        ahead = (view.target - view.eye)[:2]
        middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2]) - view.eye[:2]
        assert ahead @ middle > 0.0


def test_words_are_drawn_beside_the_picture_and_long_ones_cut() -> None:
    image = np.full((90, 160, 3), 200, np.uint8)
    assert with_words(image) is image
    said = with_words(image, below="open the drawer " * 20, mark="teleport")
    assert (image == 200).all()
    assert (said[20:60] == 200).all() and (said[:5, :5] < 100).all()
    assert (said[80:] > 200).any() and (said[80:, 80] < 200).any()
