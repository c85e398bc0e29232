"""The render scene of a layout: furniture, drawers and doors, objects and robot of all its homes."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from mjhab.core.rotations import mat_from_quat
from mjhab.layout.layout import Layout
from mjhab.render.build_scene import SceneBuilder
from mjhab.render.primitives import box_mesh
from mjhab.render.render_scene import RenderScene
from mjhab.scenes.builtin.materials import MATERIALS, Material
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.spec import IDENTITY, PARKED, Geom, Home, Placement

FLOOR_HALF_THICKNESS = 0.02
"""Half the thickness of drawn floors [m]."""
CARCASS = "cabinet_carcass"
GAP = "gap between fronts"
GAP_MATERIAL = Material((0.30, 0.31, 0.31), gloss=0.1)
GAP_HALF_M = 0.00025
"""In pictures for people the front edge of a carcass, seen through the gap of 4 mm between two fronts, is as dark as
the shadow in there. Ambient occlusion, with samples 3 cm apart, does not find it: it would be a pale dotted line."""
CEILING = Material((1.25, 1.25, 1.23), gloss=0.0)
"""Brighter than white: what faces down gets the ambient light of the underside of a shelf, a third of a ceiling's."""


def build_render_scene(
    layout: Layout, model: mujoco.MjModel, dressed: bool = False
) -> RenderScene:
    """The render scene of all homes of a layout; layouts of one pack, roster and robot share it.

    Args:
        layout: robot, homes, furniture and objects.
        model: the compiled model of any home of the layout; gives the body ids, which all homes share.
        dressed: for pictures that people look at: with ceilings, which are seen from below alone, and dark gaps
            between the fronts of cupboards. Observations are drawn without.
    """
    # It takes a second for the built-in homes, and evaluations and tests open many environments of them.
    key = ("render scene", layout.roster, layout.robot, dressed)
    return layout.pack.derived.get(key, lambda: _build(layout, model, dressed))


def _build(layout: Layout, model: mujoco.MjModel, dressed: bool) -> RenderScene:
    homes = layout.pack.homes
    materials = {**MATERIALS, **layout.robot.materials}
    if dressed:
        materials[GAP] = GAP_MATERIAL
    builder = SceneBuilder(len(homes), materials)
    meshes = layout.pack.meshes
    _add_shell(builder, layout)
    for i, slot in enumerate(layout.prop_slots):
        at = [layout.slot_placements(home)[i] for home in homes]
        geoms = layout.pack.props[slot.template].geoms
        geoms += _gaps(geoms) if dressed else ()
        _add_standing(builder, geoms, at, slot.name, meshes)
    for articulation in layout.articulations:
        at = [layout.articulation_placement(home, articulation.name) for home in homes]
        geoms = articulation.geoms
        geoms += _gaps(geoms) if dressed else ()
        _add_standing(builder, geoms, at, articulation.name, meshes)
        for link in articulation.links:
            name = f"{articulation.name}/{link.name}"
            for geom in link.geoms:
                if geom.visual:
                    builder.add_body_geom(geom, model.body(name).id, name, meshes)
    for name, kind in zip(layout.object_names, layout.objects, strict=True):
        for geom in kind.visuals:
            builder.add_body_geom(geom, model.body(name).id, name, meshes)
    for k, (link, mesh, material) in enumerate(layout.robot.visuals()):
        mesh_id = builder.add_mesh(("robot", k), mesh)
        look = builder.material(material)
        builder.add_body_instance(
            mesh_id, model.body(link).id, material=look, seg=f"robot/{link}"
        )
    if dressed:
        _add_ceilings(builder, homes)
    for h, home in enumerate(homes):
        for light in home.lights:
            builder.add_light(h, light)
    return builder.build()


def _add_shell(builder: SceneBuilder, layout: Layout) -> None:
    """Add floors, floor patches and walls as unit boxes with a pose, scale and material per home."""
    homes = layout.pack.homes
    unit = builder.add_mesh("unit box", box_mesh((1.0, 1.0, 1.0)))
    floors = []
    for home in homes:
        x0, y0, x1, y1 = home.floor
        size = ((x1 - x0) / 2, (y1 - y0) / 2, FLOOR_HALF_THICKNESS)
        center = ((x0 + x1) / 2, (y0 + y1) / 2, -FLOOR_HALF_THICKNESS)
        floors.append(Geom("box", size, center, material=home.floor_material))
    _add_boxes(builder, unit, [(geom,) for geom in floors], "floor")
    _add_boxes(builder, unit, [home.floor_patches for home in homes], "floor")
    _add_boxes(builder, unit, [home.walls for home in homes], "wall")


def _add_boxes(
    builder: SceneBuilder, unit: int, boxes: Sequence[tuple[Geom, ...]], seg: str
) -> None:
    # Homes have different numbers of walls, and share instances all the same.
    absent = Geom("box", (0.0, 0.0, 0.0), PARKED)
    for k in range(max(len(row) for row in boxes)):
        row = [b[k] if k < len(b) else absent for b in boxes]
        builder.add_world_instance(
            unit,
            np.array([g.pos for g in row]),
            np.array([g.quat for g in row]),
            np.array([g.size for g in row]),
            [builder.material(g.material) for g in row],
            seg,
        )


def _add_standing(
    builder: SceneBuilder,
    geoms: tuple[Geom, ...],
    at: Sequence[Placement | None],
    seg: str,
    meshes: dict[str, object],
) -> None:
    # Hidden by its scale, and parked as well, for whoever looks at positions alone.
    pos = np.array([PARKED if p is None else p.pos for p in at])
    quat = np.array([IDENTITY if p is None else p.rotation for p in at])
    present = np.array([p is not None for p in at])
    for geom in geoms:
        if geom.visual:
            builder.add_world_geom(geom, pos, quat, seg, present, meshes)


def _gaps(geoms: Sequence[Geom]) -> tuple[Geom, ...]:
    """Dark plates on the front edges, at +x, of what is a carcass among the geoms of a piece of furniture."""
    return tuple(
        Geom(
            "box",
            (GAP_HALF_M, geom.size[1], geom.size[2]),
            (geom.pos[0] + geom.size[0] + GAP_HALF_M, *geom.pos[1:]),
            material=GAP,
        )
        for geom in geoms
        if geom.material == CARCASS and geom.visual
    )


def _add_ceilings(builder: SceneBuilder, homes: Sequence[Home]) -> None:
    """Add a ceiling on the walls of every home that has some: one side, which is not drawn from above."""
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], np.float32)
    # Wound so that its front is below: from above one looks into the rooms.
    below = Mesh(corners, np.array([(0, 2, 1), (0, 3, 2)], np.int32))
    spans = np.array([_walls_span(home) for home in homes])
    middle = 0.5 * (spans[:, 0] + spans[:, 1])
    half = 0.5 * (spans[:, 1] - spans[:, 0])
    middle[:, 2] = spans[:, 1, 2]
    # A sheet has no height; its scale says only whether there is a ceiling.
    half[:, 2] = (half[:, 2] > 0.0).astype(float)
    builder.add_world_instance(
        builder.add_mesh("ceiling", below),
        middle,
        scale=half,
        material=builder.add_material(CEILING),
        seg="background",
    )


def _walls_span(home: Home) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner (3,) of the walls of a home [m]; both zero without walls."""
    if not home.walls:
        return np.zeros(3), np.zeros(3)
    turns = mat_from_quat(np.array([wall.quat for wall in home.walls], float))
    reach = np.einsum("nij,nj->ni", np.abs(turns), [wall.size for wall in home.walls])
    places = np.array([wall.pos for wall in home.walls], float)
    return (places - reach).min(axis=0), (places + reach).max(axis=0)
