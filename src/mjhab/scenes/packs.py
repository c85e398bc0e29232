"""Asset packs: the built-in one, made by code, the ReplicaCAD data set, and packs kept in a folder.

A pack folder holds ``pack.json`` (templates, homes, objects) and ``meshes.npz`` (arrays, no pickles).
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import types
import typing
import zipfile
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from mjhab.core.errors import UsageError, unknown_name
from mjhab.scenes.builtin.furniture import builtin_articulations, builtin_props, furniture_meshes
from mjhab.scenes.builtin.homes import builtin_homes
from mjhab.scenes.builtin.objects import builtin_objects, object_meshes
from mjhab.scenes.pack_check import check_pack
from mjhab.scenes.replica_cad.files import SCENE_SUFFIX, is_replica_cad
from mjhab.scenes.shapes.meshes import Mesh, mesh_arrays, mesh_from_arrays
from mjhab.scenes.spec import Articulation, Home, ObjectType, Pack, Prop

PACK_FORMAT = "mjhab-pack-1"
_JSON = "pack.json"
_MESHES = "meshes.npz"
_JOINTS = "?articulate="
_STAGE = "?stage="


def open_pack(name: str) -> Pack:
    """Open an asset pack.

    Args:
        name: ``"builtin"``; or the path of a ReplicaCAD data set (or of the folder that holds it as ``replica_cad``),
            of one ``*.scene_instance.json`` of it; or that path with names of scenes behind it
            (``replica_cad/apt_0``, ``replica_cad/apt_*``); or a folder that ``save_pack`` wrote. Behind a
            ReplicaCAD path ``?articulate=cabinet`` lets more furniture open (see ``with_joints``), and then
            ``?stage=FILE`` takes that ``.glb`` as the stage of every scene (see ``with_stage``).

    Raises:
        UsageError: nothing of that; the message says what the folder lacks or which names exist.
    """
    if name == "builtin":
        return builtin_pack()
    place, _, stage = name.partition(_STAGE)
    place, _, joints = place.partition(_JOINTS)
    folder = Path(place)
    scene = ""
    if place.endswith(SCENE_SUFFIX) and folder.is_file():
        folder, scene = folder.resolve().parents[2], folder.name.removesuffix(SCENE_SUFFIX)
    elif not folder.exists() and any(
        map(is_replica_cad, (folder.parent, folder.parent / "replica_cad"))
    ):
        folder, scene = folder.parent, folder.name
        folder = folder if is_replica_cad(folder) else folder / "replica_cad"
    for data_set in (folder, folder / "replica_cad"):
        if scene or is_replica_cad(data_set):
            opening = tuple(filter(None, joints.split(",")))
            return _replica_cad(data_set.resolve(), scene, Path(stage) if stage else None, opening)
    if stage or joints:
        what = "a stage mesh means" if stage else "furniture to articulate means"
        raise UsageError(f"{place!r} is not a ReplicaCAD folder: {what} nothing to it.")
    if folder.is_dir():
        return load_pack(folder)
    if folder.exists():
        raise UsageError(
            f"asset pack {name!r} is a file; expected 'builtin' or a folder with {_JSON} and {_MESHES}."
        )
    looks_like_path = any(sep and sep in name for sep in (os.sep, os.altsep, "/"))
    if looks_like_path:
        raise UsageError(
            f"asset folder {name!r} does not exist; expected 'builtin' or a folder with {_JSON}."
        )
    raise unknown_name("asset pack", name, ("builtin",))


def with_stage(assets: str, stage_mesh: Path | None) -> str:
    """The name of an asset pack with another stage mesh, for ``open_pack``; None leaves it as it is.

    Raises:
        UsageError: the file does not exist.
    """
    if stage_mesh is None:
        return assets
    if not stage_mesh.is_file():
        raise UsageError(f"stage mesh {str(stage_mesh)!r} does not exist.")
    return f"{assets}{_STAGE}{stage_mesh}"


def with_joints(assets: str, furniture: str | None) -> str:
    """The name of a ReplicaCAD pack in which more furniture opens, for ``open_pack``; None leaves it as it is.

    Use it before ``with_stage``.

    Args:
        assets: path of the data set.
        furniture: names with commas between them: kitchen_cupboards, cabinet, chest_of_drawers.

    Raises:
        UsageError: an unknown name.
    """
    if not furniture:
        return assets
    from mjhab.scenes.replica_cad.furniture import OPTIONAL

    names = furniture.split(",")
    for name in names:
        if name not in OPTIONAL:
            raise unknown_name("furniture to articulate", name, OPTIONAL)
    return f"{assets}{_JOINTS}{','.join(sorted(set(names)))}"


@lru_cache(maxsize=4)
def _replica_cad(
    folder: Path, scene: str, stage_mesh: Path | None, articulate: tuple[str, ...]
) -> Pack:
    from mjhab.scenes.replica_cad.reader import open_replica_cad

    return open_replica_cad(folder, scene, stage_mesh, articulate)


@cache
def builtin_pack() -> Pack:
    """The pack made by code; always the same."""
    return Pack(
        "builtin",
        builtin_props(),
        builtin_articulations(),
        builtin_homes(),
        builtin_objects(),
        {**furniture_meshes(), **object_meshes()},
    )


def save_pack(pack: Pack, folder: Path) -> None:
    """Write a pack into ``folder`` (made if missing); ``load_pack`` gives an equal pack back.

    ``pack.json`` is written last and put in place by a rename, so a folder that has it is complete.
    """
    folder.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, np.ndarray] = {}
    for name, mesh in pack.meshes.items():
        assert isinstance(mesh, Mesh)
        arrays |= mesh_arrays(name, mesh)
    np.savez_compressed(folder / _MESHES, **arrays)  # type: ignore[arg-type]
    body = {
        "format": PACK_FORMAT,
        "name": pack.name,
        "meshes": sorted(pack.meshes),
        "props": [dataclasses.asdict(p) for p in pack.props.values()],
        "articulations": [dataclasses.asdict(a) for a in pack.articulations.values()],
        "homes": [dataclasses.asdict(h) for h in pack.homes],
        "objects": [dataclasses.asdict(o) for o in pack.objects.values()],
    }
    partial = folder / (_JSON + ".part")
    partial.write_text(json.dumps(body))
    partial.replace(folder / _JSON)


def load_pack(folder: Path) -> Pack:
    """Read a pack folder.

    Raises:
        UsageError: a file is missing, broken or of another format, or holds names or numbers that no home can be made
            of (`check_pack`); names the file and the field.
    """
    for needed in (_JSON, _MESHES):
        if not (folder / needed).is_file():
            raise UsageError(
                f"asset folder '{folder}' has no {needed}; a pack folder must hold {_JSON} and {_MESHES} "
                "as written by mjhab.scenes.packs.save_pack. It is no ReplicaCAD data set either (no configs/scenes, "
                "configs/objects); `mjhab assets fetch replica_cad` gets one."
            )
    path = folder / _JSON
    try:
        body = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: not valid JSON ({error}); write the pack again.") from error
    if not isinstance(body, dict) or body.get("format") != PACK_FORMAT:
        raise UsageError(
            f"{path}: field 'format' must be {PACK_FORMAT!r}; this is not a pack of this version."
        )
    try:
        props = {p.name: p for p in _read(tuple[Prop, ...], body["props"], "props")}
        articulations = {
            a.name: a
            for a in _read(tuple[Articulation, ...], body["articulations"], "articulations")
        }
        objects = {o.name: o for o in _read(tuple[ObjectType, ...], body["objects"], "objects")}
        homes = _read(tuple[Home, ...], body["homes"], "homes")
        names = _read(tuple[str, ...], body["meshes"], "meshes")
        pack = Pack(
            _read(str, body["name"], "name"),
            props,
            articulations,
            homes,
            objects,
            _read_meshes(folder / _MESHES, names),
        )
    except KeyError as error:
        raise UsageError(f"{path}: field {error} is missing.") from error
    except ValueError as error:
        raise UsageError(f"{path}: {error}") from error
    _check_names(pack, path)
    return check_pack(pack, path)


def _read_meshes(path: Path, names: tuple[str, ...]) -> dict[str, object]:
    meshes: dict[str, object] = {}
    try:
        with np.load(path, allow_pickle=False) as arrays:
            for name in names:
                for part in ("vertices", "faces"):
                    if f"{name}/{part}" not in arrays:
                        raise UsageError(f"{path}: array '{name}/{part}' is missing.")
                meshes[name] = mesh_from_arrays(name, arrays)
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise UsageError(f"{path}: cannot be read ({error}); write the pack again.") from error
    return meshes


def _check_names(pack: Pack, path: Path) -> None:
    """Every name that a home or a geom uses must exist in the pack."""
    for home in pack.homes:
        for what, placed, known in (
            ("props", home.props, pack.props),
            ("articulations", home.articulations, pack.articulations),
        ):
            for p in placed:
                if p.template not in known:
                    raise UsageError(
                        f"{path}: home {home.name!r}, {what}: template {p.template!r} is not in the pack."
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
            raise UsageError(
                f"{path}: a geom names the mesh {geom.mesh!r}, which is not in the pack."
            )


def _read(kind: Any, value: Any, where: str) -> Any:
    """Turn JSON into ``kind``: dataclasses, tuples, literals, numbers, strings.

    Raises:
        ValueError: the value does not fit; the message names the field.
    """
    origin = typing.get_origin(kind)
    args = typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _read_record(kind, value, where)
    if origin is types.UnionType:
        return None if value is None else _read(args[0], value, where)
    if origin is tuple:
        if not isinstance(value, list) or (Ellipsis not in args and len(value) != len(args)):
            raise ValueError(
                f"{where}: expected a list of {'any' if Ellipsis in args else len(args)} entries."
            )
        kinds = [args[0]] * len(value) if Ellipsis in args else list(args)
        return tuple(
            _read(k, v, f"{where}[{i}]") for i, (k, v) in enumerate(zip(kinds, value, strict=True))
        )
    if origin is typing.Literal:
        if value not in args:
            raise ValueError(f"{where}: {value!r} is not one of {', '.join(map(str, args))}.")
        return value
    if kind is float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{where}: expected a number, got {value!r}.")
        number = _float(value)
        if not math.isfinite(number):
            raise ValueError(f"{where}: expected a finite number, got {number}.")
        return number
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise ValueError(f"{where}: expected {kind.__name__}, got {value!r}.")
    return value


def _float(value: int | float) -> float:
    try:
        return float(value)
    except OverflowError:  # an integer of hundreds of digits
        return math.inf


def _read_record(kind: Any, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise ValueError(f"{where}: expected an object with the fields of {kind.__name__}.")
    hints = typing.get_type_hints(kind)
    fields = {f.name: f for f in dataclasses.fields(kind)}
    unknown = sorted(set(value) - set(fields))
    if unknown:
        raise ValueError(f"{where}: unknown field {unknown[0]!r}; fields are {', '.join(fields)}.")
    read = {}
    for name, f in fields.items():
        if name in value:
            read[name] = _read(hints[name], value[name], f"{where}.{name}")
        elif f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING:
            raise ValueError(f"{where}: field {name!r} is missing.")
    return kind(**read)
