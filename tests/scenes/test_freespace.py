"""The raster of free floor: exact on simple rooms, conservative everywhere."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjhab.scenes.freespace import MAX_KEPT_FIELDS, free_map, reach
from mjhab.scenes.shapes.blocking import blocking_polygons
from mjhab.scenes.shapes.footprints import turned
from mjhab.scenes.shapes.hulls import hull_mesh
from mjhab.scenes.shapes.shapes import box, rod, span
from mjhab.scenes.spec import Geom, Home, Pack, Placement, Prop, Receptacle
from tests.refusals import refused


def _room(
    walls: tuple[Geom, ...] = (), props: tuple[Placement, ...] = (), size: float = 4.0
) -> Home:
    return Home(
        "room", "toy", "train", 0, 0, walls, (0.0, 0.0, size, size), "oak", props, ()
    )


def _pack(*props: Prop) -> Pack:
    return Pack("toy", {p.name: p for p in props}, {}, (), {})


def test_clearance_in_an_empty_room_is_the_distance_to_the_edge() -> None:
    free = free_map(_room(), _pack())
    assert free.clearance_at(np.array([2.0, 2.0])) == pytest.approx(2.0, abs=0.051)
    assert free.clearance_at(np.array([0.5, 2.0])) == pytest.approx(0.5, abs=0.051)
    assert free.clearance_at(np.array([-0.1, 2.0])) == 0.0
    assert free.clearance_at(np.array([40.0, 2.0])) == 0.0


@settings(max_examples=40, deadline=None)
@given(
    st.floats(0.5, 3.5),
    st.floats(0.5, 3.5),
    st.floats(-3.2, 3.2),
    st.floats(0.0, 4.0),
    st.floats(0.0, 4.0),
)
def test_clearance_of_a_turned_box_is_its_distance(
    x: float, y: float, yaw: float, px: float, py: float
) -> None:
    home = _room(props=(Placement("block", (x, y, 0.0), yaw),))
    free = free_map(
        home, _pack(Prop("block", (box((0.0, 0.0, 0.5), (0.6, 0.3, 1.0), "oak"),)))
    )
    c = np.cos(yaw)
    s = np.sin(yaw)
    local = np.array([[c, s], [-s, c]]) @ (np.array([px, py]) - (x, y))
    to_box = np.linalg.norm(np.maximum(np.abs(local) - (0.3, 0.15), 0.0))
    exact = min(to_box, px, py, 4.0 - px, 4.0 - py)
    assert float(free.clearance_at(np.array([px, py]))) == pytest.approx(exact, abs=0.13)


def test_every_blocked_point_is_marked() -> None:
    home = _room(props=(Placement("pillar", (1.3, 2.2, 0.0)),))
    pack = _pack(Prop("pillar", (rod((0.0, 0.0, 0.5), (0.2, 1.0), "oak"),)))
    free = free_map(home, pack, cell=0.04)
    for angle in np.linspace(0.0, 2 * np.pi, 60):
        point = np.array([1.3, 2.2]) + 0.199 * np.array([np.cos(angle), np.sin(angle)])
        assert free.clearance_at(point) == 0.0


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.floats(-3.2, 3.2))
def test_every_point_of_a_turned_mesh_is_marked(seed: int, yaw: float) -> None:
    # The mesh lies on its side, as those of ReplicaCAD: from above, the corners of its ends coincide up to rounding.
    rng = np.random.default_rng(seed)
    plan = rng.uniform(-0.5, 0.5, (12, 2))
    x, y = np.tile(plan, (2, 1)).T
    mesh = hull_mesh(np.column_stack([x, np.repeat([0.1, 0.9], 12), -y]))
    up = (0.70710678, 0.70710679, 0.0, 0.0)
    upright = Geom("mesh", (1.0, 1.0, 1.0), quat=up, mesh="prism")
    prism = Prop("prism", (upright,))
    placement = Placement("prism", (2.0, 2.0, 0.0), yaw)
    pack = dataclasses.replace(_pack(prism), meshes={"prism": mesh})
    home = _room(props=(placement,))
    assert len(blocking_polygons(home, pack)) == 1
    weights = rng.dirichlet(np.full(12, 0.3), 300)
    inside = turned(placement, (weights @ plan)[None] * 0.999)[0]
    assert not free_map(home, pack).clearance_at(inside).any()


def test_only_what_stands_in_the_way_blocks() -> None:
    high = Prop("lamp", (box((0.0, 0.0, 2.0), (1.0, 1.0, 0.2), "oak"),))
    rug = Prop(
        "rug", (box((0.0, 0.0, 0.01), (1.0, 1.0, 0.02), "oak"),), blocks_base=False
    )
    look = Prop("ghost", (box((0.0, 0.0, 0.5), (1.0, 1.0, 1.0), "oak", collide=False),))
    for prop in (high, rug, look):
        assert (
            blocking_polygons(
                _room(props=(Placement(prop.name, (2.0, 2.0, 0.0)),)), _pack(prop)
            )
            == []
        )


def test_navigable_is_the_largest_connected_piece() -> None:
    wall = span((1.2, 1.3), (0.0, 4.0), (0.0, 2.0), "oak")
    free = free_map(_room((wall,)), _pack())
    mask = free.navigable(0.3)
    cells = free.to_xy(np.argwhere(mask))
    assert cells[:, 0].min() > 1.5
    assert np.all(free.clearance[mask] >= 0.3)
    assert not free.navigable(5.0).any()


def test_a_doorway_joins_rooms_only_for_a_robot_that_fits() -> None:
    walls = (
        span((1.9, 2.0), (0.0, 1.5), (0.0, 2.0), "oak"),
        span((1.9, 2.0), (2.5, 4.0), (0.0, 2.0), "oak"),
    )
    free = free_map(_room(walls), _pack())
    for radius, joined in ((0.3, True), (0.45, True), (0.6, False)):
        x = free.to_xy(np.argwhere(free.navigable(radius)))[:, 0]
        assert bool(x.min() < 1.5 and x.max() > 2.5) is joined, radius


def test_cells_and_positions_round_trip_and_samples_lie_in_the_mask() -> None:
    free = free_map(_room(size=3.0), _pack())
    cells = np.argwhere(free.navigable())
    np.testing.assert_array_equal(free.to_cell(free.to_xy(cells)), cells)
    rng = np.random.default_rng(3)
    mask = free.navigable()
    for _ in range(50):
        i, j = free.to_cell(free.sample(rng, mask))
        assert mask[i, j]
    with pytest.raises(ValueError, match="empty"):
        free.sample(rng, np.zeros_like(mask))


def test_reach_is_the_distance_from_navigable_floor() -> None:
    table = Prop(
        "table",
        (box((0.0, 0.0, 0.4), (0.8, 1.0, 0.8), "oak"),),
        (Receptacle("top", (0.0, 0.0, 0.8), (0.4, 0.5), 1.0),),
    )
    pack = _pack(table)
    home = _room(props=(Placement("table", (2.0, 2.0, 0.0), 0.4),))
    (row,) = reach(home, pack, free_map(home, pack))
    assert (row.thing, row.receptacle) == ("table", "top")
    assert row.center == pytest.approx(0.7, abs=0.12)
    assert row.farthest == pytest.approx(0.7, abs=0.12)


def test_ways_in_an_empty_room_are_straight() -> None:
    free = free_map(_room(size=5.0), _pack())
    rng = np.random.default_rng(0)
    for a, b in rng.uniform(0.5, 4.5, (40, 2, 2)):
        straight = float(np.linalg.norm(a - b))
        # The ways of the raster are up to 3 % longer; looking up between cells adds or takes a cell.
        assert straight - 0.04 < free.distance(a, b) < 1.03 * straight + 0.06
        assert free.distance(a, b) == pytest.approx(free.distance(b, a), abs=0.08)


def test_ways_lead_around_a_wall() -> None:
    # From one side of a wall of 3 m to the other, past its end at (2, 3).
    free = free_map(
        _room((span((1.95, 2.05), (0.0, 3.0), (0.0, 2.0), "oak"),), size=5.0), _pack()
    )
    here = np.array([1.0, 1.0])
    there = np.array([3.0, 1.0])
    # Around a circle of 0.3 m about each corner of the wall's end.
    leg = float(np.hypot(0.95, 2.0))
    shortest = 2 * np.sqrt(leg**2 - 0.3**2) + 0.3 * np.pi * 0.7
    assert free.distance(here, there) == pytest.approx(shortest, rel=0.08)
    assert free.distance(here, there) > shortest
    field = free.distances_to(there)
    assert (
        field.dtype == np.float32
        and field.shape == free.blocked.shape
        and not field.flags.writeable
    )
    assert free.distances_to(there) is field, "made once per goal"
    # The field never says less than the straight line, and never jumps between free neighbours.
    centres = free.to_xy(np.moveaxis(np.indices(free.blocked.shape), 0, -1))
    assert (field >= np.linalg.norm(centres - there, axis=-1) - 1e-4).all()
    nav = free.navigable()
    steps = np.abs(np.diff(field, axis=0))[nav[1:] & nav[:-1]]
    assert steps.max() < 0.0501


def test_where_the_base_does_not_fit_the_straight_line_to_free_floor_counts() -> None:
    table = Prop("table", (box((0.0, 0.0, 0.4), (1.0, 1.0, 0.8), "oak"),))
    free = free_map(_room(props=(Placement("table", (2.0, 2.0, 0.0)),)), _pack(table))
    inside = np.array([1.9, 2.0])
    beside = np.array([0.9, 2.0])
    # 0.7 m from there to where a base fits, as a goal and as a start.
    assert free.distance(beside, inside) == pytest.approx(1.0, abs=0.1)
    assert free.distance(inside, beside) == pytest.approx(1.0, abs=0.1)
    # Off the map the way back to it counts too.
    assert free.distance(np.array([-10.0, 2.0]), beside) == pytest.approx(10.9, abs=0.1)
    walled = free_map(_room((span((0.9, 1.0), (0.0, 4.0), (0.0, 2.0), "oak"),)), _pack())
    # The smaller room is cut off: from there it counts how far the other one is.
    assert walled.distance(np.array([0.45, 2.0]), np.array([3.0, 2.0])) == pytest.approx(
        2.55, abs=0.1
    )
    with refused(said="no floor on which a base"):
        free_map(_room(size=0.5), _pack()).distances_to(inside)


def test_a_map_remembers_a_bounded_number_of_goals() -> None:
    free = free_map(_room(size=1.0), _pack(), cell=0.1)
    first = free.distances_to(np.array([0.5, 0.5]))
    for k in range(MAX_KEPT_FIELDS):
        free.distances_to(np.array([0.4, 0.4 + 0.002 * k]))
    assert free.distances_to(np.array([0.5, 0.5])) is not first


def test_the_ways_to_a_goal_do_not_depend_on_goals_before() -> None:
    # Less than a millimetre apart, in two cells.
    left, right = np.array([0.4998, 0.5]), np.array([0.5002, 0.5])
    alone = free_map(_room(size=1.0), _pack(), cell=0.1).distances_to(right)
    free = free_map(_room(size=1.0), _pack(), cell=0.1)
    free.distances_to(left)
    np.testing.assert_array_equal(free.distances_to(right), alone)
