"""The furniture of the built-in pack, by template name."""

from __future__ import annotations

from mjhab.scenes.builtin.furniture_decor import decor_meshes, decor_props
from mjhab.scenes.builtin.furniture_kitchen import fridge, kitchen_counter
from mjhab.scenes.builtin.furniture_living import living_meshes, living_props
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.spec import Articulation, Prop


def builtin_props() -> dict[str, Prop]:
    """Furniture without joints. Names follow ReplicaCAD's templates where it has a like."""
    return {prop.name: prop for prop in (*living_props(), *decor_props())}


def builtin_articulations() -> dict[str, Articulation]:
    """``kitchen_counter`` and ``fridge``."""
    return {a.name: a for a in (kitchen_counter(), fridge())}


def furniture_meshes() -> dict[str, Mesh]:
    """Every mesh that the furniture names."""
    return {**living_meshes(), **decor_meshes()}
