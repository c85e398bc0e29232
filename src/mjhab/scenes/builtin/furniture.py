"""The furniture of the built-in pack, by template name."""

from __future__ import annotations

from mjhab.scenes.builtin.furniture_decor import decor_meshes, decor_props
from mjhab.scenes.builtin.furniture_kitchen import fridge, kitchen_counter
from mjhab.scenes.builtin.furniture_living import living_meshes, living_props
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.spec import Articulation, Prop


def builtin_props() -> dict[str, Prop]:
    """Return the furniture without joints by name; names are those of corresponding ReplicaCAD templates."""
    return {prop.name: prop for prop in (*living_props(), *decor_props())}


def builtin_articulations() -> dict[str, Articulation]:
    """Return the furniture with joints by name: ``kitchen_counter`` and ``fridge``."""
    return {a.name: a for a in (kitchen_counter(), fridge())}


def furniture_meshes() -> dict[str, Mesh]:
    """Return the meshes of the furniture by name."""
    return {**living_meshes(), **decor_meshes()}
