"""Packs stored in a folder: ``pack.json`` (templates, homes, objects) and ``meshes.npz`` (arrays, no pickles)."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np

from mjhab.core.errors import about, fault
from mjhab.core.files.arrays import open_arrays
from mjhab.core.files.cache import write_atomic, write_text
from mjhab.core.files.reading import read_json_object
from mjhab.core.typed.options import read_record
from mjhab.scenes.pack_check import check_pack
from mjhab.scenes.pack_source import PackRequest, PackSource
from mjhab.scenes.roles import check_roles, present_roles
from mjhab.scenes.shapes.meshes import Mesh, mesh_arrays, mesh_from_arrays
from mjhab.scenes.spec import Articulation, Home, ObjectType, Pack, Prop, Roles

PACK_FORMAT = "mjhab-pack-1"
_JSON = "pack.json"
_MESHES = "meshes.npz"
MAX_MESHES_MB = 2048
"""Largest uncompressed size of the meshes of a pack [MB]; those of all 84 homes of ReplicaCAD take 49."""


def save_pack(pack: Pack, folder: Path) -> None:
    """Write a pack into ``folder`` (created if missing), from which `load_pack` reads an equal pack.

    Roles of furniture that the pack does not have are left out. A pack in the folder is replaced; ``pack.json`` is
    deleted first, written last and renamed into place, so that a folder that has it is complete.
    """
    arrays: dict[str, np.ndarray] = {}
    for name, mesh in pack.meshes.items():
        assert isinstance(mesh, Mesh)
        arrays |= mesh_arrays(name, mesh)
    body = {
        "format": PACK_FORMAT,
        "name": pack.name,
        "meshes": sorted(pack.meshes),
        "props": [dataclasses.asdict(p) for p in pack.props.values()],
        "articulations": [dataclasses.asdict(a) for a in pack.articulations.values()],
        "homes": [dataclasses.asdict(h) for h in pack.homes],
        "objects": [dataclasses.asdict(o) for o in pack.objects.values()],
        "roles": dataclasses.asdict(present_roles(pack, pack.roles)),
        "stage": pack.stage,
    }
    # Before anything is deleted: a pack that cannot be written leaves the one before as it was.
    text = json.dumps(body)
    # That of a pack before would not fit the new meshes.
    (folder / _JSON).unlink(missing_ok=True)
    write_atomic(
        folder / _MESHES,
        lambda temporary: np.savez_compressed(temporary, **arrays),  # type: ignore[arg-type]
    )
    write_text(folder / _JSON, text)


def load_pack(folder: Path) -> Pack:
    """Read a pack folder.

    Raises:
        UsageError: a file is missing, broken or of another format, or has invalid names or numbers (`check_pack`); the
            message names the file and the field.
    """
    # Both at once, because the usual mistake is the folder of another data set.
    for needed in (_JSON, _MESHES):
        if not (folder / needed).is_file():
            raise fault(
                f"asset folder '{folder}'",
                f"has no {needed}; a pack folder must hold {_JSON} and {_MESHES} "
                "as written by mjhab.scenes.pack_folder.save_pack. It is no ReplicaCAD data set either (no "
                "configs/scenes, configs/objects); `mjhab assets fetch replica_cad` gets one.",
            )
    path = folder / _JSON
    body = read_json_object(path)
    if body.get("format") != PACK_FORMAT:
        raise fault(
            path,
            f"field 'format' must be {PACK_FORMAT!r}; this is not a pack of this version.",
        )
    try:
        props = {p.name: p for p in read_record(tuple[Prop, ...], body["props"], "props")}
        articulations = {
            a.name: a
            for a in read_record(
                tuple[Articulation, ...], body["articulations"], "articulations"
            )
        }
        objects = {
            o.name: o
            for o in read_record(tuple[ObjectType, ...], body["objects"], "objects")
        }
        homes = read_record(tuple[Home, ...], body["homes"], "homes")
        names = read_record(tuple[str, ...], body["meshes"], "meshes")
        pack = Pack(
            read_record(str, body["name"], "name"),
            props,
            articulations,
            homes,
            objects,
            _read_meshes(folder / _MESHES, names),
            read_record(Roles, body.get("roles", {}), "roles"),
            read_record(str, body.get("stage", ""), "stage"),
        )
    # A missing field of the document; those of records are reported by `read_record`.
    except KeyError as error:
        raise fault(path, f"field {error} is missing.") from error
    except ValueError as error:
        raise fault(path, str(error)) from error
    _check_names(pack, path)
    with about(path):
        check_roles(pack)
    return check_pack(pack, path)


def _read_meshes(path: Path, names: tuple[str, ...]) -> dict[str, object]:
    with open_arrays(path, "file of the meshes of a pack", MAX_MESHES_MB) as arrays:
        return {name: mesh_from_arrays(name, arrays) for name in names}


def _check_names(pack: Pack, path: Path) -> None:
    """Check that the pack has every template and mesh that its homes and geoms name."""
    for home in pack.homes:
        for what, placed, known in (
            ("props", home.props, pack.props),
            ("articulations", home.articulations, pack.articulations),
        ):
            for p in placed:
                if p.template not in known:
                    raise fault(
                        path,
                        f"home {home.name!r}, {what}: template {p.template!r} is not in the pack.",
                    )
    links = [link for a in pack.articulations.values() for link in a.links]
    groups = [
        *(t.geoms for t in pack.props.values()),
        *(t.geoms for t in pack.articulations.values()),
        *(link.geoms for link in links),
        *(o.collision + o.visuals for o in pack.objects.values()),
        *(h.walls + h.floor_patches for h in pack.homes),
    ]
    for geom in (g for group in groups for g in group):
        if geom.shape == "mesh" and geom.mesh not in pack.meshes:
            raise fault(
                path, f"a geom names the mesh {geom.mesh!r}, which is not in the pack."
            )


def _open(request: PackRequest) -> Pack:
    return load_pack(Path(request.place))


def _finds(place: str) -> bool:
    return any((Path(place) / name).is_file() for name in (_JSON, _MESHES))


SOURCE = PackSource("folder", _open, _finds)
