"""The raster of free floor: exact on simple rooms, conservative everywhere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mjhab.scenes.freespace import blocking_polygons, free_map, reach
from mjhab.scenes.shapes import box, rod, span
from mjhab.scenes.spec import Geom, Home, Pack, Placement, Prop, Receptacle


def _room(walls: tuple[Geom, ...] = (), props: tuple[Placement, ...] = (), size: float = 4.0) -> Home:
    return Home("room", "toy", "train", 0, 0, walls, (0.0, 0.0, size, size), "oak", props, ())


def _pack(*props: Prop) -> Pack:
    return Pack("toy", {p.name: p for p in props}, {}, (), {})


def test_clearance_in_an_empty_room_is_the_distance_to_the_edge() -> None:
    free = free_map(_room(), _pack())
    assert free.clearance_at(np.array([2.0, 2.0])) == pytest.approx(2.0, abs=0.051)
    assert free.clearance_at(np.array([0.5, 2.0])) == pytest.approx(0.5, abs=0.051)
    assert free.clearance_at(np.array([-0.1, 2.0])) == 0.0
    assert free.clearance_at(np.array([40.0, 2.0])) == 0.0


@settings(max_examples=40, deadline=None)
@given(st.floats(0.5, 3.5), st.floats(0.5, 3.5), st.floats(-3.2, 3.2), st.floats(0.0, 4.0), st.floats(0.0, 4.0))
def test_clearance_of_a_turned_box_is_its_distance(x: float, y: float, yaw: float, px: float, py: float) -> None:
    home = _room(props=(Placement("block", (x, y, 0.0), yaw),))
    free = free_map(home, _pack(Prop("block", (box((0.0, 0.0, 0.5), (0.6, 0.3, 1.0), "oak"),))))
    c, s = np.cos(yaw), np.sin(yaw)
    local = np.array([[c, s], [-s, c]]) @ (np.array([px, py]) - (x, y))
    to_box = np.linalg.norm(np.maximum(np.abs(local) - (0.3, 0.15), 0.0))
    exact = min(to_box, px, py, 4.0 - px, 4.0 - py)
    assert float(free.clearance_at(np.array([px, py]))) == pytest.approx(exact, abs=0.13)


def test_every_blocked_point_is_marked() -> None:
    home = _room(props=(Placement("pillar", (1.3, 2.2, 0.0)),))
    pack = _pack(Prop("pillar", (rod((0.0, 0.0, 0.5), 0.2, 1.0, "oak"),)))
    free = free_map(home, pack, cell=0.04)
    for angle in np.linspace(0.0, 2 * np.pi, 60):
        point = np.array([1.3, 2.2]) + 0.199 * np.array([np.cos(angle), np.sin(angle)])
        assert free.clearance_at(point) == 0.0


def test_only_what_stands_in_the_way_blocks() -> None:
    high = Prop("lamp", (box((0.0, 0.0, 2.0), (1.0, 1.0, 0.2), "oak"),))
    rug = Prop("rug", (box((0.0, 0.0, 0.01), (1.0, 1.0, 0.02), "oak"),), blocks_base=False)
    look = Prop("ghost", (box((0.0, 0.0, 0.5), (1.0, 1.0, 1.0), "oak", collide=False),))
    for prop in (high, rug, look):
        assert blocking_polygons(_room(props=(Placement(prop.name, (2.0, 2.0, 0.0)),)), _pack(prop)) == []


def test_navigable_is_the_largest_connected_piece() -> None:
    wall = span((1.2, 1.3), (0.0, 4.0), (0.0, 2.0), "oak")
    free = free_map(_room((wall,)), _pack())
    mask = free.navigable(0.3)
    cells = free.to_xy(np.argwhere(mask))
    assert cells[:, 0].min() > 1.5
    assert np.all(free.clearance[mask] >= 0.3)
    assert not free.navigable(5.0).any()


def test_a_doorway_joins_rooms_only_for_a_robot_that_fits() -> None:
    walls = (span((1.9, 2.0), (0.0, 1.5), (0.0, 2.0), "oak"), span((1.9, 2.0), (2.5, 4.0), (0.0, 2.0), "oak"))
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
        "table", (box((0.0, 0.0, 0.4), (0.8, 1.0, 0.8), "oak"),), (Receptacle("top", (0.0, 0.0, 0.8), (0.4, 0.5), 1.0),)
    )
    pack = _pack(table)
    home = _room(props=(Placement("table", (2.0, 2.0, 0.0), 0.4),))
    (row,) = reach(home, pack, free_map(home, pack))
    assert (row.thing, row.receptacle) == ("table", "top")
    assert row.center == pytest.approx(0.7, abs=0.12)
    assert row.farthest == pytest.approx(0.7, abs=0.12)
