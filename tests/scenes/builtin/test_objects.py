"""The ten objects: sizes, masses, counts, and the shape of the bowl."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from mjhab.episodes.rosters import roster
from mjhab.scenes.builtin.objects import builtin_objects, object_meshes
from mjhab.scenes.shapes.footprints import bounds, outline
from mjhab.scenes.spec import Geom
from tests.refusals import refused

# Extents of the google_16k scans along the object's own axes [m] and masses [kg] of the YCB Object and Model Set.
YCB = {
    "002_master_chef_can": ((0.1022, 0.1023, 0.1402), 0.414),
    "003_cracker_box": ((0.0718, 0.1639, 0.2134), 0.411),
    "004_sugar_box": ((0.0479, 0.0933, 0.1760), 0.514),
    "005_tomato_soup_can": ((0.0676, 0.0674, 0.1019), 0.349),
    "007_tuna_fish_can": ((0.0853, 0.0853, 0.0335), 0.171),
    "008_pudding_box": ((0.0898, 0.1127, 0.0389), 0.187),
    "009_gelatin_box": ((0.0729, 0.0893, 0.0301), 0.097),
    "010_potted_meat_can": ((0.0573, 0.1016, 0.0835), 0.370),
    "013_apple": ((0.0754, 0.0749, 0.0719), 0.068),
    "024_bowl": ((0.1610, 0.1604, 0.0550), 0.147),
}


@pytest.mark.parametrize("name", YCB)
def test_size_and_mass_are_those_of_ycb(name: str) -> None:
    size, mass = YCB[name]
    kind = builtin_objects()[name]
    assert kind.mass == mass
    np.testing.assert_allclose(2 * np.array(kind.half), size, atol=1e-3)


@pytest.mark.parametrize("name", YCB)
def test_collision_fills_the_bounding_box(name: str) -> None:
    kind = builtin_objects()[name]
    low, high = bounds(kind.collision, object_meshes())
    # Curved outlines are drawn around the circle, so they may stand out by 2 %; hull corners sit on the surface,
    # and the middles of the bowl's flat pieces 2.7 mm inside of it.
    np.testing.assert_allclose(high, kind.half, atol=0.003)
    np.testing.assert_allclose(-low, kind.half, atol=0.003)


@pytest.mark.parametrize("name", YCB)
def test_visuals_stay_within_a_millimetre_of_the_bounding_box(name: str) -> None:
    kind = builtin_objects()[name]
    points = np.concatenate([outline(g, object_meshes()) for g in kind.visuals])
    radial = 1.02 if any(g.shape == "cylinder" for g in kind.visuals) else 1.0
    assert np.all(np.abs(points) <= np.array(kind.half) * (radial, radial, 1.0) + 0.0012)


@pytest.mark.parametrize("name", YCB)
def test_visuals_are_only_seen_and_collision_only_felt(name: str) -> None:
    kind = builtin_objects()[name]
    assert all(g.collide and not g.visual for g in kind.collision)
    assert all(g.visual and not g.collide for g in kind.visuals)


def _solid(pieces: Iterable[Geom]) -> Callable[[np.ndarray], bool]:
    """Whether a point is in the hull of any piece."""
    meshes = object_meshes()
    planes = [ConvexHull(outline(g, meshes)).equations for g in pieces]
    return lambda point: any(
        bool(np.all(p[:, :3] @ point + p[:, 3] <= 0.0)) for p in planes
    )


def test_bowl_is_open() -> None:
    """No collision piece takes the room where an apple lies, or any of the axis above the floor."""
    solid = _solid(builtin_objects()["024_bowl"].collision)
    for z in np.linspace(-0.022, 0.03, 14):
        assert not solid(np.array([0.0, 0.0, z]))
    for angle in np.linspace(0.0, 2 * np.pi, 17):
        for r, z in ((0.035, -0.018), (0.065, 0.0), (0.072, 0.026)):
            point = np.array([r * np.cos(angle), r * np.sin(angle), z])
            assert not solid(point), (r, z, angle)


def test_bowl_wall_has_no_gap_and_is_thin() -> None:
    solid = _solid(builtin_objects()["024_bowl"].collision)
    for angle in np.linspace(0.0, 2 * np.pi, 41):
        ray = np.arange(0.066, 0.086, 0.0005)
        hit = [
            r
            for r in ray
            if solid(np.array([r * np.cos(angle), r * np.sin(angle), 0.02]))
        ]
        assert hit, angle
        assert 0.003 <= max(hit) - min(hit) + 0.0005 <= 0.0065


def test_apple_is_one_small_hull() -> None:
    (hull,) = builtin_objects()["013_apple"].collision
    assert hull.shape == "mesh"
    assert len(outline(hull, object_meshes())) <= 48


@pytest.mark.parametrize(
    "name", ["apple_hull", "bowl_rim_piece", "bowl_base_piece", "apple_look"]
)
def test_closed_meshes_face_outward(name: str) -> None:
    mesh = object_meshes()[name]
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume > 0


@pytest.mark.parametrize(
    ("task", "count"), [("tidy_house", 30), ("prepare_groceries", 30), ("set_table", 29)]
)
def test_rosters_have_the_counts_of_the_benchmark(task: str, count: int) -> None:
    slots = roster(task)
    assert len(slots) == count
    assert set(slots) <= set(YCB)
    apples = Counter(slots)["013_apple"]
    bowls = Counter(slots)["024_bowl"]
    assert (apples, bowls) == ((1, 4) if task == "set_table" else (0, 4))


def test_unknown_task_names_the_tasks() -> None:
    with refused("task", "settable", expected="set_table"):
        roster("settable")
