"""Registry of users' object types, which are added to the objects of every pack that is opened."""

from __future__ import annotations

import dataclasses
import typing
import weakref
from collections.abc import Mapping
from dataclasses import dataclass, field

from mjhab.core.errors import fault, wrong_type
from mjhab.core.names import check_texts
from mjhab.core.registration.registry import Registry, check_item
from mjhab.core.typed.checks import check
from mjhab.core.typed.options import fitting
from mjhab.scenes.builtin.objects import builtin_objects
from mjhab.scenes.pack_check import check_pack
from mjhab.scenes.shapes.meshes import Mesh
from mjhab.scenes.spec import ObjectType, Pack


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """A movable object to be registered.

    Attributes:
        kind: its type.
        meshes: the meshes of the type's geoms, by name.
        words: names in instructions, such as ("mug", "coffee mug"), of which one is sampled; () takes the name of the
            type with spaces ("my_mug": "my mug").

    Raises:
        UsageError: a field has an invalid value.
    """

    kind: ObjectType
    meshes: Mapping[str, Mesh] = field(default_factory=dict)
    words: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.kind, ObjectType):
            raise wrong_type("the kind of an ObjectModel", self.kind, "an ObjectType")
        owner = f"object {self.kind.name!r}"
        for name, hint in typing.get_type_hints(ObjectType).items():
            fitting(name, hint, getattr(self.kind, name), owner)
        fitting("meshes", Mapping[str, Mesh], self.meshes, owner)
        check_texts("words", self.words, owner)
        check(
            all(word.strip() for word in self.words),
            "words",
            self.words,
            "texts that are not empty",
            where=owner,
        )


OBJECTS: Registry[ObjectModel] = Registry("object")
_extended: dict[int, tuple[int, Pack]] = {}
"""Cache of packs with the registered objects, so that opening a pack twice returns the same object: (version of the
registry, pack with them) by the id of the pack without them, as long as somebody holds that."""


def register_object(model: ObjectModel) -> ObjectModel:
    """Register an object type, which every pack opened from now on has.

    An environment has the objects of its task's roster and of its option ``extra_objects``.

    Returns:
        ``model``.

    Raises:
        UsageError: it is no `ObjectModel`; an object of that name is registered or built in; a name or number is
            invalid; a geom names a missing mesh; or no geom collides.
    """
    check_item("register_object", model, ObjectModel)
    kind = model.kind
    for geom in (*kind.collision, *kind.visuals):
        if geom.shape == "mesh" and geom.mesh not in model.meshes:
            raise fault(
                f"object {kind.name!r}",
                f"a geom names the mesh {geom.mesh!r}; given are: {', '.join(sorted(model.meshes)) or 'none'}.",
            )
    if not any(geom.collide for geom in kind.collision):
        raise fault(
            f"object {kind.name!r}",
            "has no collision geom: nothing could hold or touch it.",
        )
    # Checked here, where the user is, and not when a pack is opened.
    if kind.name in builtin_objects():
        raise fault(
            f"object {kind.name!r}",
            "the built-in packs have an object of this name; register it under another name.",
        )
    check_pack(
        Pack("objects", {}, {}, (), {kind.name: kind}, dict(model.meshes)), kind.name
    )
    return OBJECTS.add(kind.name, model)


def object_words(kind: str) -> tuple[str, ...]:
    """Return the names in instructions of a registered object type; () for other types, and if it has none."""
    return OBJECTS[kind].words if kind in OBJECTS else ()


def with_registered_objects(pack: Pack) -> Pack:
    """Return a pack with the registered objects and their meshes added; the pack itself if there are none.

    Raises:
        UsageError: the pack has an object or a mesh with the name of a registered one.
    """
    if not len(OBJECTS):
        return pack
    # By identity, since comparing packs would compare all their meshes.
    version, extended = _extended.get(id(pack), (-1, pack))
    if version == OBJECTS.version:
        return extended
    objects = dict(pack.objects)
    meshes = dict(pack.meshes)
    for model in OBJECTS.values():
        taken = [name for name in (model.kind.name,) if name in objects]
        taken += [name for name in model.meshes if name in meshes]
        if taken:
            raise fault(
                f"registered object {model.kind.name!r}",
                f"pack {pack.name!r} has {taken[0]!r}, too; register the object under another name.",
            )
        objects[model.kind.name] = model.kind
        meshes.update(model.meshes)
    extended = dataclasses.replace(pack, objects=objects, meshes=meshes)
    if id(pack) not in _extended:
        # An id is used again once its object is gone.
        weakref.finalize(pack, _extended.pop, id(pack), None)
    _extended[id(pack)] = (OBJECTS.version, extended)
    return extended
