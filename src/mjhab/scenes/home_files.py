"""Reader of home files: JSON or Python files with floor, walls, built-in furniture and roles.

`HomeFile` and the classes of its fields define the format; ``docs/extending.md`` describes it.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import runpy
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

from mjhab.core.errors import (
    MjhabError,
    about,
    fault,
    missing_field,
    unknown_name,
    wrong_value,
)
from mjhab.core.files.reading import read_bytes, read_json
from mjhab.core.names import check_name
from mjhab.core.registration.plugins import raised_text
from mjhab.core.typed.checks import check, check_one_of
from mjhab.core.typed.options import fitting, read_record
from mjhab.scenes.builtin.furniture import (
    builtin_articulations,
    builtin_props,
    furniture_meshes,
)
from mjhab.scenes.builtin.materials import MATERIALS
from mjhab.scenes.builtin.objects import builtin_objects, object_meshes
from mjhab.scenes.builtin.pack import ROLES
from mjhab.scenes.home_checks import check_home
from mjhab.scenes.pack_check import check_pack
from mjhab.scenes.pack_source import HOME_SUFFIXES, PackRequest, PackSource
from mjhab.scenes.replica_cad.files import SCENE_SUFFIX
from mjhab.scenes.roles import present_roles
from mjhab.scenes.shapes.shapes import span
from mjhab.scenes.spec import (
    Geom,
    Home,
    Light,
    Pack,
    Placement,
    Prop,
    Receptacle,
    Roles,
    Vec3,
)

FORMAT = "mjhab-home-1"
PYTHON_NAME = "HOME"
"""Variable of a Python file that has the data of a JSON file."""
LAMP_HEIGHT_M = 2.4
MIN_WALL_PIECE_M = 0.01
"""Pieces of wall shorter than this, between a doorway and the end of the wall, are left out."""


@dataclass(frozen=True)
class FileFloor:
    """``size``: inside extent of the home along x and y [m], from the origin; ``material``: a name of `MATERIALS`."""

    size: tuple[float, float]
    material: str = "floor_oak"


@dataclass(frozen=True)
class FileWall:
    """A straight inner wall between ``start`` and ``end`` (x, y) [m]; ``doorways``: (from, to) [m] along it."""

    start: tuple[float, float]
    end: tuple[float, float]
    doorways: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class FileWalls:
    """``outer``: material of the four walls around the floor; ``inner``: further walls, of ``inner_material``.

    ``height``, ``thickness``: of all walls [m].
    """

    outer: str
    inner: tuple[FileWall, ...] = ()
    inner_material: str = "wall_white"
    height: float = 2.6
    thickness: float = 0.12


@dataclass(frozen=True)
class FilePiece:
    """A piece of furniture: template ``kind`` of the built-in pack, position ``at`` (x, y) of its origin [m], and the
    heading of its front."""

    kind: str
    at: tuple[float, float]
    yaw_degrees: float = 0.0


@dataclass(frozen=True)
class FileReceptacle:
    """A receptacle of a kind of furniture, and its roles in addition to those in the built-in pack.

    Without ``center`` it is the existing receptacle of this name. With ``center`` it is a new one: ``center`` of its
    surface [m] in the frame of the furniture (origin on the floor under its middle, +x to its front), half-extents
    ``half`` (x, y) [m], and free height ``height`` above it [m].
    """

    furniture: str
    name: str
    roles: tuple[str, ...] = ()
    center: Vec3 | None = None
    half: tuple[float, float] | None = None
    height: float = 0.5


@dataclass(frozen=True)
class HomeFile:
    """Content of a home file.

    ``default_roles``: furniture has its roles of the built-in pack as well. ``lights``: positions of lamps [m]; () for
    one in the middle.
    """

    format: Literal["mjhab-home-1"]
    name: str
    floor: FileFloor
    walls: FileWalls
    furniture: tuple[FilePiece, ...]
    receptacles: tuple[FileReceptacle, ...] = ()
    default_roles: bool = True
    lights: tuple[Vec3, ...] = ()
    split: Literal["train", "val", "test"] = "train"
    note: str = ""


def home_pack(*files: Path | str, name: str = "") -> Pack:
    """Make a pack of homes from files, with the built-in furniture and objects.

    Args:
        files: at least one ``.json`` or ``.py`` file.
        name: name of the pack; "" takes that of the first home.

    Raises:
        UsageError: a file is missing or broken, names unknown furniture or material, has numbers out of bounds, no
            walls, overlapping pieces, or a receptacle with a role out of a robot's reach; or two files have the same
            name, or define a receptacle differently. The message names file and field.

    Example:
        >>> pack = mjhab.home_pack("examples/home/cottage.json")
        >>> mjhab.register_pack(mjhab.PackSource("cottage", lambda request: pack))
    """
    check(bool(files), "home files", files, "one or more")
    places = [Path(fitting("home file", str, file)) for file in files]
    read = [(place, read_home_file(place)) for place in places]
    pack_name = fitting("name of the pack", str, name) or read[0][1].name
    pack = Pack(
        pack_name,
        builtin_props(),
        builtin_articulations(),
        (),
        builtin_objects(),
        {**furniture_meshes(), **object_meshes()},
    )
    # Receptacles of all files first: homes of one pack share their furniture.
    for file, stated in read:
        _check_names(pack, stated, file)
        pack = _with_receptacles(pack, stated, file)
    pack = dataclasses.replace(pack, roles=present_roles(pack, ROLES))
    for file, stated in read:
        if stated.name in {home.name for home in pack.homes}:
            raise fault(file, f"another home of the pack is called {stated.name!r}, too.")
        home = _home(pack, stated, file)
        check_home(file, pack, home)
        pack = dataclasses.replace(pack, homes=(*pack.homes, home))
    return check_pack(pack, places[0])


def read_home_file(file: Path) -> HomeFile:
    """Read a file and check the types of its fields, but not whether a home can be made from it.

    Raises:
        UsageError: the file is missing or broken, or a field is missing, unknown or of another type.
    """
    body = _body(file)
    if not isinstance(body, dict) or body.get("format") != FORMAT:
        given = body.get("format") if isinstance(body, dict) else body
        raise wrong_value(
            "format", given, repr(FORMAT), "This is no home file of this version.", file
        )
    if "walls" not in body:
        least = '"walls": {"outer": "wall_white"}'
        advice = f"A home has walls around its floor. At least: {least}."
        raise missing_field("walls", file, advice)
    with about(file):
        stated: HomeFile = read_record(HomeFile, body, "home")
        check_name("home.name", stated.name)
    return stated


def _body(file: Path) -> Any:
    """The data of a JSON file, or of the variable `PYTHON_NAME` of a Python file."""
    check(
        file.suffix in HOME_SUFFIXES,
        "name of a home file",
        file.name,
        f"one that ends with {' or '.join(HOME_SUFFIXES)}",
    )
    if file.suffix == ".json":
        return read_json(file)
    # Read once for its checks: running it would report a missing file less clearly.
    read_bytes(file)
    try:
        found = runpy.run_path(str(file))
    except MjhabError as error:
        raise fault(file, str(error)) from error
    # The file is the user's code and may raise anything.
    except (Exception, SystemExit) as error:
        raise fault(file, f"running it raised {raised_text(error)}.") from error
    if PYTHON_NAME not in found:
        raise fault(file, f"has no variable {PYTHON_NAME}, which holds the home.")
    try:
        # Through JSON, so that both kinds of file are checked alike, and tuples become lists.
        return json.loads(json.dumps(found[PYTHON_NAME]))
    except (TypeError, ValueError) as error:
        raise fault(file, f"{PYTHON_NAME} is no plain data ({error}).") from error


def _check_names(pack: Pack, stated: HomeFile, file: Path) -> None:
    """Check that furniture and materials exist.

    Raises:
        UsageError: one does not; the message names file and field.
    """
    kinds = (*pack.props, *pack.articulations)
    for k, piece in enumerate(stated.furniture):
        check_one_of("furniture", piece.kind, kinds, where=f"{file}: furniture[{k}].kind")
    for field, material in (
        ("floor.material", stated.floor.material),
        ("walls.outer", stated.walls.outer),
        ("walls.inner_material", stated.walls.inner_material),
    ):
        check_one_of("material", material, MATERIALS, where=f"{file}: {field}")


def _with_receptacles(pack: Pack, stated: HomeFile, file: Path) -> Pack:
    """The pack with the new receptacles of a file added to its furniture."""
    props = dict(pack.props)
    articulations = dict(pack.articulations)
    for k, record in enumerate(stated.receptacles):
        where = f"{file}: receptacles[{k}]"
        templates: dict[str, Any] = props if record.furniture in props else articulations
        known = sorted({piece.kind for piece in stated.furniture})
        if record.furniture not in known or record.furniture not in templates:
            raise unknown_name(
                "furniture of this home",
                record.furniture,
                known,
                where=f"{where}.furniture",
            )
        template: Prop = templates[record.furniture]
        present = next((r for r in template.receptacles if r.name == record.name), None)
        if record.center is None:
            if present is None:
                names = [r.name for r in template.receptacles]
                kind = f"receptacle of {record.furniture!r}, without center and half,"
                raise unknown_name(kind, record.name, names, where=f"{where}.name")
            continue
        new = _new_receptacle(record, where)
        # The same receptacle may stand in the files of several homes.
        if present not in (None, new):
            raise fault(
                where,
                f"{record.furniture!r} has another receptacle {record.name!r} already; choose another name.",
            )
        if present is None:
            templates[record.furniture] = dataclasses.replace(
                template, receptacles=(*template.receptacles, new)
            )
    return dataclasses.replace(pack, props=props, articulations=articulations)


def _new_receptacle(record: FileReceptacle, where: str) -> Receptacle:
    if record.center is None or record.half is None:
        raise fault(where, "a new receptacle needs both center and half.")
    check_name(f"{where}.name", record.name)
    return Receptacle(record.name, record.center, record.half, record.height)


def _home(pack: Pack, stated: HomeFile, file: Path) -> Home:
    placements = [
        Placement(piece.kind, (*piece.at, 0.0), math.radians(piece.yaw_degrees))
        for piece in stated.furniture
    ]
    width, depth = stated.floor.size
    lights = stated.lights or ((width / 2, depth / 2, LAMP_HEIGHT_M),)
    return Home(
        stated.name,
        pack.name,
        stated.split,
        0,
        0,
        _walls(stated, file),
        (0.0, 0.0, width, depth),
        stated.floor.material,
        tuple(p for p in placements if p.template not in pack.articulations),
        tuple(p for p in placements if p.template in pack.articulations),
        tuple(Light(pos) for pos in lights),
        note=stated.note,
        roles=_roles(pack, stated),
    )


def _roles(pack: Pack, stated: HomeFile) -> Roles | None:
    """The roles of a home; None if it has those of the pack."""
    if stated.default_roles and not any(record.roles for record in stated.receptacles):
        return None
    places = dict(pack.roles.places) if stated.default_roles else {}
    for record in stated.receptacles:
        for role in record.roles:
            places[role] = (*places.get(role, ()), f"{record.furniture}/{record.name}")
    return dataclasses.replace(pack.roles, places=places)


def _walls(stated: HomeFile, file: Path) -> tuple[Geom, ...]:
    width, depth = stated.floor.size
    walls = stated.walls
    t = walls.thickness
    z = (0.0, walls.height)
    outer = (
        span((-t, width + t), (-t, 0.0), z, walls.outer),
        span((-t, width + t), (depth, depth + t), z, walls.outer),
        span((-t, 0.0), (0.0, depth), z, walls.outer),
        span((width, width + t), (0.0, depth), z, walls.outer),
    )
    inner = [
        geom
        for k, wall in enumerate(walls.inner)
        for geom in _inner_wall(wall, walls, f"{file}: walls.inner[{k}]")
    ]
    return (*outer, *inner)


def _inner_wall(wall: FileWall, walls: FileWalls, where: str) -> list[Geom]:
    """Box geoms of an inner wall, between its doorways."""
    along = (wall.end[0] - wall.start[0], wall.end[1] - wall.start[1])
    length = math.hypot(*along)
    stops = [0.0, *(stop for doorway in wall.doorways for stop in doorway), length]
    if length <= 0.0 or any(b < a for a, b in itertools.pairwise(stops)):
        raise wrong_value(
            "doorways",
            [list(doorway) for doorway in wall.doorways],
            f"in order between 0 and the length of the wall, {length:.2f} m",
            where=where,
        )
    ux = along[0] / length
    uy = along[1] / length
    yaw = math.atan2(uy, ux)
    quat = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
    pieces = []
    for a, b in zip(stops[::2], stops[1::2], strict=True):
        # A doorway at the end of a wall leaves a piece of no length.
        if b - a < MIN_WALL_PIECE_M:
            continue
        middle = (a + b) / 2
        center = (
            wall.start[0] + ux * middle,
            wall.start[1] + uy * middle,
            walls.height / 2,
        )
        half = ((b - a) / 2, walls.thickness / 2, walls.height / 2)
        pieces.append(Geom("box", half, center, quat, walls.inner_material))
    return pieces


@lru_cache(maxsize=8)
def _opened(file: Path, changed_ns: int) -> Pack:
    return home_pack(file)


def _open(request: PackRequest) -> Pack:
    file = Path(request.place).resolve()
    # By its time of change as well, since people edit such a file between runs in one process.
    return _opened(file, file.stat().st_mtime_ns)


def is_home_file(place: str) -> bool:
    """Return whether a path is a file with the suffix of home files, but no scene file of ReplicaCAD."""
    path = Path(place)
    return (
        path.suffix in HOME_SUFFIXES
        # Scenes of ReplicaCAD are JSON files, too.
        and not place.endswith(SCENE_SUFFIX)
        and path.is_file()
    )


SOURCE = PackSource("home_file", _open, is_home_file)
