"""Navigable positions in MS-HAB's layout: written, read as there, and refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from mjhab.compat.mshab.files.navigable import (
    MapWays,
    NavigableMap,
    map_paths,
    read_map,
    read_maps,
    write_map,
)
from mjhab.scenes.freespace import FreeMap
from tests.refusals import refused

SCENE = "v3_sc0_staging_00.scene_instance"


@pytest.fixture(scope="module")
def floor() -> FreeMap:
    """Two rooms of 3 x 3 m, with a wall between them that has a gap at its upper end."""
    clearance = np.full((120, 60), 0.5)
    clearance[[0, -1]] = clearance[:, [0, -1]] = 0.0
    clearance[55:65, :45] = 0.0
    return FreeMap((-3.0, -1.0), 0.05, clearance == 0.0, clearance)


@pytest.fixture
def files(floor: FreeMap, tmp_path: Path) -> tuple[Path, Path, Path]:
    return write_map(tmp_path, SCENE, floor)


def length_of_the_original(
    places: torch.Tensor, ways: torch.Tensor, base: torch.Tensor, goal: torch.Tensor
) -> torch.Tensor:
    """What navigate.py says in words: from place to place, and from the last one to the goal."""
    first = torch.cdist(base, places).argmin(1)
    apart, last = torch.cdist(goal, places).min(1)
    return ways[first, last] + apart


def test_maps_are_read_as_the_original_reads_them(
    files: tuple[Path, Path, Path], floor: FreeMap, tmp_path: Path
) -> None:
    found = read_map(tmp_path, f"{SCENE}.json")
    assert found is not None
    # Vertices of two coordinates, in the order of the lengths between them.
    read = np.asarray(trimesh.load(files[1]).vertices)  # type: ignore[union-attr]
    np.testing.assert_allclose(read, found.places, atol=1e-6)
    dense = np.asarray(trimesh.load(files[0]).vertices)  # type: ignore[union-attr]
    assert dense.shape[1] == 2 and len(dense) > 20 * len(read)
    assert (floor.clearance_at(dense) > 0).all()
    rng = np.random.default_rng(0)
    base, goal = rng.uniform((-2.9, -0.9), (2.9, 1.9), (2, 40, 2))
    ways = MapWays({"home": found}, 41)
    for world, xy in enumerate(goal):
        ways.begin(world, "home", xy)
    ours = ways.at(np.concatenate([base, base[:1]]))
    theirs = length_of_the_original(
        torch.tensor(read),
        torch.from_numpy(np.load(files[2])).double(),
        torch.tensor(base),
        torch.tensor(goal),
    )
    np.testing.assert_allclose(ours[:40], theirs, rtol=1e-6)
    assert ours[40] == 0.0
    # Around the wall, as on the map of the floor; 0.5 m for the places that stand for base and goal.
    inside = floor.clearance_at(base) * floor.clearance_at(goal) > 0
    exact = [floor.distance(a, b) for a, b in zip(base, goal, strict=True)]
    assert np.abs(ours[:40] - exact)[inside].max() < 0.5
    assert max(exact) > 5.0


def test_the_first_folder_that_has_a_map_gives_it(
    files: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    other = tmp_path / "other"
    found = read_maps((other, tmp_path), (SCENE, "another"))
    assert list(found) == [SCENE] and read_map(other, SCENE) is None
    assert [path.name for path in map_paths(tmp_path, SCENE)] == [
        f"{SCENE}.fetch.navigable_positions{end}"
        for end in (".obj", "_simplified.obj", "_simplified_all_pairs_dist.npy")
    ]


def test_files_of_another_layout_are_refused(
    files: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    _, places, ways = files
    text, lengths = places.read_text(), np.load(ways)

    def read() -> NavigableMap | None:
        return read_map(tmp_path, SCENE)

    np.save(ways, lengths[:-1, :-1])
    with refused("ways between places", said=ways.name):
        read()
    np.save(ways, np.array([{"a": 1}], object), allow_pickle=True)
    with refused(said="no array of numbers"):
        read()
    np.save(ways, np.where(lengths > 5, np.nan, lengths))
    with refused(said="negative or no numbers"):
        read()
    np.save(ways, lengths.astype(complex))
    with refused("ways between places", expected="numbers (places, places)"):
        read()
    ways.write_bytes(b"")
    with refused(said="no array of numbers"):
        read()
    np.save(ways, lengths)
    assert read() is not None
    places.write_text(text.replace("v ", "v 0 ", 1))
    with refused("numbers of the vertex in line 1", said=places.name):
        read()
    places.write_text(text.replace("v ", "v x", 1))
    with refused(said="line 1 has no numbers"):
        read()
    places.write_text("f 1 2 3\n")
    with refused(said="no vertices"):
        read()
    places.unlink()
    with refused(said=f"{places.name}, which belongs to it, is missing"):
        read()
