"""Opening of asset packs (homes, their furniture and movable objects) by name or path.

`mjhab.scenes.pack_source` has the registry of sources: the built-in packs, ReplicaCAD, folders of `save_pack`, home
files, and those of plugins.
"""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

from mjhab.core.errors import MjhabError, UsageError, fault, unknown_name, wrong_value
from mjhab.core.registration import plugins
from mjhab.core.registration.plugins import raised_text
from mjhab.scenes.door_walls import with_door_walls
from mjhab.scenes.objects import with_registered_objects
from mjhab.scenes.pack_folder import load_pack
from mjhab.scenes.pack_source import (
    HOME_SUFFIXES,
    PACK_SOURCES,
    Assets,
    PackRequest,
    PackSource,
    pack_names,
    pack_request,
    source_of,
)
from mjhab.scenes.spec import Pack


def open_pack(assets: Assets = "builtin") -> Pack:
    """Open an asset pack.

    Args:
        assets: the name of a registered pack such as ``"builtin"``; the path of a home file, of a folder that
            `save_pack` wrote, or of a ReplicaCAD data set (the folder, the folder that holds it as ``replica_cad``, one
            ``*.scene_instance.json`` of it, or either folder followed by names of scenes: ``replica_cad/apt_0``,
            ``replica_cad/apt_*``); or a `PackRequest`, which also has options.

    Raises:
        UsageError: there is no such pack, or it cannot be read; the message says what is missing or which names exist.

    Example:
        >>> import mjhab
        >>> pack = mjhab.open_pack("builtin")
        >>> len(pack.homes)
        105
    """
    request = pack_request(assets)
    source = source_of(request)
    if source is not None:
        return _completed(_opened(source, request), request)
    # No source found a pack there: the reader of folders says what is missing.
    if Path(request.place).is_dir():
        return _completed(load_pack(Path(request.place)), request)
    raise _nothing_there(request.place)


def stage_of(assets: Assets) -> dict[str, str]:
    """Entry for the record of a run: {"stage": `Pack.stage`}; empty for packs whose homes are no scenes with stages."""
    request = pack_request(assets)
    source = source_of(request)
    if source is None or "stage" not in source.options:
        return {}
    return {"stage": open_pack(request).stage}


def _completed(pack: Pack, request: PackRequest) -> Pack:
    """Return a checked pack with what a request or a plugin adds to every pack."""
    checked = _checked(pack, request)
    # Objects last: they are added to the same pack again when more are registered.
    return with_registered_objects(with_door_walls(checked, request.door_walls))


def _checked(pack: Pack, request: PackRequest) -> Pack:
    """Return a pack that has homes, each under a name of its own.

    Raises:
        UsageError: it has none, or two of one name, of which only one could be found.
    """
    if not pack.homes:
        raise fault(f"asset pack {request}", "has no homes.")
    names = [home.name for home in pack.homes]
    # Homes are found by name: of two the second could never be opened.
    for name, count in Counter(names).items():
        if count > 1:
            raise fault(
                f"asset pack {request}",
                f"has {count} homes of the name {name!r}; give each one of its own.",
            )
    return pack


def _opened(source: PackSource, request: PackRequest) -> Pack:
    """The pack that a source opens; failures of a plugin's source are reported as errors of that plugin.

    Raises:
        UsageError: the source raises, or returns no pack.
    """
    if PACK_SOURCES.is_builtin(source.name):
        return source.open(request)
    what = f"{PACK_SOURCES.described(source.name)} cannot open {request}"
    try:
        pack = source.open(request)
    except MjhabError as error:
        raise fault(what, str(error)) from error
    # A plugin may raise anything.
    except Exception as error:
        raise fault(what, f"its open raised {raised_text(error)}.") from error
    if not isinstance(pack, Pack):
        raise fault(
            what,
            f"its open must return a mjhab.scenes.spec.Pack, got {type(pack).__name__}.",
        )
    return pack


def _nothing_there(place: str) -> UsageError:
    """Error that says why no source opens a place."""
    if Path(place).exists():
        expected = f"the name of a pack ({', '.join(pack_names())}) or a folder with pack.json and meshes.npz"
        return wrong_value("asset pack", place, expected, "It is a file.")
    if Path(place).suffix in HOME_SUFFIXES:
        expected = f"a {' or '.join(HOME_SUFFIXES)} file with a home that exists"
        return wrong_value(
            "home file", place, expected, "See docs/extending.md, A new home."
        )
    if any(separator and separator in place for separator in (os.sep, os.altsep, "/")):
        expected = f"the name of a pack ({', '.join(pack_names())}) or a folder with pack.json that exists"
        return wrong_value("asset folder", place, expected)
    advice = plugins.failed_plugins()
    return unknown_name("asset pack", place, pack_names(), advice=advice)
