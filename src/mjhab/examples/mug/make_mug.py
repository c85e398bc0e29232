"""Draw the mug of this example: writes ``mug.glb`` beside this file.

    python examples/mug/make_mug.py

What is seen is round; what collides are convex pieces, named ``collision_*``: an octagonal wall, a floor, a handle.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import trimesh
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

OUT = Path(__file__).with_name("mug.glb")
RADIUS_M = 0.040
HEIGHT_M = 0.095
WALL_M = 0.0045
HANDLE_REACH_M = 0.034
"""Distance of the handle's bar from the wall."""
HANDLE_THICK_M = 0.012
HANDLE_HEIGHT_M = 0.060
SIDES = 8
"""Flat pieces of the wall: each is wider than a finger pad (26 mm), which then lies on one piece alone."""
BLUE = (0.09, 0.22, 0.45, 1.0)


def wall_piece(side: int) -> np.ndarray:
    """Corners (8, 3) [m] of one flat piece of the wall, +z up; its middles lie on the circle of the mug."""
    half_angle = np.pi / SIDES
    outer = RADIUS_M / np.cos(half_angle)
    inner = (RADIUS_M - WALL_M) / np.cos(half_angle)
    angles = 2 * np.pi * side / SIDES + np.array([-half_angle, half_angle])
    return np.array(
        [
            (r * np.cos(a), r * np.sin(a), z)
            for r in (inner, outer)
            for a in angles
            for z in (0.0, HEIGHT_M)
        ]
    )


def box(
    center: tuple[float, float, float], size: tuple[float, float, float]
) -> np.ndarray:
    """Corners (8, 3) [m] of a box."""
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return np.array(center) + signs * np.array(size) / 2


def handle_pieces() -> list[np.ndarray]:
    """Corners of the bar of the handle and of the two pieces that join it to the wall."""
    middle = HEIGHT_M / 2
    bar_x = RADIUS_M + HANDLE_REACH_M
    start = RADIUS_M - WALL_M / 2
    length = bar_x - start
    ends = [middle + s * (HANDLE_HEIGHT_M - HANDLE_THICK_M) / 2 for s in (-1, 1)]
    bar = box((bar_x, 0.0, middle), (HANDLE_THICK_M, HANDLE_THICK_M, HANDLE_HEIGHT_M))
    joins = [
        box((start + length / 2, 0.0, z), (length, HANDLE_THICK_M, HANDLE_THICK_M))
        for z in ends
    ]
    return [bar, *joins]


def pieces() -> list[np.ndarray]:
    """Corners of all convex pieces."""
    floor = trimesh.creation.cylinder(
        RADIUS_M / np.cos(np.pi / SIDES), WALL_M, sections=SIDES
    )
    turn = trimesh.transformations.rotation_matrix(np.pi / SIDES, (0, 0, 1))
    floor.apply_transform(turn).apply_translation((0.0, 0.0, WALL_M / 2))
    return [
        *(wall_piece(side) for side in range(SIDES)),
        floor.vertices,
        *handle_pieces(),
    ]


def seen() -> trimesh.Trimesh:
    """The round mug that is seen."""
    profile = np.array(
        [
            (0.0, 0.0),
            (RADIUS_M, 0.0),
            (RADIUS_M, HEIGHT_M),
            (RADIUS_M - WALL_M, HEIGHT_M),
            (RADIUS_M - WALL_M, WALL_M),
            (0.0, WALL_M),
        ]
    )
    body = trimesh.creation.revolve(profile, sections=32)
    handle = [trimesh.Trimesh(corners).convex_hull for corners in handle_pieces()]
    mug = trimesh.util.concatenate([body, *handle])
    assert isinstance(mug, trimesh.Trimesh)
    mug.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=BLUE))
    return mug


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    scene = trimesh.Scene()
    # glTF has +y up.
    y_up = trimesh.transformations.rotation_matrix(-np.pi / 2, (1, 0, 0))
    scene.add_geometry(seen().apply_transform(y_up), geom_name="mug")
    for k, corners in enumerate(pieces()):
        hull = trimesh.Trimesh(corners).convex_hull.apply_transform(y_up)
        scene.add_geometry(hull, geom_name=f"collision_{k}")
    OUT.write_bytes(export_glb(scene))
    print(f"{OUT}: {OUT.stat().st_size} bytes")


if __name__ == "__main__":
    main()
