"""Antipodal grasps on surfaces: contacts are where they should be, and the hand touches nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mjhab.core.rotations import frame_from_axes
from mjhab.episodes.grasps import antipodal
from mjhab.episodes.grasps.antipodal import Solid, surface_grasps
from mjhab.episodes.grasps.candidates import LyingObject, grasp_candidates
from mjhab.episodes.grasps.pinch import SurfaceGrasps
from mjhab.episodes.grasps.spread import farthest_points
from mjhab.episodes.grasps.stable import shape_of
from mjhab.robots.fetch.robot import ROBOT
from mjhab.scenes.spec import Geom, ObjectType

HAND = ROBOT.gripper


def block(
    *boxes: tuple[tuple[float, float, float], tuple[float, float, float]],
) -> ObjectType:
    """An object of boxes, each (half-extents, centre) [m]."""
    geoms = tuple(Geom("box", half, pos) for half, pos in boxes)
    corners = np.concatenate(
        [np.abs(np.array(pos)) + np.array(half) for half, pos in boxes]
    )
    half = corners.reshape(-1, 3).max(axis=0)
    return ObjectType(
        "block", 0.2, (half[0], half[1], half[2]), geoms, (), grasp_shape="mesh"
    )


BAR = block(((0.02, 0.06, 0.03), (0.0, 0.0, 0.0)))
CUP = block(
    ((0.035, 0.035, 0.003), (0.0, 0.0, -0.04)),
    *(((0.003, 0.035, 0.04), (s * 0.035, 0.0, 0.0)) for s in (-1, 1)),
    *(((0.035, 0.003, 0.04), (0.0, s * 0.035, 0.0)) for s in (-1, 1)),
)
"""A square cup, open at the top."""


@pytest.fixture(scope="module")
def on_bar() -> SurfaceGrasps:
    return surface_grasps(BAR, {})


@pytest.fixture(scope="module")
def on_cup() -> SurfaceGrasps:
    return surface_grasps(CUP, {})


def test_contacts_of_a_bar_lie_on_opposite_faces(on_bar: SurfaceGrasps) -> None:
    assert len(on_bar) > 50
    first = on_bar.contact - on_bar.width[:, None] / 2 * on_bar.closing
    last = on_bar.contact + on_bar.width[:, None] / 2 * on_bar.closing
    half = np.array(BAR.half)
    for ends in (first, last):
        assert (np.abs(ends) <= half + 1e-6).all()
        np.testing.assert_allclose(
            np.abs(np.abs(ends) - half).min(axis=1), 0.0, atol=1e-6
        )
    # The long axis, 12 cm, is wider than the hand opens.
    assert (np.abs(on_bar.closing[:, 1]) < np.sin(antipodal.MAX_SLANT_RAD) + 1e-6).all()
    assert (on_bar.width <= HAND.usable).all() and (
        on_bar.most_open <= HAND.opening + 1e-9
    ).all()
    assert (on_bar.slant <= antipodal.MAX_SLANT_RAD).all()
    np.testing.assert_allclose(
        np.einsum("mj,mj->m", on_bar.approach, on_bar.closing), 0, atol=1e-9
    )


@pytest.mark.parametrize("name", ["on_bar", "on_cup"])
def test_hand_and_fingers_keep_out_of_the_object(
    name: str, request: pytest.FixtureRequest
) -> None:
    grasps: SurfaceGrasps = request.getfixturevalue(name)
    solid = Solid.of(BAR if name == "on_bar" else CUP, {})
    rng = np.random.default_rng(0)
    frames = frame_from_axes(grasps.approach, grasps.closing)
    for k in range(len(grasps)):
        side = rng.choice([-1.0, 1.0], 400)
        finger = np.stack(
            [
                rng.uniform(-0.1, HAND.finger[0], 400),
                side * (grasps.most_open[k] / 2 + rng.uniform(0.0, HAND.thickness, 400)),
                rng.uniform(-1.0, 1.0, 400) * HAND.finger[1],
            ],
            axis=1,
        )
        palm = np.stack(
            [
                rng.uniform(*HAND.palm_x, 400),
                rng.uniform(-1.0, 1.0, 400) * HAND.palm_half[0],
                rng.uniform(-1.0, 1.0, 400) * HAND.palm_half[1],
            ],
            axis=1,
        )
        hand = np.concatenate([finger, palm]) @ frames[k].T + grasps.pos[k]
        assert not solid.inside(hand).any()


def test_a_cup_is_held_by_its_walls_with_a_finger_inside(on_cup: SurfaceGrasps) -> None:
    thin = on_cup.width < 0.01
    assert thin.sum() > 10
    # The hand comes from the open side: from below or from within there is no way.
    assert (on_cup.approach[thin, 2] < 0.0).any()
    inside = np.abs(on_cup.contact[:, :2]).max(axis=1) < 0.03
    walls = thin & ~inside
    assert (np.abs(on_cup.contact[walls, :2]).max(axis=1) > 0.03).all()
    # A finger inside has 64 mm of room: less than opening the hand fully would take.
    assert (on_cup.most_open[walls] < HAND.opening).all()


def test_the_same_grasps_every_time_and_others_with_less_friction(
    on_bar: SurfaceGrasps,
) -> None:
    np.testing.assert_array_equal(surface_grasps(BAR, {}).pos, on_bar.pos)
    slippery = surface_grasps(BAR, {}, friction=0.1)
    assert slippery.slant.max() <= np.arctan(0.1) < on_bar.slant.max()


def test_nothing_to_hold_on_what_is_too_large() -> None:
    large = block(((0.1, 0.1, 0.1), (0.0, 0.0, 0.0)))
    assert len(surface_grasps(large, {})) == 0
    assert (
        len(
            grasp_candidates(
                LyingObject.of(shape_of(large, {}), np.append(np.zeros(3), UP), -0.1)
            )
        )
        == 0
    )


UP = np.array([1.0, 0.0, 0.0, 0.0])


def test_candidates_of_a_mesh_turn_with_the_object() -> None:
    shape = shape_of(CUP, {})
    lying = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
    for quat in (UP, lying):
        found = grasp_candidates(
            LyingObject.of(shape, np.append(np.array([1.0, 2.0, 0.5]), quat), 0.45)
        )
        assert len(found) > 5
        assert (found.rot[:, 2, 0] <= 0.05 + 1e-9).all()
        assert (np.linalg.norm(found.pos - [1.0, 2.0, 0.5], axis=1) < 0.12).all()
        assert (found.opening <= found.width + 0.036 + 1e-9).all()


def test_shapes_are_made_once() -> None:
    assert shape_of(CUP, {}) is shape_of(replace(CUP), {})


def test_farthest_points() -> None:
    line = np.array([[0.0], [1.0], [10.0], [4.0]])
    assert farthest_points(line, 3).tolist() == [0, 2, 3]
    assert farthest_points(line, 9).tolist() == [0, 2, 3, 1]
