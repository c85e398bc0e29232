"""Reader of the ReplicaCAD data set: its apartments as homes.

A folder of the data set (``configs/``, ``objects/``, ``urdf/``, optionally ``stages/`` and ``navmeshes/``) becomes a
pack whose homes are the 84 staged scenes ``v3_sc<macro>_staging_<micro>``, or other scenes if they are named. Splits
follow the Home Assistant Benchmark: macro layouts 0-2 are train, 3 val, 4 test; scenes that are not staged are train.

Dynamic objects of a scene (``motion_type`` DYNAMIC, 101 to 109 in each of ``apt_0`` to ``apt_5``, none in the staged
scenes) are static here, like furniture: only the objects of a task's episodes move.
"""

from __future__ import annotations

import fnmatch
import functools
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mjhab.core.errors import fault, unknown_name, warn_once
from mjhab.core.rotations import mat_from_quat
from mjhab.scenes import roles
from mjhab.scenes.builtin.objects import builtin_objects, object_meshes
from mjhab.scenes.builtin.pack import ROLES as BUILTIN_ROLES
from mjhab.scenes.pack_check import check_pack
from mjhab.scenes.replica_cad.files import (
    HOW_TO_GET,
    SCENE_SUFFIX,
    check_folder,
    file_state,
    load_json,
    number,
    placement,
    short_name,
    template,
)
from mjhab.scenes.replica_cad.furniture import OPTIONAL, Furniture
from mjhab.scenes.replica_cad.navmesh import read_navmesh
from mjhab.scenes.replica_cad.stage import Extent
from mjhab.scenes.replica_cad.stage_choice import StageRequest, Stages
from mjhab.scenes.roles import present_roles
from mjhab.scenes.shapes.footprints import outline
from mjhab.scenes.shapes.openings import wall_limits
from mjhab.scenes.spec import STAND_IN, Home, Light, ObjectType, Pack, Placement

STAGED = re.compile(r"v3_sc(\d+)_staging_(\d+)")
FLOOR_MATERIAL = "floor_oak"
ROLES = replace(
    BUILTIN_ROLES,
    places={**BUILTIN_ROLES.places, roles.DRAWER: ("kitchen_counter/drawer_right_top",)},
)
"""Receptacles and links by role, as the tasks of the Home Assistant Benchmark use them (habitat-lab, hab/*.yaml)."""
_FLOOR_MARGIN_M = 1.0
"""Margin of the floor around the furniture if neither stage nor navigation mesh gives its extent [m]."""
_LAMP_POSITIONS_M = (
    (-1.1, 2.775, 2.3),
    (-0.5, -1.44, 2.3),
    (2.4, -1.6, 2.3),
    (2.5, -6.1, 2.3),
    (3.14, 3.24, 3.0),
)
"""Positions of the lamps [m] (ManiSkill's ReplicaCAD scene builder)."""


def open_replica_cad(
    folder: Path,
    scenes: tuple[str, ...] = (),
    stage: StageRequest | None = None,
    articulate: tuple[str, ...] = (),
) -> Pack:
    """Read the data set as a pack.

    Args:
        folder: folder of the data set; the objects are read from a folder ``ycb`` in it or beside it, else the built-in
            ones are used.
        scenes: names of scenes, or patterns such as ``apt_*``; () for all staged ones.
        stage: which walls the homes get; None for those of the stages that the scenes name, where these exist.
        articulate: furniture that opens besides kitchen counter and fridge, keys of `furniture.OPTIONAL`.

    Raises:
        UsageError: the data set is incomplete, a file is broken or missing, or a name is unknown; the message names it.
    """
    for name in articulate:
        if name not in OPTIONAL:
            raise unknown_name("furniture to articulate", name, OPTIONAL)
    check_folder(folder)
    names = sorted(
        p.name.removesuffix(SCENE_SUFFIX)
        for p in (folder / "configs" / "scenes").glob("*" + SCENE_SUFFIX)
    )
    chosen = (
        _named(scenes, names)
        if scenes
        else [name for name in names if STAGED.fullmatch(name)]
    )
    if not chosen:
        raise fault(
            folder / "configs" / "scenes",
            f"has no staged scene (v3_sc*_staging_*); {HOW_TO_GET}.",
        )
    # All of them, even if few are asked for: a stand-in must not depend on which homes are opened.
    staged = tuple(name for name in names if STAGED.fullmatch(name))
    stages = Stages(folder, stage or StageRequest())
    reader = _Scenes(folder, Furniture(folder, articulate), stages, staged)
    # Before the furniture is looked at, which is read as homes name it.
    homes = tuple(reader.home(name) for name in chosen)
    furniture = reader.furniture
    if reader.loose:
        where = (
            f"{len(reader.loose)} scenes ({reader.loose[0]}, ...)"
            if len(reader.loose) > 1
            else reader.loose[0]
        )
        warn_once(
            f"{folder}: objects that may move in {where} (motion_type DYNAMIC) stand fixed here, as furniture."
        )
    _warn(folder, stages.missing, stages.consequence())
    _warn(folder, furniture.missing, "their collision shapes are drawn instead")
    objects, meshes = _objects(folder)
    pack = Pack(
        "replica_cad",
        furniture.props,
        furniture.articulations,
        homes,
        objects,
        {**furniture.meshes, **furniture.looks.meshes(), **meshes},
        stage=stages.kind,
    )
    if stages.kind == STAND_IN:
        homes = _limited(homes, pack)
    pack = replace(pack, homes=homes, roles=present_roles(pack, ROLES))
    return check_pack(pack, folder)


def _limited(homes: tuple[Home, ...], pack: Pack) -> tuple[Home, ...]:
    """Homes with the limits of doors that open toward a wall, which would else pass through it, and start in it."""
    limits = wall_limits(homes, pack)
    return tuple(
        replace(home, open_limits=found)
        for home, found in zip(homes, limits, strict=True)
    )


def _warn(folder: Path, missing: list[Path], meaning: str) -> None:
    """Log a warning, once per process, that files are missing and what the consequence is."""
    names = [
        str(file.relative_to(folder)) if file.is_relative_to(folder) else str(file)
        for file in missing
    ]
    if missing:
        warn_once(f"{folder}: {', '.join(names)} missing: {meaning}.")


def _named(wanted: tuple[str, ...], names: list[str]) -> list[str]:
    """Scenes that match names or patterns, sorted.

    Raises:
        UsageError: one of them matches none.
    """
    found: set[str] = set()
    for pattern in wanted:
        fitting = fnmatch.filter(names, pattern)
        if not fitting:
            raise unknown_name("scene", pattern, names)
        found.update(fitting)
    return sorted(found)


def _objects(folder: Path) -> tuple[dict[str, ObjectType], dict[str, Any]]:
    # `mjhab assets fetch` puts data sets side by side.
    for place in (folder / "ycb", folder.parent / "ycb"):
        if place.is_dir():
            files = sorted(place.glob("*/*.glb"))
            types, meshes = _scans(place, tuple((f, file_state(f)) for f in files))
            return dict(types), dict(meshes)
    return builtin_objects(), dict(object_meshes())


@functools.lru_cache(maxsize=1)
def _scans(
    place: Path, files: tuple[tuple[Path, tuple[int, int]], ...]
) -> tuple[dict[str, ObjectType], dict[str, Any]]:
    """The objects of a folder whose files have these sizes and times.

    Packs of other scenes or of another stage have the same objects, and reading them takes two seconds.
    """
    from mjhab.scenes.replica_cad.ycb import read_ycb

    return read_ycb(place)


MAX_INSTANCES = 1000
"""Largest number of rigid, and of articulated, pieces in a scene; scenes of ReplicaCAD have up to 120."""


@dataclass(eq=False)
class _Scenes:
    """Read scene files as homes. ``staged``: names of all staged scenes of the data set."""

    folder: Path
    furniture: Furniture
    stages: Stages
    staged: tuple[str, ...]
    loose: list[str] = field(default_factory=list)
    """Scenes with dynamic objects."""

    def home(self, name: str) -> Home:
        path = self.folder / "configs" / "scenes" / (name + SCENE_SUFFIX)
        body = load_json(path)
        props = []
        jointed = []
        # Counted before anything is read: a file from elsewhere may be of any length.
        for kind in ("object_instances", "articulated_object_instances"):
            count = len(_list(path, body, kind))
            if count > MAX_INSTANCES:
                raise fault(
                    path,
                    f"field {kind!r} has {count:,} entries; at most {MAX_INSTANCES} fit into a home.",
                )
        for k, record in enumerate(_list(path, body, "object_instances")):
            where = f"object_instances[{k}]"
            piece = self.furniture.rigid(template(path, record, where))
            props.append(placement(path, record, piece, where))
        if any(
            record.get("motion_type") == "DYNAMIC"
            for record in _list(path, body, "object_instances")
        ):
            self.loose.append(name)
        for k, record in enumerate(_list(path, body, "articulated_object_instances")):
            where = f"articulated_object_instances[{k}]"
            given = template(path, record, where)
            # Doors between rooms are left out, as in ManiSkill's scene builder: shut, they would block half the home.
            if "door" in short_name(given):
                continue
            at = placement(path, record, short_name(given), where)
            at = self.furniture.jointed(given, _scale(path, record, where), at)
            (jointed if at.template in self.furniture.articulations else props).append(at)
        for place in jointed:
            if sum(other.template == place.template for other in jointed) > 1:
                raise fault(
                    path,
                    f"more than one {place.template!r}; a home may have one of each that opens.",
                )
        found = STAGED.fullmatch(name)
        group = self.staged if found else (name,)
        walls, extent = self.stages.shape(path, body, group) or ((), None)
        macro, micro = (int(found[1]), int(found[2])) if found else (0, 0)
        split: Literal["train", "val", "test"] = (
            "train" if macro < 3 else "val" if macro == 3 else "test"
        )
        # Without a stage nothing in a scene says how large the floor is.
        extent = extent or self._extent(name, [*props, *jointed])
        return Home(
            name,
            "replica_cad",
            split,
            macro,
            micro,
            walls,
            extent,
            FLOOR_MATERIAL,
            tuple(props),
            tuple(jointed),
            tuple(Light(pos) for pos in _LAMP_POSITIONS_M),
        )

    def _extent(self, name: str, placed: list[Placement]) -> Extent:
        """Floor extent of a home without stage: that of its navigation mesh, else of its furniture with a margin."""
        mesh = self.folder / "navmeshes" / f"{name}.navmesh"
        if mesh.is_file():
            return read_navmesh(mesh).bounds
        points = []
        for at in placed:
            template = (
                self.furniture.props.get(at.template)
                or self.furniture.articulations[at.template]
            )
            local = np.concatenate(
                [outline(g, self.furniture.meshes) for g in template.geoms if g.collide]
            )
            points.append(
                local @ mat_from_quat(np.array(at.rotation)).T + np.array(at.pos)
            )
        corners = (
            np.concatenate(points)[:, :2]
            if points
            else np.array([[-3.0, -3.0], [3.0, 3.0]])
        )
        low = corners.min(0) - _FLOOR_MARGIN_M
        high = corners.max(0) + _FLOOR_MARGIN_M
        return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def _scale(path: Path, record: dict[str, Any], where: str) -> float:
    return number(
        path, {"uniform_scale": 1.0, **record}, "uniform_scale", where, positive=True
    )


def _list(path: Path, body: dict[str, Any], key: str) -> list[Any]:
    value = body.get(key, [])
    if not isinstance(value, list):
        raise fault(path, f"field {key!r}: expected a list.")
    return value
