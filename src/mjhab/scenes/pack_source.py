"""Requests for asset packs, by name or path, and the registry of the sources that open them."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from mjhab.core.errors import about, fault, unknown_name, wrong_value
from mjhab.core.files.reading import beside
from mjhab.core.names import check_name
from mjhab.core.registration.registry import Registry, check_item
from mjhab.core.typed.checks import check_between, check_one_of
from mjhab.core.typed.flags import Flag
from mjhab.core.typed.options import fitting
from mjhab.scenes.spec import NO_STAGE, OWN_STAGE, STAGES, STAND_IN, Pack

MOST_DOOR_WALLS = 100


@dataclass(frozen=True)
class PackRequest:
    """Which pack to open, and how. A source accepts the options that its `PackSource.options` name, and `OF_ALL_PACKS`.

    Raises:
        UsageError: a field has a value of another type.
    """

    place: str = "builtin"
    """Name of a registered pack such as ``"builtin"``, or a path that one of the registered sources opens."""
    articulate: Annotated[tuple[str, ...], Flag(metavar="NAME ...")] = ()
    """With a ReplicaCAD folder: what opens besides counter and fridge: kitchen_cupboards, cabinet, chest_of_drawers;
    one text may name several, with commas between them."""
    stage_mesh: Annotated[str, Flag(metavar="FILE.glb")] = ""
    """With a ReplicaCAD folder: walls and floor for every home, in place of the stages its scenes
    name; "" for none. With --stage stand-in it is the mesh that stands in."""
    scenes: Annotated[tuple[str, ...], Flag(metavar="NAME|PATTERN ...")] = ()
    """With a ReplicaCAD folder: homes that the pack is to have, or patterns such as 'apt_*'; () for its own choice."""
    stage: Annotated[str, Flag(metavar="own|stand-in|none", shown="stand-in")] = ""
    """With a ReplicaCAD folder, the walls: own (of the stages that the scenes name, none where these are missing),
    stand-in (where they are missing, those of stages/frl_apartment_stage_simple.glb or --stage-mesh, fitted to the
    scenes), or none. By default stand-in; own where --stage-mesh is given, or the folder lacks what a stand-in needs.
    What was recorded without it had own."""
    door_walls: Annotated[int, Flag(metavar="N")] = 0
    """So many further versions of every home of train, in each of which a wall beside a door keeps it from opening
    fully, at a distance of its own (see docs/assets.md). Homes of val and test stay as they are."""

    def __post_init__(self) -> None:
        for name, hint in typing.get_type_hints(type(self)).items():
            value = fitting(name, hint, getattr(self, name), "assets")
            object.__setattr__(self, name, value)
        names = [name for text in self.articulate for name in text.split(",") if name]
        # Sorted and without repeats: the same furniture is the same request.
        object.__setattr__(self, "articulate", tuple(sorted(set(names))))
        check_between("door_walls", self.door_walls, 0, MOST_DOOR_WALLS, where="assets")
        kinds = (OWN_STAGE, STAND_IN, NO_STAGE)
        check_one_of("stage", self.stage or OWN_STAGE, kinds, where="assets")
        if self.stage == NO_STAGE and self.stage_mesh:
            raise wrong_value("stage_mesh", self.stage_mesh, "left out with stage 'none'")

    def __str__(self) -> str:
        """The place, and in brackets the options that differ from their defaults, for messages."""
        parts = [f"articulate: {', '.join(self.articulate)}"] if self.articulate else []
        stage = [self.stage] if self.stage else []
        stage += [self.stage_mesh] if self.stage_mesh else []
        parts += [f"stage: {', '.join(stage)}"] if stage else []
        parts += [f"scenes: {', '.join(self.scenes)}"] if self.scenes else []
        parts += [f"door walls: {self.door_walls}"] if self.door_walls else []
        return f"{self.place} ({'; '.join(parts)})" if parts else self.place

    def given(self) -> tuple[str, ...]:
        """Return the names of the options that differ from their defaults."""
        return tuple(
            f.name
            for f in dataclasses.fields(self)
            if f.name != "place" and getattr(self, f.name) != f.default
        )

    def as_json(self) -> str | dict[str, Any]:
        """Convert to JSON data that `pack_request` reads: the place alone, or a mapping if there are options."""
        given = self.given()
        if not given:
            return self.place
        options = {name: getattr(self, name) for name in given}
        plain = {k: list(v) if isinstance(v, tuple) else v for k, v in options.items()}
        return {"place": self.place, **plain}


OF_ALL_PACKS = frozenset({"door_walls"})
"""Options that sources do not name, because `packs.open_pack` adds what they ask for."""
HOME_SUFFIXES = (".json", ".py")
"""Endings of files that homes are written in (`mjhab.scenes.home_files`)."""
Assets = str | Mapping[str, Any] | PackRequest
"""Accepted forms of a request: name or path, the result of `PackRequest.as_json`, or a `PackRequest`."""


def pack_request(assets: Assets, recorded: bool = False) -> PackRequest:
    """Convert any form of a request to a `PackRequest` that names all that its source would choose.

    Args:
        assets: the request.
        recorded: it was recorded; what it does not name is as it was before there was an option for it.

    Raises:
        UsageError: it has none of the forms of `Assets`, or is a mapping with keys that are no fields of `PackRequest`.
    """
    request = _request(assets)
    if request.place == PackRequest.place:
        # The most frequent one, whose source takes a while to load and completes nothing.
        return request
    source = _source(request.place)
    if source is None or source.complete is None:
        return request
    return source.complete(request, recorded)


def _request(assets: Assets) -> PackRequest:
    """Convert any form of a request to a `PackRequest` of what it names."""
    if isinstance(assets, PackRequest):
        return assets
    if isinstance(assets, str):
        return _from_text(assets)
    if not isinstance(assets, Mapping):
        raise wrong_value(
            "assets", assets, "the name or path of a pack, or a PackRequest"
        )
    names = [f.name for f in dataclasses.fields(PackRequest)]
    for key in assets:
        if key not in names:
            raise unknown_name("field of assets", str(key), names)
    return PackRequest(**assets)


def _from_text(text: str) -> PackRequest:
    """Request for a place, with or without options: ``FOLDER?stage=stand-in``.

    Older recordings have ``FOLDER?articulate=a,b?stage=FILE``.
    """
    place, _, stage = text.partition("?stage=")
    place, _, furniture = place.partition("?articulate=")
    named = stage in STAGES
    return PackRequest(
        place,
        tuple(filter(None, furniture.split(","))),
        stage_mesh="" if named else stage,
        stage=stage if named else "",
    )


@dataclass(frozen=True)
class PackSource:
    """Opens packs of one kind.

    Attributes:
        name: name of the kind; a source without ``finds`` has one pack, of this name.
        open: returns the pack of a request. It should return the same object for equal requests, because data derived
            from a pack is cached per object.
        finds: returns whether this source opens a path; should be fast and must not raise. None for a source that is
            found by name.
        options: fields of `PackRequest` that the source accepts besides ``place``.
        complete: gives options that a request leaves open their values, so that they are recorded. Takes the request,
            and whether it was recorded: then they are those of versions without such an option. None for none.

    Raises:
        UsageError: a field has an invalid value.
    """

    name: str
    open: Callable[[PackRequest], Pack]
    finds: Callable[[str], bool] | None = None
    options: frozenset[str] = frozenset()
    complete: Callable[[PackRequest, bool], PackRequest] | None = None

    def __post_init__(self) -> None:
        check_name("name of a pack source", self.name)
        others = (self.finds, self.complete)
        if not callable(self.open) or not all(f is None or callable(f) for f in others):
            raise fault(
                f"pack source {self.name!r}",
                "open, and finds and complete unless they are None, must be functions.",
            )
        options = fitting(
            "options",
            tuple[str, ...],
            (*self.options,),
            f"pack source {self.name!r}",
        )
        object.__setattr__(self, "options", frozenset(options))


PACK_SOURCES: Registry[PackSource] = Registry(
    "asset pack",
    {
        "builtin": "mjhab.scenes.builtin.pack:SOURCE",
        "styles": "mjhab.scenes.builtin.styles:SOURCE",
        "replica_cad": "mjhab.scenes.replica_cad.pack:SOURCE",
        "folder": "mjhab.scenes.pack_folder:SOURCE",
        "home_file": "mjhab.scenes.home_files:SOURCE",
    },
)


def register_pack(source: PackSource) -> PackSource:
    """Register a pack, or a kind of packs on disk, for the option ``assets`` of environments and commands.

    Returns:
        ``source``.

    Raises:
        UsageError: a source of that name is registered already, or the source has options that do not exist.
    """
    check_item("register_pack", source, PackSource)
    known = {f.name for f in dataclasses.fields(PackRequest)} - {"place"}
    for option in source.options:
        check_one_of("option", option, known, where=f"pack {source.name!r}")
    return PACK_SOURCES.add(source.name, source)


def source_of(request: PackRequest) -> PackSource | None:
    """Find the source that opens a request; None if there is none.

    Raises:
        UsageError: the source does not accept an option of the request, or the place is not a valid path.
    """
    found = _source(request.place)
    if found is not None:
        _check_options(found, request)
    return found


def _source(place: str) -> PackSource | None:
    """The source that opens a place; None if there is none.

    Raises:
        UsageError: no file can have this name.
    """
    with about("assets"):
        # Refuses places that no file system takes, such as one with a null character.
        beside(Path(), place)
    # Names come before paths: a folder called "builtin" must not hide the pack.
    return _named_source(place) or next(
        (s for s in PACK_SOURCES.values() if s.finds is not None and s.finds(place)), None
    )


def _named_source(name: str) -> PackSource | None:
    """The source without ``finds`` of that name, or None."""
    # Without an error: a place may still be a path.
    if name not in PACK_SOURCES:
        return None
    source = PACK_SOURCES[name]
    return source if source.finds is None else None


def pack_names() -> tuple[str, ...]:
    """Return the names of the packs that are opened by name."""
    return tuple(source.name for source in PACK_SOURCES.values() if source.finds is None)


def _check_options(source: PackSource, request: PackRequest) -> None:
    for name in request.given():
        if name in {*source.options, *OF_ALL_PACKS}:
            continue
        taking = [other.name for other in PACK_SOURCES.values() if name in other.options]
        raise wrong_value(
            name,
            getattr(request, name),
            f"left out: {request.place!r} is a pack of kind {source.name!r}; kinds that take it: "
            f"{', '.join(taking) or 'none'}",
        )
